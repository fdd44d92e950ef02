# SPDX-License-Identifier: Apache-2.0
"""The table of LiDARs, lidars.toml: read once, checked field by field."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.ops.lidar.intensity import INTENSITY_LAWS, IntensityLaw
from manyeyes.simulator.sensors.lidar_spec import BeamUnit, LidarSpec, merge_elevations

TABLE = Path(__file__).with_name("lidars.toml")
_NUMBERS = (
    "min_range_m",
    "max_range_m",
    "range_10_percent_m",
    "height_m",
    "range_sigma_m",
    "drop_general",
    "drop_dark",
    "drop_limit",
    "drop_grazing",
    "spurious_fraction",
    "rate_hz",
)
_DEGREES = {"sector_deg": "sector_rad", "roll_deg": "roll_rad", "pitch_deg": "pitch_rad"}
_OTHERS = ("source", "like", "units", "per_turn", "azimuth_step_deg", "has_fixed_pulse_rate", "intensity")
_FIELDS = (*_NUMBERS, *_DEGREES, *_OTHERS)


@cache
def lidar_specs() -> Mapping[str, LidarSpec]:
    """Return all sensors of the table by name."""
    return read_lidars(TABLE.read_text(encoding="utf-8"))


def lidar_spec(name: str) -> LidarSpec:
    """Return a sensor by its name in the table."""
    specs = lidar_specs()
    if name not in specs:
        raise ConfigError(f"No LiDAR '{name}'; choose one of {', '.join(specs)}.")
    return specs[name]


def read_lidars(text: str) -> dict[str, LidarSpec]:
    """Parse a table of sensors.

    Raises:
        ConfigError: it is not TOML, or a row lacks a field, has an unknown one or an impossible value.
    """
    try:
        rows = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{TABLE.name}: expected TOML; {error}.") from None
    specs: dict[str, LidarSpec] = {}
    for name, row in rows.items():
        try:
            specs[name] = _parse_row(name, _with_base(name, row, rows))
        except ConfigError as error:
            raise ConfigError(f"{TABLE.name}, [{name}]: {error}") from None
    return specs


def describe_lidars() -> str:
    """Return the table of the documentation (docs/reference/lidars.md) in Markdown."""
    lines = [
        "| name | beams | elevations [deg] | azimuth [deg] | range [m] | noise [cm] | height [m] | intensity |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, spec in lidar_specs().items():
        lower, upper = spec.field_of_view_deg
        heads = " + ".join(str(len(unit.elevations_rad)) for unit in spec.units)
        spacing = "" if all(_is_even(unit) for unit in spec.units) else ", uneven"
        sector = "" if spec.sector_rad > 6.28 else f" in {math.degrees(spec.sector_rad):.0f}"
        lines.append(
            f"| `{name}` | {heads} | {lower:.1f} … {upper:.1f}{spacing} | {360 / spec.per_turn:.2f}{sector} | "
            f"{spec.min_range_m:g} … {spec.max_range_m:g} | {100 * spec.range_sigma_m:g} | {spec.height_m:g} | "
            f"{spec.intensity.kind} |"
        )
    return "\n".join(lines)


def _is_even(unit: BeamUnit) -> bool:
    gaps = np.diff(unit.elevations_rad)
    return bool(np.ptp(gaps) < 1e-6)


def _with_base(name: str, row: Any, rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with the fields of the row that it is like."""
    if not isinstance(row, Mapping):
        raise ConfigError(f"expected a table of fields, found {type(row).__name__}.")
    base = row.get("like")
    if base is None:
        return dict(row)
    if base == name or base not in rows or "like" in rows[base]:
        raise ConfigError(f"like needs the name of a row without like; got {base!r}.")
    return {**rows[base], **row}


def _parse_row(name: str, row: Mapping[str, Any]) -> LidarSpec:
    unknown = [key for key in row if key not in _FIELDS]
    if unknown:
        raise ConfigError(f"unknown field '{unknown[0]}'; choose from {', '.join(_FIELDS)}.")
    if not isinstance(row.get("source"), str):
        raise ConfigError("source needs a text: where the values are from.")
    numbers = {key: _number(key, row[key]) for key in _NUMBERS if key in row}
    angles = {_DEGREES[key]: math.radians(_number(key, row[key])) for key in _DEGREES if key in row}
    if "sector_rad" in angles and row["sector_deg"] == 360:
        angles["sector_rad"] = 2 * math.pi
    units = row.get("units")
    if not isinstance(units, list) or not units:
        raise ConfigError("units needs a list of one head or more.")
    return LidarSpec(
        name=name,
        units=tuple(_parse_unit(unit) for unit in units),
        per_turn=_parse_per_turn(row),
        has_fixed_pulse_rate=_boolean(row, "has_fixed_pulse_rate"),
        intensity=_parse_law(row.get("intensity", "material")),
        **numbers,
        **angles,
    )


def _parse_per_turn(row: Mapping[str, Any]) -> int:
    """Return the number of azimuths of a turn, which a row gives as such or as a step."""
    if ("per_turn" in row) == ("azimuth_step_deg" in row):
        raise ConfigError("give one of per_turn and azimuth_step_deg.")
    if "per_turn" in row:
        return round(_number("per_turn", row["per_turn"]))
    step = _number("azimuth_step_deg", row["azimuth_step_deg"])
    if not 0.01 <= step <= 10:
        raise ConfigError(f"azimuth_step_deg needs 0.01 … 10; got {step}.")
    return round(360 / step)


def _parse_unit(unit: Any) -> BeamUnit:
    """Return a head: even blocks [number, lowest, highest] and single elevations in degrees, in any order."""
    if not isinstance(unit, Mapping) or not {"even", "elevations_deg"} & set(unit) or set(unit) - {
        "even", "elevations_deg", "offset_m"
    }:  # fmt: skip
        raise ConfigError(f"a head needs even or elevations_deg, and may have offset_m; got {unit}.")
    parts = [np.radians([_number("elevations_deg", v) for v in unit.get("elevations_deg", ())])]
    for block in unit.get("even", ()):
        if not isinstance(block, list) or len(block) != 3 or not isinstance(block[0], int) or not 1 < block[0] <= 1024:
            raise ConfigError(f"even needs blocks [number, lowest, highest] of 2 … 1024 beams; got {block}.")
        low, high = (math.radians(_number("even", v)) for v in block[1:])
        parts.append(np.linspace(low, high, block[0]))
    return BeamUnit(merge_elevations(parts), _number("offset_m", unit.get("offset_m", 0.0)))


def _parse_law(law: Any) -> IntensityLaw:
    """Return a law by its name, or of its fields."""
    if isinstance(law, Mapping):
        try:
            return IntensityLaw(**law)
        except TypeError as error:
            raise ConfigError(f"intensity needs kind, gain, gamma and floor; {error}.") from None
    if law not in INTENSITY_LAWS:
        raise ConfigError(f"No intensity law '{law}'; choose one of {', '.join(INTENSITY_LAWS)}.")
    return INTENSITY_LAWS[law]


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{key} needs a finite number; got {value!r}.")
    return float(value)


def _boolean(row: Mapping[str, Any], key: str) -> bool:
    value = row.get(key, False)
    if not isinstance(value, bool):
        raise ConfigError(f"{key} needs true or false; got {value!r}.")
    return value
