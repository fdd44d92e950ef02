# SPDX-License-Identifier: Apache-2.0
"""What a LiDAR is: beams, azimuths, range, noise, drop-off, intensity law and mounting, as plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.lidar.intensity import IntensityLaw

MIN_HEIGHT_M, MAX_HEIGHT_M = 0.3, 20.0
_MAX_TILT_RAD = math.radians(30)


@dataclass(frozen=True)
class BeamUnit:
    """The beams of one spinning head; a stacked sensor has several heads.

    elevations_rad: of the beams, strictly ascending. offset_m: of the head above the sensor's origin, along its axis.
    """

    elevations_rad: tuple[float, ...]
    offset_m: float = 0.0

    def __post_init__(self) -> None:
        angles = self.elevations_rad
        ascending = all(low < high for low, high in pairwise(angles))
        if len(angles) < 2 or not ascending or angles[0] < -math.pi / 2 or angles[-1] > math.pi / 2:
            raise ConfigError(
                f"BeamUnit needs at least two beams, ascending within 90 degrees of the horizon; got {len(angles)} "
                f"beams: {', '.join(f'{math.degrees(a):.2f}' for a in angles[:4])} ... degrees."
            )
        if not abs(self.offset_m) <= 1.0:
            raise ConfigError(f"BeamUnit needs an offset_m within 1 m; got {self.offset_m}.")

    @property
    def elevation(self) -> NDArray[np.float64]:
        """Elevation angles (B,) of the beams in radians, ascending."""
        return np.array(self.elevations_rad)


def spread_beams(count: int, lower_deg: float, upper_deg: float) -> BeamUnit:
    """Return a unit of count beams, evenly spread over elevations lower_deg … upper_deg."""
    if count < 2:
        raise ConfigError(f"spread_beams needs at least two beams; got {count}.")
    return BeamUnit(tuple(np.linspace(math.radians(lower_deg), math.radians(upper_deg), count).tolist()))


@dataclass(frozen=True)
class LidarSpec:
    """A sensor that spins about its upright axis.

    A ray's return is lost with probability drop_general + drop_dark * max(0, 1 - s / drop_limit) + drop_grazing * max(0,
    1 - cos / 0.1), where s = exp(-0.004 r) is CARLA's signal and cos that of the incidence. The first two terms are CARLA's: its
    general drop-off, its drop-off at zero intensity, and the intensity from which on that one is zero.

    Attributes:
        name: of the row of the table, empty for a sensor of one's own.
        units: heads of beams.
        per_turn: azimuths of a whole turn.
        sector_rad: width, centred ahead, of what is kept of a turn.
        min_range_m, max_range_m: nearer and farther returns are lost.
        range_10_percent_m: where a target of reflectivity 0.1 is lost, others as reflectivity / r^2; 0: no such limit.
        height_m: above the road.
        roll_rad, pitch_rad: tilt of the sensor in its mount (pitch > 0: ahead is down).
        range_sigma_m: standard deviation of noise along the ray.
        drop_general, drop_dark, drop_limit, drop_grazing: see above.
        spurious_fraction: of rays that return from the air near the sensor, as in rain.
        rate_hz: turns a second.
        has_fixed_pulse_rate: whether the number of azimuths falls as the rate rises.
        intensity: what is stored as intensity.
    """

    name: str = ""
    units: tuple[BeamUnit, ...] = (spread_beams(64, -25, 2),)
    per_turn: int = 1800
    sector_rad: float = 2 * math.pi
    min_range_m: float = 0.0
    max_range_m: float = 120.0
    range_10_percent_m: float = 0.0
    height_m: float = 1.9
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    range_sigma_m: float = 0.02
    drop_general: float = 0.1
    drop_dark: float = 0.15
    drop_limit: float = 0.7
    drop_grazing: float = 0.3
    spurious_fraction: float = 0.0
    rate_hz: float = 10.0
    has_fixed_pulse_rate: bool = False
    intensity: IntensityLaw = IntensityLaw()

    def __post_init__(self) -> None:
        rules = {
            "units needs at least one head": len(self.units) >= 1,
            "per_turn needs 8 … 10000": 8 <= self.per_turn <= 10_000,
            "sector_rad needs to be in (0, 2 pi]": 0 < self.sector_rad <= 2 * math.pi + 1e-12,
            "ranges need 0 <= min_range_m < max_range_m": 0 <= self.min_range_m < self.max_range_m < math.inf,
            "range_10_percent_m needs >= 0": 0 <= self.range_10_percent_m < math.inf,
            f"height_m needs {MIN_HEIGHT_M} … {MAX_HEIGHT_M}": MIN_HEIGHT_M <= self.height_m <= MAX_HEIGHT_M,
            "roll_rad and pitch_rad need 30 degrees at most": max(abs(self.roll_rad), abs(self.pitch_rad))
            <= _MAX_TILT_RAD,
            "range_sigma_m needs 0 … 1": 0 <= self.range_sigma_m <= 1,
            "drop_general, drop_dark, drop_grazing and spurious_fraction need 0 … 1": all(
                0 <= p <= 1 for p in (self.drop_general, self.drop_dark, self.drop_grazing, self.spurious_fraction)
            ),
            "drop_limit needs to be in (0, 1]": 0 < self.drop_limit <= 1,
            "rate_hz needs to be above 0": 0 < self.rate_hz < math.inf,
        }
        broken = [rule for rule, holds in rules.items() if not holds]
        if broken:
            raise ConfigError(f"LidarSpec {self.name or 'without a name'}: {'; '.join(broken)}; got {self._shorten()}.")

    def _shorten(self) -> str:
        numbers = {k: v for k, v in self.__dict__.items() if isinstance(v, int | float)}
        return ", ".join(f"{key}={value:g}" for key, value in numbers.items())

    @property
    def num_beams(self) -> int:
        """Number of beams of all units."""
        return sum(len(unit.elevations_rad) for unit in self.units)

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """Elevations of the lowest and the highest beam in degrees."""
        return (
            math.degrees(min(unit.elevations_rad[0] for unit in self.units)),
            math.degrees(max(unit.elevations_rad[-1] for unit in self.units)),
        )

    @cached_property
    def azimuth(self) -> NDArray[np.float64]:
        """Azimuth angles (A,) of the firings in radians, counter-clockwise."""
        all_of_them = -math.pi + 2 * math.pi * (np.arange(self.per_turn) + 0.5) / self.per_turn
        return all_of_them[np.abs(all_of_them) <= self.sector_rad / 2]

    @cached_property
    def upright_from_agent(self) -> Transform | None:
        """Rotation of the agent's frame about the sensor, which stands height_m above both origins; None without tilt.

        The agent's axes are those of the sensor's body, its origin is on the road to within height_m * (1 - cos(tilt)).
        """
        if self.roll_rad == 0 == self.pitch_rad:
            return None
        zero = torch.zeros((), dtype=torch.float64)
        tilt = Transform.from_rpy(
            torch.zeros(3, dtype=torch.float64), zero + self.roll_rad, zero + self.pitch_rad, zero
        )
        return Transform.from_xyz_yaw(0, 0, self.height_m) @ tilt @ Transform.from_xyz_yaw(0, 0, -self.height_m)

    def agent_pose(self, world_from_upright: Transform) -> Transform:
        """Return world_from_agent of a mount whose frame lies on the road under the sensor, and is not tilted with it."""
        return world_from_upright if self.upright_from_agent is None else world_from_upright @ self.upright_from_agent

    def at_rate(self, rate_hz: float) -> LidarSpec:
        """Return the sensor at another rate, with as many pulses a second where these are fixed."""
        per_turn = round(self.per_turn * self.rate_hz / rate_hz) if self.has_fixed_pulse_rate else self.per_turn
        return replace(self, rate_hz=rate_hz, per_turn=per_turn)

    def describe(self) -> dict[str, Any]:
        """Return what a recording states of the sensor, as plain values."""
        lower, upper = self.field_of_view_deg
        return {
            "name": self.name,
            "beams": self.num_beams,
            "lower_deg": round(lower, 4),
            "upper_deg": round(upper, 4),
            "per_turn": self.per_turn,
            "max_range_m": self.max_range_m,
            "height_m": self.height_m,
            "roll_deg": round(math.degrees(self.roll_rad), 4),
            "pitch_deg": round(math.degrees(self.pitch_rad), 4),
            "range_sigma_m": self.range_sigma_m,
            "spurious_fraction": self.spurious_fraction,
            "rate_hz": self.rate_hz,
            "intensity": self.intensity.kind,
        }


def merge_elevations(parts: Sequence[NDArray[np.float64]]) -> tuple[float, ...]:
    """Return the elevations of several blocks of one head, ascending."""
    return tuple(np.sort(np.concatenate(parts)).tolist())
