# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: safetensors with the whole configuration inside, loaded strictly."""

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
from safetensors.torch import save_file
from torch import nn

from manyeyes._io import atomic_replace
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models.detector.detector import Detector, DetectorConfig

FORMAT = "manyeyes-detector-1"
"""Of a detector's file; models of other kinds have formats of their own."""

Config = TypeVar("Config")
Model = TypeVar("Model", bound=nn.Module)


def config_to_json(config: Any) -> str:
    """A nested frozen dataclass as JSON with sorted keys."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def config_from_json(kind: type, text: str) -> Any:
    """The inverse of config_to_json; an unknown field is an error, and so is a missing one that has no default."""
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
    """Of a union of dataclasses the one whose fields are all that the value names, else the first."""
    kinds = [k for k in typing.get_args(kind) if dataclasses.is_dataclass(k)]
    named = set(value) if isinstance(value, dict) else set()
    return next((k for k in kinds if named == {f.name for f in dataclasses.fields(k)}), kinds[0] if kinds else kind)


def fingerprint(model: nn.Module) -> bytes:
    """8 bytes that name a configuration and its weights; tokens are only understood by the weights that made them."""
    digest = hashlib.blake2b(config_to_json(model.config).encode(), digest_size=8)
    for name, value in sorted(_tensors(model).items()):
        digest.update(name.encode())
        digest.update(value.detach().float().contiguous().numpy().tobytes())
    return digest.digest()


def _tensors(model: nn.Module) -> dict[str, torch.Tensor]:
    """Everything that changes what the model says: how many batches a norm has seen does not."""
    return {k: v for k, v in model.state_dict().items() if not k.endswith("num_batches_tracked")}


def save(model: nn.Module, path: Path, card: dict[str, Any], half: bool = False, format: str = FORMAT) -> None:
    """Write weights, the model's config and a model card (command, seed, time, result) to one file, atomically."""
    state = {k: (v.half() if half and v.is_floating_point() else v).contiguous() for k, v in _tensors(model).items()}
    with atomic_replace(path, durable=False) as temporary:
        save_file(
            state, temporary, {"format": format, "config": config_to_json(model.config), "card": json.dumps(card)}
        )


def load(path: Path) -> Detector:
    """A detector in evaluation mode, from its own file alone."""
    model = load_as(path, FORMAT, DetectorConfig, Detector)
    model.fingerprint = fingerprint(model)
    return model


def load_as(path: Path, format: str, kind: type[Config], build: Callable[[Config], Model]) -> Model:
    """A model in evaluation mode, built from the configuration in its own file; build: from a configuration of that kind."""
    state, metadata = _read(path, format)
    try:
        model = build(config_from_json(kind, metadata["config"]))
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
    return model


def read_state(path: Path, format: str = FORMAT) -> dict[str, torch.Tensor]:
    """The tensors of a file of weights by name, as they are stored."""
    return _read(path, format)[0]


def read_card(path: Path, format: str = FORMAT) -> dict[str, Any]:
    """The model card inside a file of weights."""
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
