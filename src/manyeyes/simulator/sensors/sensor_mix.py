# SPDX-License-Identifier: Apache-2.0
"""Sensors of the agents of a scene, drawn one by one: which LiDAR, its mounting and its noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.sensors.lidar_spec import LidarSpec
from manyeyes.simulator.sensors.lidars import lidar_spec


@dataclass(frozen=True)
class SensorMix:
    """Distributions that the sensor of an agent is drawn from, all uniform and independent.

    Attributes:
        vehicle_lidars, roadside_lidars: names of the table of LiDARs; repeated ones are drawn more often.
        vehicle_height_m, roadside_height_m: minimum and maximum height above the road.
        max_tilt_rad: maximum roll and pitch in addition to the sensor's own, of either sign.
        max_range_sigma_m: maximum noise along the ray, in place of the sensor's own; None keeps that.
        max_spurious_fraction: maximum fraction of spurious returns, of a tenth of the agents; the others have none.
    """

    vehicle_lidars: tuple[str, ...]
    roadside_lidars: tuple[str, ...]
    vehicle_height_m: tuple[float, float] = (1.5, 2.5)
    roadside_height_m: tuple[float, float] = (4.0, 7.0)
    max_tilt_rad: float = math.radians(1.5)
    max_range_sigma_m: float | None = 0.05
    max_spurious_fraction: float = 0.0

    def draw(self, is_infrastructure: bool, rate_hz: float, key: tuple[int | str, ...]) -> LidarSpec:
        """Return the sensor of one agent; the same key gives the same sensor, in all frames of a scene.

        Args:
            is_infrastructure: whether it stands on a pole.
            rate_hz: of the scene.
            key: (seed, scene, agent).
        """
        random = keyed_generator("sensor-mix", *key)
        names = self.roadside_lidars if is_infrastructure else self.vehicle_lidars
        lidar = lidar_spec(names[int(random.integers(len(names)))]).at_rate(rate_hz)
        height = random.uniform(*(self.roadside_height_m if is_infrastructure else self.vehicle_height_m))
        roll, pitch = self.max_tilt_rad * random.uniform(-1, 1, 2)
        noise, rain, wet = random.random(3)
        sigma = lidar.range_sigma_m if self.max_range_sigma_m is None else self.max_range_sigma_m * noise
        return replace(
            lidar,
            height_m=round(float(height), 3),
            roll_rad=_round_angle(lidar.roll_rad + roll),
            pitch_rad=_round_angle(lidar.pitch_rad + pitch),
            range_sigma_m=round(float(sigma), 4),
            spurious_fraction=round(float(self.max_spurious_fraction * wet), 4) if rain < 0.1 else 0.0,
        )


def _round_angle(angle_rad: float) -> float:
    """Return an angle of whole thousandths of a degree, as recordings state it."""
    return float(np.radians(round(math.degrees(angle_rad), 3)))


# For training: 30 % have 16 beams, 25 % 32, 10 % 40, 25 % 64 and 10 % 128, evenly spaced or not; sparse sensors cost less and are
# what most agents have. unseen-sensor is never in it.
_VEHICLE_LIDARS = (
    "opv2v-16", "opv2v-16", "opv2v-16", "opv2v-16", "vlp-16", "vlp-16", "opv2v-32", "opv2v-32", "v2xset", "v2xset", "hdl-32e",
    "dair-vehicle", "dair-pandar40p", "opv2v", "hdl-64e", "argoverse2", "argoverse2", "pandar64", "opv2v-128", "os1-128",
)  # fmt: skip
_ROADSIDE_LIDARS = (
    "opv2v-roadside-16", "opv2v-roadside-16", "opv2v-roadside-16", "opv2v-roadside-32", "opv2v-roadside-32",
    "opv2v-roadside", "opv2v-roadside-128", "dair-infrastructure",
)  # fmt: skip


def _one_sensor(beams: str) -> SensorMix:
    """Return a mix of one number of beams, level and mounted as in the table, for evaluation."""
    return SensorMix(
        (f"opv2v{beams}",),
        (f"opv2v-roadside{beams}",),
        (1.9, 1.9),
        (5.0, 5.0),
        max_tilt_rad=0.0,
        max_range_sigma_m=None,
    )


SENSOR_MIXES: dict[str, SensorMix] = {
    "all": SensorMix(_VEHICLE_LIDARS, _ROADSIDE_LIDARS, max_spurious_fraction=0.02),
    "beams-16": _one_sensor("-16"),
    "beams-32": _one_sensor("-32"),
    "beams-64": _one_sensor(""),
    "beams-128": _one_sensor("-128"),
    "unseen": SensorMix(("unseen-sensor",), ("unseen-sensor",), (2.2, 2.2), (5.0, 5.0), 0.0, None),
}


def sensor_mix(name: str) -> SensorMix:
    """Return a mix by its name in SENSOR_MIXES."""
    if name not in SENSOR_MIXES:
        raise ConfigError(f"No sensor mix '{name}'; choose one of {', '.join(SENSOR_MIXES)}.")
    return SENSOR_MIXES[name]
