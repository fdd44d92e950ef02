# SPDX-License-Identifier: Apache-2.0
"""A spinning LiDAR in a scene: returns with noise, drop-out, intensity and the identity of what was met.

One sweep is taken from one pose of a world that stands still: the time of each return is given, but neither the sensor
nor the traffic moves within the sweep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes._jit import F32x2, F64x1, F64x2, I32x2, I64x1, U8x2, njit
from manyeyes.datatypes import ConfigError, PointCloud, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.raycast import GROUND, NOTHING, HeightField, Primitives, SensorPose, cast_rays

OFF_ROAD, ASPHALT, PAINT, SIDEWALK, CROSSING = range(5)

# Chosen: near-infrared (905 nm) reflectances of grass and soil, worn asphalt, white thermoplastic, concrete, paint on worn asphalt.
SURFACE_REFLECTIVITY = np.array([0.28, 0.12, 0.75, 0.32, 0.62])

# CARLA's sensor attenuates intensity by exp(-a r) with a = 0.004 / m, and OPV2V's clouds carry it (recordings.md).
ATTENUATION = 0.004


@dataclass(frozen=True)
class LidarSpec:
    """A sensor that spins about its upright axis.

    beams: spread evenly over elevations lower_rad … upper_rad. per_turn: azimuths of a whole turn; sector_rad: the width,
    centred ahead, of what is kept of it. height_m: above the road. range_sigma_m: noise along the ray. A return is lost
    with probability drop_general + drop_dark * max(0, 1 - s / drop_limit) + drop_grazing * max(0, 1 - cos / 0.1), where
    s = exp(-0.004 r) is CARLA's signal (the first two terms are CARLA's) and cos that of the incidence.
    """

    beams: int = 64
    per_turn: int = 1800
    lower_rad: float = math.radians(-25)
    upper_rad: float = math.radians(2)
    sector_rad: float = 2 * math.pi
    max_range_m: float = 120.0
    height_m: float = 1.9
    range_sigma_m: float = 0.02
    drop_general: float = 0.1
    drop_dark: float = 0.15
    drop_limit: float = 0.7
    drop_grazing: float = 0.3
    rate_hz: float = 10.0

    def __post_init__(self) -> None:
        if self.beams < 2 or self.per_turn < 8 or self.lower_rad >= self.upper_rad or self.max_range_m <= 0:
            raise ConfigError(
                f"LidarSpec needs beams >= 2, per_turn >= 8, lower_rad < upper_rad, max_range_m > 0; got {self}."
            )

    @cached_property
    def elevation(self) -> NDArray[np.float64]:
        """Elevation angles (B,) of the beams in radians, ascending."""
        return np.linspace(self.lower_rad, self.upper_rad, self.beams)

    @cached_property
    def azimuth(self) -> NDArray[np.float64]:
        """Azimuth angles (A,) of the firings in radians, counter-clockwise."""
        all_of_them = -math.pi + 2 * math.pi * (np.arange(self.per_turn) + 0.5) / self.per_turn
        return all_of_them[np.abs(all_of_them) <= self.sector_rad / 2]


# opv2v: CARLA's sensor in OPV2V's scenes: 64 channels, +2 to -25 degrees, 120 m, 1.3 million points a second at 20 turns,
# which is 1,016 azimuths; drop-off 0.1 / 0.15 / 0.7 and 2 cm noise as in that configuration.
# opv2v-32, opv2v-16: the same with every second and every fourth beam, as cheaper sensors are built.
# dair-vehicle: chosen, after a 40-beam roof sensor (40 beams, 0.2 degrees, denser towards the horizon there, even here).
# dair-infrastructure: chosen, after a 300-line solid-state sensor with 100 degrees ahead, x >= 0 only, 280 m there.
# The others are the 115,200-ray sensor of the benchmarks, and OPV2V's sensor on a pole, tilted down (chosen).
_OPV2V = LidarSpec(per_turn=1016, drop_general=0.17)
_OPV2V_ROADSIDE = replace(_OPV2V, lower_rad=math.radians(-32), upper_rad=0.0, height_m=5.0)

LIDAR_PRESETS: dict[str, LidarSpec] = {
    "spinning-64": LidarSpec(),
    "opv2v": _OPV2V,
    "opv2v-32": replace(_OPV2V, beams=32),
    "opv2v-16": replace(_OPV2V, beams=16),
    "opv2v-roadside": _OPV2V_ROADSIDE,
    "opv2v-roadside-32": replace(_OPV2V_ROADSIDE, beams=32),
    "opv2v-roadside-16": replace(_OPV2V_ROADSIDE, beams=16),
    "dair-vehicle": LidarSpec(beams=40, lower_rad=math.radians(-16), upper_rad=math.radians(7), height_m=1.9),
    "dair-infrastructure": LidarSpec(
        beams=300,
        per_turn=1800,
        lower_rad=math.radians(-34),
        upper_rad=math.radians(6),
        sector_rad=math.radians(100),
        max_range_m=200.0,
        height_m=6.0,
        drop_general=0.05,
    ),
}


def lidar_spec(name: str) -> LidarSpec:
    """Return a sensor by its name in LIDAR_PRESETS."""
    if name not in LIDAR_PRESETS:
        raise ConfigError(f"No LiDAR '{name}'; choose one of {', '.join(LIDAR_PRESETS)}.")
    return LIDAR_PRESETS[name]


@dataclass(frozen=True)
class RaycastScene:
    """All that a ray can meet at one instant. Instances: a vehicle's id (> 0), a pole's agent (< 0), 0 for anything else."""

    solids: Primitives
    ground: HeightField


class _HitArrays(NamedTuple):
    """The columns of :class:`Hits <manyeyes.ops.raycast.Hits>`, all (A, B)."""

    range_m: F64x2
    primitive: I32x2
    cosine: F64x2
    surface: U8x2


class _Directions(NamedTuple):
    """Cosines and sines of elevations (B,) and azimuths (A,), and the fraction of the turn at each azimuth (A,)."""

    cos_elevation: F64x1
    sin_elevation: F64x1
    cos_azimuth: F64x1
    sin_azimuth: F64x1
    turn_fraction: F64x1


class _TargetArrays(NamedTuple):
    """Reflectivity (N,) and instance (N,) of each solid, and reflectivity of each class of the ground."""

    reflectivity: F64x1
    surface_reflectivity: F64x1
    instance: I64x1


class _Draws(NamedTuple):
    """Random numbers of each ray (A, B): a standard normal and a uniform one."""

    noise: F32x2
    uniform: F32x2


class _ReturnModel(NamedTuple):
    """Noise and drop-out of :class:`LidarSpec`, its height in metres, and the period of a turn in seconds."""

    range_sigma_m: float
    drop_general: float
    drop_dark: float
    drop_limit: float
    drop_grazing: float
    height_m: float
    period_s: float


@njit(cache=True)
def _assemble(
    hits: _HitArrays, rays: _Directions, targets: _TargetArrays, draws: _Draws, spec: _ReturnModel
) -> tuple[F32x2, I64x1]:
    """Kept returns as rows x, y, z (agent frame), intensity, time (K, 5), and their instances (K,)."""
    depth, owner, cosine, surface = hits
    cos_el, sin_el, cos_az, sin_az, turned = rays
    reflectivity, surface_reflectivity, instance = targets
    noise, luck = draws
    sigma, general, dark, limit, grazing, height, period = spec
    count = 0
    out, who = np.empty((depth.size, 5), np.float32), np.empty(depth.size, np.int64)
    for a in range(depth.shape[0]):
        for b in range(depth.shape[1]):
            index = owner[a, b]
            if index == NOTHING:
                continue
            t = depth[a, b]
            signal = math.exp(-ATTENUATION * t)
            lost = general + dark * max(0.0, 1.0 - signal / limit) + grazing * max(0.0, 1.0 - cosine[a, b] / 0.1)
            if luck[a, b] < lost:
                continue
            bright = surface_reflectivity[surface[a, b]] if index == GROUND else reflectivity[index]
            t += sigma * noise[a, b]
            out[count, 0] = t * cos_el[b] * cos_az[a]
            out[count, 1] = t * cos_el[b] * sin_az[a]
            out[count, 2] = t * sin_el[b] + height
            out[count, 3] = min(1.0, max(0.0, bright * (0.5 + 0.5 * math.sqrt(cosine[a, b])) * signal))
            out[count, 4] = (turned[a] - 1.0) * period
            who[count] = 0 if index == GROUND else instance[index]
            count += 1
    return out[:count].copy(), who[:count].copy()


def scan(
    scene: RaycastScene, world_from_agent: Transform, spec: LidarSpec, key: tuple[int | str, ...], own: int = 0
) -> tuple[PointCloud, NDArray[np.int64]]:
    """Return one sweep from a sensor spec.height_m above the road: the cloud in the agent's frame, and the instance of each
    return.

    own: the instance that carries the sensor, which is not met. key: the same key gives the same noise, drop-out and foliage.
    """
    random = keyed_generator(*key, "lidar")
    rotation = np.ascontiguousarray(world_from_agent.rotation.numpy(), np.float64)
    origin = world_from_agent.translation.numpy() + spec.height_m * rotation[:, 2]
    solids = scene.solids[(scene.solids.instance != own) | (scene.solids.instance == 0)] if own else scene.solids
    foliage = int(random.integers(2**63))
    hits = cast_rays(
        solids,
        scene.ground,
        SensorPose(origin, rotation),
        spec.elevation,
        spec.azimuth,
        spec.per_turn,
        spec.max_range_m,
        foliage,
    )
    shape = hits.range_m.shape
    azimuth, elevation = spec.azimuth, spec.elevation
    turn_fraction = (azimuth + math.pi) / (2 * math.pi)
    rows, instance = _assemble(
        _HitArrays(hits.range_m, hits.primitive, hits.cosine, hits.surface),
        _Directions(np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth), turn_fraction),
        _TargetArrays(solids.reflectivity, SURFACE_REFLECTIVITY, solids.instance),
        _Draws(random.standard_normal(shape, np.float32), random.random(shape, np.float32)),
        _ReturnModel(
            spec.range_sigma_m,
            spec.drop_general,
            spec.drop_dark,
            spec.drop_limit,
            spec.drop_grazing,
            spec.height_m,
            1.0 / spec.rate_hz,
        ),
    )
    cloud = torch.from_numpy(rows)
    return PointCloud(cloud[:, :3].contiguous(), cloud[:, 3].contiguous(), cloud[:, 4].contiguous()), instance
