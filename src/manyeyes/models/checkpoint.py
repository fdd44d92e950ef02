# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: safetensors with the whole configuration inside, loaded strictly."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models.detector import Detector, DetectorConfig

FORMAT = "manyeyes-detector-1"


def config_to_json(config: Any) -> str:
    """A nested frozen dataclass as JSON with sorted keys."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def config_from_json(kind: type, text: str) -> Any:
    """The inverse of config_to_json; an unknown field is an error, and so is a missing one that has no default."""
    return _build(kind, json.loads(text))


def _build(kind: Any, value: Any) -> Any:
    if value is None:
        return None
    kind = next((k for k in typing.get_args(kind) if dataclasses.is_dataclass(k)), kind)
    if not dataclasses.is_dataclass(kind):
        return tuple(value) if isinstance(value, list) else value
    hints = typing.get_type_hints(kind)
    known = {f.name for f in dataclasses.fields(kind)}
    needed = {f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING}
    if not isinstance(value, dict) or not needed <= set(value) <= known:
        raise ConfigError(
            f"{getattr(kind, '__name__', kind)} has fields {sorted(known)}; the stored configuration has "
            f"{sorted(value) if isinstance(value, dict) else value!r}."
        )
    return kind(**{name: _build(hints[name], item) for name, item in value.items()})  # pyright: ignore[reportCallIssue]


def fingerprint(model: Detector) -> bytes:
    """8 bytes that name a configuration and its weights; tokens are only understood by the weights that made them."""
    digest = hashlib.blake2b(config_to_json(model.config).encode(), digest_size=8)
    for name, value in sorted(_tensors(model).items()):
        digest.update(name.encode())
        digest.update(value.detach().float().contiguous().numpy().tobytes())
    return digest.digest()


def _tensors(model: Detector) -> dict[str, torch.Tensor]:
    """Everything that changes what the model says: how many batches a norm has seen does not."""
    return {k: v for k, v in model.state_dict().items() if not k.endswith("num_batches_tracked")}


def save(model: Detector, path: Path, card: dict[str, Any], half: bool = False) -> None:
    """Write weights, configuration and a model card (command, seed, time, result) to one file, atomically."""
    state = {k: (v.half() if half and v.is_floating_point() else v).contiguous() for k, v in _tensors(model).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file(state, partial, {"format": FORMAT, "config": config_to_json(model.config), "card": json.dumps(card)})
    partial.replace(path)


def load(path: Path) -> Detector:
    """A detector in evaluation mode, from its own file alone."""
    state, metadata = _read(path)
    try:
        model = Detector(config_from_json(DetectorConfig, metadata["config"]))
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path}: its configuration is not JSON ({error}); copy or train it again.") from error
    except (ConfigError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its configuration is not one of this version of manyeyes: {error} "
            "Use the version that wrote it, or train again."
        ) from error
    expected = _tensors(model)
    for name in sorted(set(expected) | set(state)):
        if name not in state or name not in expected or state[name].shape != expected[name].shape:
            here = tuple(state[name].shape) if name in state else "nothing"
            there = tuple(expected[name].shape) if name in expected else "nothing"
            raise CheckpointError(
                f"{path}: tensor {name} is {here} in the file and {there} in the model that its configuration builds; "
                "use the weights with the version of manyeyes that wrote them, or train again."
            )
        if not bool(torch.isfinite(state[name]).all()):
            raise CheckpointError(f"{path}: tensor {name} has NaN or infinite values; train again from an older save.")
    model.load_state_dict({k: v.float() for k, v in state.items()}, strict=False)
    model.eval().requires_grad_(False)
    model.fingerprint = fingerprint(model)
    return model


def read_card(path: Path) -> dict[str, Any]:
    """The model card inside a file of weights."""
    return json.loads(_read(path)[1]["card"])


def _read(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file of weights; give a .safetensors file that 'manyeyes train' wrote.")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path}: not a whole safetensors file ({error}); copy or train it again.") from error
    if metadata.get("format") != FORMAT or "config" not in metadata:
        raise CheckpointError(
            f"{path}: format is {metadata.get('format')!r}, not {FORMAT!r}; 'manyeyes train' writes such files."
        )
    return state, metadata
