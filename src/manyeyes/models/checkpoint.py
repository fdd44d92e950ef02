# SPDX-License-Identifier: Apache-2.0
"""Read and write weights: safetensors files that hold the whole configuration, loaded strictly."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import nn

from manyeyes._io import atomic_write
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models.detector.detector import Detector, DetectorConfig

FORMAT = "manyeyes-detector-1"
"""Format name in the metadata of a detector's file; models of other types have their own."""

Config = TypeVar("Config")
Model = TypeVar("Model", bound=nn.Module)


def config_to_json(config: Any) -> str:
    """Serialise a nested frozen dataclass to JSON with sorted keys."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def config_from_json(kind: type, text: str) -> Any:
    """Invert config_to_json; unknown fields, and missing fields without a default, are errors."""
    return _build(kind, json.loads(text))


def _build(kind: Any, value: Any) -> Any:
    if value is None:
        return None
    kind = _alternative(kind, value)
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


def _alternative(kind: Any, value: Any) -> Any:
    """Select from a union of dataclasses the one whose field names equal the keys of value, else the first."""
    kinds = [k for k in typing.get_args(kind) if dataclasses.is_dataclass(k)]
    named = set(value) if isinstance(value, dict) else set()
    return next((k for k in kinds if named == {f.name for f in dataclasses.fields(k)}), kinds[0] if kinds else kind)


def fingerprint(model: nn.Module) -> bytes:
    """Hash a model's configuration and weights to 8 bytes; only models with equal fingerprints can decode each
    other's tokens.
    """
    digest = hashlib.blake2b(config_to_json(model.config).encode(), digest_size=8)
    for name, value in sorted(_tensors(model).items()):
        digest.update(name.encode())
        digest.update(value.detach().float().contiguous().numpy().tobytes())
    return digest.digest()


def _tensors(model: nn.Module) -> dict[str, torch.Tensor]:
    """Return the tensors that affect the output, so without the batch counters of normalisation layers."""
    return {k: v for k, v in model.state_dict().items() if not k.endswith("num_batches_tracked")}


def save(model: nn.Module, path: Path, card: dict[str, Any], half: bool = False, format: str = FORMAT) -> None:
    """Write weights, configuration and model card (command, seed, time, result) to one file, atomically."""
    state = {k: (v.half() if half and v.is_floating_point() else v).contiguous() for k, v in _tensors(model).items()}
    metadata = {"format": format, "config": config_to_json(model.config), "card": json.dumps(card)}
    atomic_write(path, serialize(state, metadata))


def load(path: Path) -> Detector:
    """Load a detector in evaluation mode."""
    model = load_as(path, FORMAT, DetectorConfig, Detector)
    model.fingerprint = fingerprint(model)
    return model


def load_as(path: Path, format: str, kind: type[Config], build: Callable[[Config], Model]) -> Model:
    """Load a model in evaluation mode; build makes it from the configuration stored in its file."""
    state, metadata = _read(path, format)
    try:
        model = build(config_from_json(kind, metadata["config"]))
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path}: its configuration is not JSON ({error}); copy or train it again.") from error
    except (ConfigError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its configuration is not one of this version of manyeyes: {error} "
            "Use the version that wrote it, install the package that registers what is missing, or train again."
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
    return model


def read_state(path: Path, format: str = FORMAT) -> dict[str, torch.Tensor]:
    """Read the tensors of a weights file by name, in their stored dtype."""
    return _read(path, format)[0]


def read_card(path: Path, format: str = FORMAT) -> dict[str, Any]:
    """Read the model card of a weights file."""
    return json.loads(_read(path, format)[1]["card"])


def _read(path: Path, format: str = FORMAT) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file of weights; give a .safetensors file that 'manyeyes train' wrote.")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CheckpointError(f"{path}: not a whole safetensors file ({error}); copy or train it again.") from error
    if metadata.get("format") != format or "config" not in metadata:
        raise CheckpointError(
            f"{path}: format is {metadata.get('format')!r}, not {format!r}; 'manyeyes train' writes such files."
        )
    return state, metadata
