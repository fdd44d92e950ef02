# SPDX-License-Identifier: Apache-2.0
"""Settings of a training preset as a TOML file: every field printed, any subset of them read back over a preset."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from manyeyes._io import name_errors
from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import DetectorConfig
from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.trainer import TrainConfig

NONE = "none"
"""TOML has no null: this text stands for None."""
Settings = TypeVar("Settings", bound="TrainConfig | TrainPlan")


def print_config(settings: TrainConfig | TrainPlan) -> str:
    """Return settings of a stage or of a plan as TOML; read over any preset of the same kind, they are equal."""
    content = {
        field.name: getattr(settings, field.name)
        for field in dataclasses.fields(settings)
        if field.init and field.name != "stages"
    }
    table = {name: asdict(value) if dataclasses.is_dataclass(value) else value for name, value in content.items()}  # pyright: ignore[reportArgumentType]
    if isinstance(settings, TrainPlan):
        table["stages"] = {name: asdict(config) for name, config in settings.stages}
    return "\n".join(_format_table(table, ())).strip() + "\n"


def read_config(path: Path, preset: Settings) -> Settings:
    """Return a preset with the fields that a TOML file gives.

    Raises:
        ConfigError: the file is not TOML, or a field is unknown or has another type; the text names file and field.
    """
    with name_errors(path), path.open("rb") as file:
        try:
            given = tomllib.load(file)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not a TOML file ({error}); --print-config prints one.") from error
    try:
        changed: Any = _overlay_plan(preset, given) if isinstance(preset, TrainPlan) else _overlay(preset, given, "")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return changed


def _overlay_plan(plan: TrainPlan, given: Mapping[str, Any]) -> TrainPlan:
    _check_names(plan, given, "")
    stages = given.get("stages", {})
    known = [name for name, _ in plan.stages]
    for name in stages:
        if name not in known:
            raise ConfigError(f"stages.{name} is no stage of this plan{_suggest(name, known)}")
    changes: dict[str, Any] = {
        "stages": tuple(
            (name, _overlay(config, stages.get(name, {}), f"stages.{name}.")) for name, config in plan.stages
        )
    }
    for name, kind in (("released", DetectorConfig), ("codebook", CodebookConfig)):
        if name in given:
            changes[name] = _overlay_optional(getattr(plan, name), given[name], kind, name)
    for name in ("codebook_frames", "calibration_frames"):
        if name in given:
            changes[name] = given[name]
    for name in ("codebook_frames", "calibration_frames"):
        if not isinstance(changes.get(name, getattr(plan, name)), int):
            raise ConfigError(f"{name} has another type; got {given[name]!r}.")
    return replace(plan, **changes)


def _overlay_optional(base: Any, given: Any, kind: type, name: str) -> Any:
    if not isinstance(given, dict):
        return None if given == NONE else given
    if dataclasses.is_dataclass(base):
        return _overlay(base, given, f"{name}.")
    return checkpoint.config_from_json(kind, json.dumps(given))


def _overlay(base: Any, given: Mapping[str, Any], prefix: str) -> Any:
    """Return a dataclass with fields of a table, whose types are checked as those of a stored configuration."""
    return checkpoint.config_from_json(type(base), json.dumps(_merge(base, given, prefix)))


def _merge(base: Any, given: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    _check_names(base, given, prefix)
    merged = asdict(base)
    for name, value in given.items():
        was = getattr(base, name)
        if dataclasses.is_dataclass(was) and isinstance(value, dict):
            merged[name] = _merge(was, value, f"{prefix}{name}.")
        else:
            merged[name] = _restore_none(value)
    return merged


def _restore_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _restore_none(item) for name, item in value.items()}
    return None if value == NONE else value


def _check_names(base: Any, given: Mapping[str, Any], prefix: str) -> None:
    known = [field.name for field in dataclasses.fields(base) if field.init]
    for name in given:
        if name not in known:
            raise ConfigError(f"{prefix}{name} is no field of {type(base).__name__}{_suggest(name, known)}")


def _suggest(name: str, known: list[str]) -> str:
    near = get_close_matches(name, known, 1)
    return f"; did you mean {near[0]}?" if near else f"; it has {', '.join(known)}."


def _format_table(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a table: its values first, then its tables."""
    values = {name: value for name, value in table.items() if not isinstance(value, dict)}
    if path:
        yield ""
        yield f"[{'.'.join(path)}]"
    for name, value in values.items():
        yield f"{name} = {_format_value(value)}"
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _format_table(value, (*path, name))


def _format_value(value: Any) -> str:
    if value is None:
        return f'"{NONE}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    if isinstance(value, str):
        return json.dumps(value)
    return str(value).lower() if isinstance(value, bool) else repr(value)
