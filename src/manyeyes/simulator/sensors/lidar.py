# SPDX-License-Identifier: Apache-2.0
"""A spinning LiDAR in a scene: returns with noise, drop-out, intensity and the identity of what was met.

One sweep is taken from one pose of a world that stands still: the time of each return is given, but neither the sensor
nor the traffic moves within the sweep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes._jit import F32x2, F64x1, F64x2, I32x2, I64x1, U8x2, njit
from manyeyes.datatypes import PointCloud, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.lidar.intensity import ATTENUATION_PER_M, compute_intensity
from manyeyes.ops.raycast import GROUND, NOTHING, HeightField, Primitives, SensorPose, cast_rays
from manyeyes.simulator.sensors.lidar_spec import BeamUnit, LidarSpec

OFF_ROAD, ASPHALT, PAINT, SIDEWALK, CROSSING = range(5)

# Chosen: near-infrared (905 nm) reflectances of grass and soil, worn asphalt, white thermoplastic, concrete, paint on worn asphalt.
SURFACE_REFLECTIVITY = np.array([0.28, 0.12, 0.75, 0.32, 0.62])

# Spurious returns of the air: mean range in metres, and reflectivity (chosen).
_AIR_RANGE_M, _AIR_REFLECTIVITY = 8.0, 0.1


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
    """Random numbers of each ray (A, B): a standard normal, a uniform one, and a uniform one of the air, (0, 0) in clear air."""

    noise: F32x2
    uniform: F32x2
    air: F32x2


class _ReturnModel(NamedTuple):
    """Noise and drop-out of :class:`LidarSpec`, the head's height in metres, and the period of a turn in seconds."""

    range_sigma_m: float
    drop_general: float
    drop_dark: float
    drop_limit: float
    drop_grazing: float
    spurious_fraction: float
    min_range_m: float
    range_10_percent_m: float
    height_m: float
    period_s: float


@njit(cache=True)
def _assemble(
    hits: _HitArrays, rays: _Directions, targets: _TargetArrays, draws: _Draws, spec: _ReturnModel
) -> tuple[F32x2, I64x1]:
    """Kept returns as rows x, y, z (agent frame), material intensity, time, reflectivity, range (K, 7), and instances (K,)."""
    depth, owner, cosine, surface = hits
    cos_el, sin_el, cos_az, sin_az, turned = rays
    reflectivity, surface_reflectivity, instance = targets
    noise, luck, air = draws
    sigma, general, dark, limit, grazing, spurious, nearest, range_10, height, period = spec
    count = 0
    out, who = np.empty((depth.size, 7), np.float32), np.empty(depth.size, np.int64)
    for a in range(depth.shape[0]):
        for b in range(depth.shape[1]):
            index = owner[a, b]
            t, is_air = depth[a, b], False
            if spurious > 0 and air[a, b] < spurious:
                in_air = nearest - _AIR_RANGE_M * math.log(1.0 - air[a, b] / spurious)
                if in_air < t:
                    t, is_air = in_air, True
            if (index == NOTHING and not is_air) or t < nearest:
                continue
            signal = math.exp(-ATTENUATION_PER_M * t)
            if is_air:
                lost, bright = general, _AIR_REFLECTIVITY
            else:
                lost = general + dark * max(0.0, 1.0 - signal / limit) + grazing * max(0.0, 1.0 - cosine[a, b] / 0.1)
                bright = surface_reflectivity[surface[a, b]] if index == GROUND else reflectivity[index]
                bright *= 0.5 + 0.5 * math.sqrt(cosine[a, b])
                if range_10 > 0 and bright * range_10 * range_10 < 0.1 * t * t:
                    continue
            if luck[a, b] < lost:
                continue
            true_range = t
            t += sigma * noise[a, b]
            out[count, 0] = t * cos_el[b] * cos_az[a]
            out[count, 1] = t * cos_el[b] * sin_az[a]
            out[count, 2] = t * sin_el[b] + height
            out[count, 3] = min(1.0, max(0.0, bright * signal))
            out[count, 4] = (turned[a] - 1.0) * period
            out[count, 5] = bright
            out[count, 6] = true_range
            who[count] = 0 if index == GROUND or is_air else instance[index]
            count += 1
    return out[:count].copy(), who[:count].copy()


