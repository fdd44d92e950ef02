# SPDX-License-Identifier: Apache-2.0
"""Read and write weights: safetensors files that hold the whole configuration, loaded strictly."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import types
import typing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from manyeyes._bounds import Bounds
from manyeyes._io import atomic_write, parse_json
from manyeyes.datatypes import BevGrid, CheckpointError, ConfigError
from manyeyes.datatypes.errors import shorten
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.models.score_calibration import read_score_calibration
from manyeyes.models.sensor_domain import read_sensor_domain
from manyeyes.models.token_peaks import read_token_peaks

FORMAT = "manyeyes-detector-1"
"""Format name in the metadata of a detector's file; models of other types have their own."""

_MAX_INT, _MAX_ITEMS, _MAX_CELLS = 2**20, 64, 2**24
_BUILD_ERRORS = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What a constructor of a model raises on numbers that do not fit each other."""

Config = TypeVar("Config")
Model = TypeVar("Model", bound=nn.Module)


def config_to_json(config: Any) -> str:
    """Serialise a nested frozen dataclass to JSON with sorted keys; fields that say so are absent at their default."""
    return json.dumps(_to_plain(config), sort_keys=True)


def _to_plain(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_to_plain(item) for item in value]
    if not dataclasses.is_dataclass(value):
        return value
    shown = [
        (f.name, getattr(value, f.name))
        for f in dataclasses.fields(value)
        if not (f.metadata.get("omit_default") and getattr(value, f.name) == f.default)
    ]
    return {name: _to_plain(item) for name, item in shown}


def config_from_json(kind: type, text: str) -> Any:
    """Invert config_to_json.

    Raises:
        ConfigError: unknown fields, missing fields without a default, or values of another type or outside their bounds.
    """
    return _build(kind, parse_json(text), "configuration")


def _build(hint: Any, value: Any, name: str) -> Any:
    kind = None if value is None else _alternative(hint, value)
    if not dataclasses.is_dataclass(kind):
        return _check_value(hint, value, name)
    hints = typing.get_type_hints(kind, include_extras=True)
    known = {f.name for f in dataclasses.fields(kind)}
    needed = {f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING}
    if not isinstance(value, dict) or not needed <= set(value) <= known:
        raise ConfigError(
            f"{getattr(kind, '__name__', kind)} has fields {sorted(known)}; the stored configuration has "
            f"{sorted(value) if isinstance(value, dict) else value!r}."
        )
    built = kind(**{key: _build(hints[key], item, f"{name}.{key}") for key, item in value.items()})  # pyright: ignore[reportCallIssue]
    if isinstance(built, BevGrid) and math.prod(built.shape) > _MAX_CELLS:
        rows, columns = built.shape
        raise ConfigError(f"{name} has {rows} x {columns} cells; the maximum is {_MAX_CELLS:,}, by a larger pillar.")
    return built


def _check_value(hint: Any, value: Any, name: str) -> Any:
    """Return a value as the type of its field has it: a number within its bounds, a text, or a tuple of such values."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        value = _check_value(parts[0], value, name)
        for bounds in parts[1:]:
            if isinstance(bounds, Bounds) and not bounds.contains(value):
                raise ConfigError(f"{name} needs {bounds.text}; got {value}.")
        return value
    if origin in (typing.Union, types.UnionType):
        options = [part for part in parts if part is not type(None)]
        return None if value is None and len(options) < len(parts) else _check_value(options[0], value, name)
    if origin is tuple:
        return _check_tuple(parts, value, name)
    if origin is typing.Literal:
        if value not in parts:
            raise ConfigError(f"{name} is one of {', '.join(map(str, parts))}; got {shorten(value)}.")
        return value
    return _check_scalar(hint, value, name)


def _check_tuple(hints: tuple[Any, ...], value: Any, name: str) -> tuple[Any, ...]:
    is_open = hints[-1] is Ellipsis
    if not isinstance(value, list) or len(value) > _MAX_ITEMS or not (is_open or len(value) == len(hints)):
        count = f"at most {_MAX_ITEMS}" if is_open else len(hints)
        raise ConfigError(f"{name} needs a list of {count} values; got {shorten(value)}.")
    item_hints = hints[:1] * len(value) if is_open else hints
    return tuple(_check_value(hint, item, f"{name}[{k}]") for k, (hint, item) in enumerate(zip(item_hints, value)))


