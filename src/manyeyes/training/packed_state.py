# SPDX-License-Identifier: Apache-2.0
"""The training state of a run in one small file, to keep where large files are not kept.

The model stays in float32. What has the model's tensors (averaged weights) is kept as its difference from the model in bfloat16,
other floating-point tensors (moments of Adam) in bfloat16. So an unpacked run goes on from almost the state that was packed, not
from the same bit by bit: averaged weights differ by at most 2^-8 of their difference from the model, moments by at most 2^-8 of
themselves.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
import zstandard
from torch import Tensor

from manyeyes._io import atomic_write
from manyeyes.datatypes import CheckpointError

FORMAT = "manyeyes-packed-run-1"
MAX_BYTES = 10_000_000
"""Maximum size of a packed file."""
_MAX_STATE_BYTES = 1 << 31


def pack_state(state_file: Path, packed_file: Path) -> int:
    """Write the small file of a training state (last.pt); returns its bytes.

    Raises:
        CheckpointError: the state is damaged or not one of a trainer, or the packed file would be larger than MAX_BYTES.
    """
    state = _load(state_file, state_file.read_bytes())
    model = state.get("model")
    if not isinstance(model, dict):
        raise CheckpointError(f"{state_file}: no training state; give the last.pt of a run of 'manyeyes train'.")
    packed = {key: value if key == "model" else _shrink(value, model) for key, value in state.items()}
    dtypes = {key: _list_dtypes(value) for key, value in state.items() if key != "model"}
    content = io.BytesIO()
    torch.save({"format": FORMAT, "state": packed, "dtypes": dtypes}, content)
    small = zstandard.ZstdCompressor(level=19).compress(content.getvalue())
    if len(small) > MAX_BYTES:
        raise CheckpointError(
            f"{state_file}: {len(small):,} bytes packed, more than {MAX_BYTES:,}; keep last.pt itself where large files are kept."
        )
    atomic_write(packed_file, small)
    return len(small)


def unpack_state(packed_file: Path, state_file: Path) -> None:
    """Write the training state (last.pt) of a packed file, from which the trainer goes on.

    Raises:
        CheckpointError: the file is damaged or is no packed state.
    """
    try:
        content = zstandard.ZstdDecompressor().decompress(packed_file.read_bytes(), max_output_size=_MAX_STATE_BYTES)
    except zstandard.ZstdError as error:
        raise CheckpointError(f"{packed_file}: not a whole packed state ({error}); copy it again.") from error
    stored = _load(packed_file, content)
    if stored.get("format") != FORMAT:
        raise CheckpointError(f"{packed_file}: format is {stored.get('format')!r}, not {FORMAT!r}; pack the run again.")
    model, dtypes = stored["state"]["model"], stored["dtypes"]
    state = {
        key: value if key == "model" else _grow(value, dtypes[key], model) for key, value in stored["state"].items()
    }
    content = io.BytesIO()
    torch.save(state, content)
    atomic_write(state_file, content.getbuffer())


def _load(path: Path, content: bytes) -> dict[str, Any]:
    try:
        loaded = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    except Exception as error:
        raise CheckpointError(f"{path}: not a whole file of torch ({type(error).__name__}); copy it again.") from error
    if not isinstance(loaded, dict):
        raise CheckpointError(f"{path}: no training state; give the last.pt of a run of 'manyeyes train'.")
    return loaded


def _has_tensors_of(value: Any, model: dict[str, Tensor]) -> bool:
    return isinstance(value, dict) and value.keys() == model.keys()


def _shrink(value: Any, model: dict[str, Tensor]) -> Any:
    if _has_tensors_of(value, model):
        return {name: _to_bfloat16(v - model[name]) if v.is_floating_point() else v for name, v in value.items()}
    return _map_tensors(value, _to_bfloat16)


def _to_bfloat16(value: Tensor) -> Tensor:
    """Round a tensor of more than one number; single numbers, such as a count of steps, stay."""
    return value.to(torch.bfloat16) if value.is_floating_point() and value.numel() > 1 else value


def _grow(value: Any, dtypes: list[torch.dtype], model: dict[str, Tensor]) -> Any:
    wanted = iter(dtypes)
    grown = _map_tensors(value, lambda tensor: tensor.to(next(wanted)))
    if _has_tensors_of(value, model):
        return {name: v + model[name] if v.is_floating_point() else v for name, v in grown.items()}
    return grown


def _list_dtypes(value: Any) -> list[torch.dtype]:
    """List the types of all tensors of a nested value, in the order of _map_tensors."""
    found: list[torch.dtype] = []

    def note(tensor: Tensor) -> Tensor:
        found.append(tensor.dtype)
        return tensor

    _map_tensors(value, note)
    return found


def _map_tensors(value: Any, change: Any) -> Any:
    """Return a nested value of dictionaries, lists and tuples with its tensors changed, in a fixed order."""
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, dict):
        return {key: _map_tensors(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_map_tensors(item, change) for item in value)
    return value
