# SPDX-License-Identifier: Apache-2.0
"""Sensors of training samples: intensity law, one or two sweeps, spurious returns, errors of the fitted road plane, blooming and
motion distortion.

A detector trained on one intensity law fails on the others, so that laws are drawn anew for every sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.lidar.intensity import (
    ATTENUATION_PER_M,
    INTENSITY_KINDS,
    IntensityKind,
    IntensityLaw,
    change_intensity_law,
)

MIXED_INTENSITY_KINDS: tuple[IntensityKind, ...] = (
    "material", "material", "carla", "carla", "constant", "zero", "zero", "low-gain-8bit", "gain-gamma", "gain-gamma",
    "per-beam-gain", "noise",
)  # fmt: skip
"""Kinds of laws of a mixture, drawn uniformly; repeated ones are drawn more often. Shuffled intensity is held out."""
MIN_BLOOMING_REFLECTIVITY = 0.6
"""Reflectivity from which on a target blooms: road paint, signs and number plates (chosen)."""


@dataclass(frozen=True)
class SensorAugmentConfig:
    """What is drawn for the sensors of a sample, whose recording stores material intensity.

    Attributes:
        intensity_kinds: kinds of intensity laws, drawn uniformly; their constants are drawn too.
        shared_law_prob: probability that all agents of a sample have the same law.
        single_sweep_prob: probability that an agent has no previous sweep.
        spurious_prob: probability that an agent's sweeps have spurious returns, as in rain.
        max_spurious_fraction: maximum fraction of returns that are spurious.
        max_tilt_rad: maximum roll and pitch that are left in an agent's frame, as after a fit of the road.
        max_height_error_m: maximum error of the height of the road.
        blooming_prob: probability that bright targets bloom in an agent's sweeps.
        max_blooming_rad: maximum angle by which they grow, at the sensor; it falls linearly with the range.
        blooming_range_m: range from which on nothing blooms.
        distortion_prob: probability that an agent's sweeps are not, or not wholly, compensated for its own speed.
        sweep_period_s: duration of a sweep.
    """

    intensity_kinds: tuple[IntensityKind, ...] = MIXED_INTENSITY_KINDS
    shared_law_prob: float = 0.5
    single_sweep_prob: float = 0.25
    spurious_prob: float = 0.1
    max_spurious_fraction: float = 0.02
    max_tilt_rad: float = 0.004
    max_height_error_m: float = 0.06
    blooming_prob: float = 0.0
    max_blooming_rad: float = 0.015
    blooming_range_m: float = 50.0
    distortion_prob: float = 0.0
    sweep_period_s: float = 0.1

    def __post_init__(self) -> None:
        odd = [kind for kind in self.intensity_kinds if kind not in INTENSITY_KINDS]
        if odd or not self.intensity_kinds:
            raise ConfigError(
                f"SensorAugmentConfig.intensity_kinds needs at least one of {', '.join(INTENSITY_KINDS)}; got {odd or 'none'}."
            )


@dataclass(frozen=True)
class SweepTiming:
    """When a spinning sensor measures each azimuth, before the time of the frame, at which its sweep ends.

    Attributes:
        first_rad: azimuth at which a sweep begins.
        direction: 1 counter-clockwise, -1 clockwise.
        uncompensated_s: part of the duration of a sweep that is not compensated for.
    """

    first_rad: float
    direction: int
    uncompensated_s: float

    def delays(self, azimuth_rad: Tensor) -> Tensor:
        """Return the uncompensated time (N,) from each return to the end of the sweep, seconds."""
        turned = torch.remainder(self.direction * (azimuth_rad - self.first_rad), 2 * math.pi) / (2 * math.pi)
        return (1.0 - turned) * self.uncompensated_s


@dataclass(frozen=True)
class AgentSensor:
    """What was drawn for the sensor of one agent of a sample, the same in all of its sweeps.

    Attributes:
        law: intensity law of its sweeps.
        is_single_sweep: whether its previous sweeps are missing.
        spurious_fraction: fraction of its returns that are spurious.
        frame_from_measured: error of its levelled frame.
        blooming_rad: angle by which bright targets grow, at the sensor; 0 for no blooming.
        distortion: when its returns are measured; None where sweeps are compensated for its speed.
    """

    law: IntensityLaw
    is_single_sweep: bool
    spurious_fraction: float
    frame_from_measured: Transform
    blooming_rad: float = 0.0
    distortion: SweepTiming | None = None


class SensorAugmentation:
    """The sensors of one sample, drawn by its key."""

    def __init__(self, config: SensorAugmentConfig, agent_ids: tuple[int, ...], key: tuple[int | str, ...]) -> None:
        rng = keyed_generator("sensor-augment", *key)
        common = draw_intensity_law(config.intensity_kinds, rng) if rng.random() < config.shared_law_prob else None
        self._key, self._config = key, config
        drawn = {agent_id: _draw_sensor(config, common, rng) for agent_id in agent_ids}
        # Draws of their own generators, so that samples without them stay as they were.
        self._sensors = {
            agent_id: _draw_artefacts(sensor, config, (*key, agent_id)) for agent_id, sensor in drawn.items()
        }

    def sensor(self, agent_id: int) -> AgentSensor:
        """Return what was drawn for an agent of the sample."""
        return self._sensors[agent_id]

    def points(self, frame: AgentFrame) -> PointCloud:
        """Return the sweep of a frame with material intensity as the drawn sensor of its agent measures it.

        Draws of single returns differ between sweeps; the gains of beams do not.
        """
        sensor, key = self._sensors[frame.agent_id], (*self._key, frame.agent_id)
        if sensor.law.kind in ("noise", "shuffled"):
            key = (*key, frame.timestamp_ns)
        points, sweep_key = frame.points, (*self._key, frame.agent_id, frame.timestamp_ns)
        if sensor.blooming_rad:
            rng, range_m = keyed_generator("blooming", *sweep_key), self._config.blooming_range_m
            points = add_blooming(points, sensor.blooming_rad, range_m, frame.sensor_height_m, rng)
        points = change_intensity_law(points, sensor.law, frame.sensor_height_m, key)
        if sensor.spurious_fraction:
            rng = keyed_generator("spurious", *sweep_key)
            points = add_spurious_returns(points, sensor.spurious_fraction, frame.sensor_height_m, rng)
        return points if sensor.distortion is None else distort(points, sensor.distortion, frame.speed_mps)


def draw_intensity_law(kinds: tuple[IntensityKind, ...], rng: np.random.Generator) -> IntensityLaw:
    """Draw a law and its constants: gains and exponents log-uniform, floors uniform."""
    kind = kinds[int(rng.integers(len(kinds)))]
    if kind == "constant":
        return IntensityLaw(kind, floor=float(rng.random()))
    if kind == "low-gain-8bit":
        return IntensityLaw(kind, gain=_draw_log_uniform(0.015, 0.3, rng))
    if kind == "gain-gamma":
        gain, gamma = _draw_log_uniform(0.2, 3.0, rng), _draw_log_uniform(0.4, 2.0, rng)
        return IntensityLaw(kind, gain, gamma, float(0.3 * rng.random()))
    return IntensityLaw(kind)


def add_spurious_returns(
    points: PointCloud, fraction: float, sensor_height_m: float, rng: np.random.Generator
) -> PointCloud:
    """Return the cloud with a fraction of its returns moved along their rays towards the sensor, as drops of rain return them.

    Args:
        points: in the agent's frame, whose sensor is sensor_height_m above the origin.
        fraction: of returns that are moved, in [0, 1].
        sensor_height_m: height of the sensor above the origin.
        rng: of the draws.
    """
    moved = np.flatnonzero(rng.random(len(points)) < fraction)
    row = torch.from_numpy(moved)
    factor = torch.from_numpy(rng.uniform(0.05, 0.95, (len(moved), 1)).astype(np.float32))
    origin = points.xyz.new_tensor([0.0, 0.0, sensor_height_m])
    xyz, intensity = points.xyz.clone(), points.intensity.clone()
    xyz[row] = origin + (xyz[row] - origin) * factor
    intensity[row] = intensity[row] * torch.from_numpy(rng.random(len(moved)).astype(np.float32))
    return PointCloud(xyz, intensity, points.time_s)


def add_blooming(
    points: PointCloud, angle_rad: float, range_m: float, sensor_height_m: float, rng: np.random.Generator
) -> PointCloud:
    """Return the cloud with a copy of each bright return beside it, at the same range.

    Rays that just miss a bright target, such as a number plate or a sign, return from it too.

    Args:
        points: with material intensity, in the agent's frame, whose sensor is sensor_height_m above the origin.
        angle_rad: maximum angle between a bright ray and its copy, at the sensor; it falls linearly to 0 at range_m.
        range_m: range from which on nothing blooms.
        sensor_height_m: height of the sensor above the origin.
        rng: of the draws.
    """
    origin = points.xyz.new_tensor([0.0, 0.0, sensor_height_m])
    ray = points.xyz - origin
    distance = ray.norm(dim=1)
    reflectivity = points.intensity * torch.exp(ATTENUATION_PER_M * distance)
    row = ((reflectivity >= MIN_BLOOMING_REFLECTIVITY) & (distance < range_m)).nonzero()[:, 0]
    angle = angle_rad * (1 - distance[row] / range_m) * torch.from_numpy(rng.random(len(row)).astype(np.float32))
    around = torch.from_numpy(rng.uniform(0, 2 * math.pi, len(row)).astype(np.float32))
    azimuth = torch.atan2(ray[row, 1], ray[row, 0]) + angle * around.cos()
    elevation = torch.atan2(ray[row, 2], ray[row, :2].norm(dim=1)) + angle * around.sin()
    flat = distance[row] * elevation.cos()
    copies = torch.stack((flat * azimuth.cos(), flat * azimuth.sin(), distance[row] * elevation.sin()), 1) + origin
    return PointCloud.cat([points, replace(points[row], xyz=copies)])


def distort(points: PointCloud, timing: SweepTiming, speed_mps: float) -> PointCloud:
    """Return the cloud as a sensor measures it that drives along x and is not compensated: what it measured earlier lies ahead.

    What stands still is assumed; points: in the agent's frame at the end of the sweep.
    """
    shift = torch.zeros_like(points.xyz)
    shift[:, 0] = speed_mps * timing.delays(torch.atan2(points.xyz[:, 1], points.xyz[:, 0]))
    return replace(points, xyz=points.xyz + shift)


def _draw_artefacts(sensor: AgentSensor, config: SensorAugmentConfig, key: tuple[int | str, ...]) -> AgentSensor:
    """Return the sensor with what is drawn of blooming and distortion."""
    rng = keyed_generator("sensor-artefacts", *key)
    is_blooming, is_distorted = rng.random() < config.blooming_prob, rng.random() < config.distortion_prob
    blooming_rad = config.max_blooming_rad * float(rng.random()) if is_blooming else 0.0
    first_rad, direction = float(rng.uniform(-math.pi, math.pi)), 1 if rng.random() < 0.5 else -1
    timing = SweepTiming(first_rad, direction, config.sweep_period_s * float(rng.random()))
    return replace(sensor, blooming_rad=blooming_rad, distortion=timing if is_distorted else None)


def _draw_sensor(config: SensorAugmentConfig, common: IntensityLaw | None, rng: np.random.Generator) -> AgentSensor:
    own = draw_intensity_law(config.intensity_kinds, rng)
    is_single = bool(rng.random() < config.single_sweep_prob)
    spurious = float((rng.random() < config.spurious_prob) * config.max_spurious_fraction * rng.random())
    roll, pitch = config.max_tilt_rad * rng.uniform(-1, 1, 2)
    height_m = config.max_height_error_m * rng.uniform(-1, 1)
    zero = torch.zeros((), dtype=torch.float64, device="cpu")
    error = Transform.from_rpy(zero.new_tensor([0.0, 0.0, height_m]), zero + roll, zero + pitch, zero)
    return AgentSensor(common or own, is_single, spurious, error)


def _draw_log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))