def _check_scalar(kind: Any, value: Any, name: str) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int and not (is_number and isinstance(value, int) and 0 <= value <= _MAX_INT):
        raise ConfigError(f"{name} needs an integer from 0 to {_MAX_INT}; got {shorten(value)}.")
    if kind is float and not (is_number and not math.isnan(value)):
        raise ConfigError(f"{name} needs a number; got {shorten(value)}.")
    if kind in (bool, str) and not isinstance(value, kind):
        raise ConfigError(f"{name} needs a {kind.__name__}; got {shorten(value)}.")
    return value


def _alternative(kind: Any, value: Any) -> Any:
    """Select from a union of dataclasses the one whose field names equal the keys of value, else the first."""
    kinds = [k for k in typing.get_args(kind) if isinstance(k, type) and dataclasses.is_dataclass(k)]
    named = set(value) if isinstance(value, dict) else set()
    return next((k for k in kinds if named == {f.name for f in dataclasses.fields(k)}), kinds[0] if kinds else kind)


def fingerprint(model: nn.Module) -> bytes:
    """Hash a model's configuration and weights to 8 bytes; only models with equal fingerprints can decode each
    other's tokens.
    """
    digest = hashlib.blake2b(config_to_json(model.config).encode(), digest_size=8)
    for name, value in sorted(_tensors(model).items()):
        digest.update(name.encode())
        digest.update(value.float().contiguous().numpy().tobytes())
    return digest.digest()


def _tensors(model: nn.Module) -> dict[str, torch.Tensor]:
    """Return the tensors that affect the output, on the CPU, so without the batch counters of normalisation layers."""
    return {k: v.detach().cpu() for k, v in model.state_dict().items() if not k.endswith("num_batches_tracked")}


def save(model: nn.Module, path: Path, card: dict[str, Any], half: bool = False, format: str = FORMAT) -> None:
    """Write weights, configuration and model card (command, seed, time, result) to one file, atomically."""
    state = {k: (v.half() if half and v.is_floating_point() else v).contiguous() for k, v in _tensors(model).items()}
    metadata = {"format": format, "config": config_to_json(model.config), "card": json.dumps(card)}
    atomic_write(path, serialize(state, metadata))


def load(path: Path) -> Detector:
    """Load a detector in evaluation mode."""
    model = load_as(path, FORMAT, DetectorConfig, Detector)
    model.fingerprint = fingerprint(model)
    card = read_card(path)
    model.token_peaks = read_token_peaks(card, model.packed_channels, path)
    model.score_calibration = read_score_calibration(card, path)
    model.sensor_domain = read_sensor_domain(card, path)
    return model


def load_as(path: Path, format: str, kind: type[Config], build: Callable[[Config], Model]) -> Model:
    """Load a model in evaluation mode; build makes it from the configuration stored in its file."""
    state, metadata = _read(path, format)
    try:
        config = config_from_json(kind, metadata["config"])
        with _limit_parameters(sum(value.numel() for value in state.values())):
            model = build(config)
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path}: its configuration is not JSON ({error}); copy or train it again.") from error
    except (ConfigError, *_BUILD_ERRORS) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CheckpointError(
            f"{path}: its configuration is not one of this version of manyeyes: {reason[:600]} "
            "Use the version that wrote it, install the package that registers what is missing, or train again."
        ) from error
    _check_tensors(path, state, _tensors(model))
    model.load_state_dict({k: v.float() for k, v in state.items()}, strict=False)
    model.eval().requires_grad_(False)
    return model


@contextmanager
def _limit_parameters(num_stored: int) -> Iterator[None]:
    """Raise ConfigError as soon as the modules built in the block have more than twice as many parameters as a file holds."""
    num_built = 0

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal num_built
        num_built += 0 if parameter is None else parameter.numel()
        if num_built > 2 * num_stored + 1000:
            raise ConfigError(f"it describes a larger model than the {num_stored:,} numbers of the file.")

    handle = register_module_parameter_registration_hook(count)  # pyright: ignore[reportArgumentType]
    try:
        yield
    finally:
        handle.remove()


def _check_tensors(path: Path, state: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """Compare names, shapes and values of a file's tensors with those of a model."""
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


def read_state(path: Path, format: str = FORMAT) -> dict[str, torch.Tensor]:
    """Read the tensors of a weights file by name, in their stored dtype."""
    return _read(path, format)[0]


def read_card(path: Path, format: str = FORMAT) -> dict[str, Any]:
    """Read the model card of a weights file."""
    try:
        card = parse_json(_read(path, format)[1]["card"])
    except (KeyError, ValueError):
        card = None
    if not isinstance(card, dict):
        raise CheckpointError(f"{path}: no model card in its metadata; copy or train it again.")
    return card


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