def scan(
    scene: RaycastScene,
    world_from_agent: Transform,
    spec: LidarSpec,
    key: tuple[int | str, ...],
    own: int = 0,
    sensor_key: tuple[int | str, ...] = (),
) -> tuple[PointCloud, NDArray[np.int64]]:
    """Return one sweep from a sensor spec.height_m above the road: the cloud in the agent's frame, and the instance of each
    return.

    Args:
        scene: what rays can meet.
        world_from_agent: pose of the agent's frame, whose axes are the sensor's: a tilt is part of it (LidarSpec.agent_pose).
        spec: the sensor.
        key: the same key gives the same noise, drop-out and foliage.
        own: the instance that carries the sensor, which is not met.
        sensor_key: of what stays the same in all sweeps of this sensor, the gains of its beams.
    """
    random = keyed_generator(*key, "lidar")
    solids = scene.solids[(scene.solids.instance != own) | (scene.solids.instance == 0)] if own else scene.solids
    visible = RaycastScene(solids, scene.ground)
    parts = [_scan_unit(visible, world_from_agent, spec, unit, random) for unit in spec.units]
    rows = parts[0][0] if len(parts) == 1 else np.concatenate([part[0] for part in parts])
    instance = parts[0][1] if len(parts) == 1 else np.concatenate([part[1] for part in parts])
    cloud = torch.from_numpy(rows)
    xyz, time_s = cloud[:, :3].contiguous(), cloud[:, 4].contiguous()
    if spec.intensity.kind == "material":
        return PointCloud(xyz, cloud[:, 3].contiguous(), time_s), instance
    elevation = torch.atan2(xyz[:, 2] - spec.height_m, xyz[:, :2].norm(dim=1))
    draws = key if spec.intensity.kind in ("noise", "shuffled") else sensor_key
    intensity = compute_intensity(spec.intensity, cloud[:, 5], cloud[:, 6], elevation, draws)
    return PointCloud(xyz, intensity, time_s), instance


def _scan_unit(
    scene: RaycastScene, world_from_agent: Transform, spec: LidarSpec, unit: BeamUnit, random: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the rows and instances of the returns of one head; see :func:`_assemble`."""
    rotation = np.ascontiguousarray(world_from_agent.rotation.numpy(), np.float64)
    height = spec.height_m + unit.offset_m
    origin = world_from_agent.translation.numpy() + height * rotation[:, 2]
    azimuth, elevation = spec.azimuth, unit.elevation
    foliage = int(random.integers(2**63))
    pose = SensorPose(origin, rotation)
    hits = cast_rays(scene.solids, scene.ground, pose, elevation, azimuth, spec.per_turn, spec.max_range_m, foliage)
    shape = hits.range_m.shape
    turn_fraction = (azimuth + math.pi) / (2 * math.pi)
    noise, uniform = random.standard_normal(shape, np.float32), random.random(shape, np.float32)
    air = random.random(shape if spec.spurious_fraction else (0, 0), np.float32)
    return _assemble(
        _HitArrays(hits.range_m, hits.primitive, hits.cosine, hits.surface),
        _Directions(np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth), turn_fraction),
        _TargetArrays(scene.solids.reflectivity, SURFACE_REFLECTIVITY, scene.solids.instance),
        _Draws(noise, uniform, air),
        _ReturnModel(
            spec.range_sigma_m,
            spec.drop_general,
            spec.drop_dark,
            spec.drop_limit,
            spec.drop_grazing,
            spec.spurious_fraction,
            spec.min_range_m,
            spec.range_10_percent_m,
            height,
            1.0 / spec.rate_hz,
        ),
    )
