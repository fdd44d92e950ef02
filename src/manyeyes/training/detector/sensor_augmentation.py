# SPDX-License-Identifier: Apache-2.0
"""Sensors of training samples: intensity law, one or two sweeps, spurious returns, and errors of the fitted road plane.

A detector trained on one intensity law fails on the others, so that laws are drawn anew for every sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.lidar.intensity import INTENSITY_KINDS, IntensityKind, IntensityLaw, change_intensity_law

MIXED_INTENSITY_KINDS: tuple[IntensityKind, ...] = (
    "material", "material", "carla", "carla", "constant", "zero", "zero", "low-gain-8bit", "gain-gamma", "gain-gamma",
    "per-beam-gain", "noise",
)  # fmt: skip
"""Kinds of laws of a mixture, drawn uniformly; repeated ones are drawn more often. Shuffled intensity is held out."""


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
    """

    intensity_kinds: tuple[IntensityKind, ...] = MIXED_INTENSITY_KINDS
    shared_law_prob: float = 0.5
    single_sweep_prob: float = 0.25
    spurious_prob: float = 0.1
    max_spurious_fraction: float = 0.02
    max_tilt_rad: float = 0.004
    max_height_error_m: float = 0.06

    def __post_init__(self) -> None:
        odd = [kind for kind in self.intensity_kinds if kind not in INTENSITY_KINDS]
        if odd or not self.intensity_kinds:
            raise ConfigError(
                f"SensorAugmentConfig.intensity_kinds needs at least one of {', '.join(INTENSITY_KINDS)}; got {odd or 'none'}."
            )


@dataclass(frozen=True)
class AgentSensor:
    """What was drawn for the sensor of one agent of a sample, the same in all of its sweeps.

    Attributes:
        law: intensity law of its sweeps.
        is_single_sweep: whether its previous sweeps are missing.
        spurious_fraction: fraction of its returns that are spurious.
        frame_from_measured: error of its levelled frame.
    """

    law: IntensityLaw
    is_single_sweep: bool
    spurious_fraction: float
    frame_from_measured: Transform


class SensorAugmentation:
    """The sensors of one sample, drawn by its key."""

    def __init__(self, config: SensorAugmentConfig, agent_ids: tuple[int, ...], key: tuple[int | str, ...]) -> None:
        rng = keyed_generator("sensor-augment", *key)
        common = draw_intensity_law(config.intensity_kinds, rng) if rng.random() < config.shared_law_prob else None
        self._key = key
        self._sensors = {agent_id: _draw_sensor(config, common, rng) for agent_id in agent_ids}

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
        points = change_intensity_law(frame.points, sensor.law, frame.sensor_height_m, key)
        if not sensor.spurious_fraction:
            return points
        rng = keyed_generator("spurious", *self._key, frame.agent_id, frame.timestamp_ns)
        return add_spurious_returns(points, sensor.spurious_fraction, frame.sensor_height_m, rng)


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
