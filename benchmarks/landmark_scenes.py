# SPDX-License-Identifier: Apache-2.0
"""Scenes of boxes for pose correction: detections of a vehicle and a roadside unit at a crossing, and the true poses.

No sensor is simulated, so a thousand scenes take seconds. Two six-lane roads cross; vehicles drive in lanes and stand
parked in rows, so that chance agreement is as frequent as in traffic. The number of common objects is given, or drawn from the
counts of DAIR-V2X's official labels. Visible objects are drawn independently at each instant; there is no model of occlusion,
errors of boxes are independent, and an agent's own motion is known exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import Boxes, ConfigError
from manyeyes.ops.keyed_random import keyed_generator

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DAIR_COMMON = (1784, 584, 612, 503, 478, 584, 633, 616, 415, 261, 110, 31, 5)
"""Frames of DAIR-V2X with 0, 1, ... 12 boxes in common, of 6,616, counted on the official labels."""

_LANES_M = (1.75, 5.25, 8.75)
_PARKED_M = 11.6
_HALF_ROAD_M = 140.0
_RANGE_M = 80.0


@dataclass(frozen=True)
class BoxNoise:
    """Errors of detected boxes: sigma_xy_m an axis, sigma_yaw_rad, flip (chance of a heading off by pi), sigma_size_m."""

    sigma_xy_m: float = 0.25
    sigma_yaw_rad: float = math.radians(2.5)
    p_flip: float = 0.03
    sigma_size_m: float = 0.15


@dataclass(frozen=True)
class LandmarkSpec:
    """Numbers of visible objects at each instant.

    num_common: objects that both agents observe, or None to draw the number from DAIR_COMMON. num_ego_only, num_other_only:
    objects that only one observes. disjoint: the other agent stands at another crossing. num_instants: number of instants,
    period_s apart, the last is now.
    """

    num_common: int | None = None
    num_ego_only: int = 18
    num_other_only: int = 24
    noise: BoxNoise = BoxNoise()
    disjoint: bool = False
    num_instants: int = 1
    period_s: float = 1.0

    def __post_init__(self) -> None:
        if min(self.num_ego_only, self.num_other_only, self.num_common or 0) < 0 or self.num_instants < 1:
            raise ConfigError("LandmarkSpec needs counts of at least 0 and at least one instant.")


@dataclass(frozen=True)
class LandmarkScene:
    """ego, other: boxes of each instant, now first, each in the agent's frame of that instant. ego_from_other: (3,) now.

    ego_from_then, other_from_then: (instants, 3) each agent's own motion, its frame now from its frame then. common_pairs: (K, 2)
    rows of boxes, now, of one object. common_xy: (K, 2) true places, in the ego's frame, of the objects in common now.
    """

    ego: tuple[Boxes, ...]
    other: tuple[Boxes, ...]
    ego_from_other: Floats
    ego_from_then: Floats
    other_from_then: Floats
    common_pairs: Ints
    common_xy: Floats


@dataclass(frozen=True)
class _Traffic:
    """pose: (N, 3) at time 0 in the world; speed: (N,) m/s; size: (N, 2)."""

    pose: Floats
    speed: Floats
    size: Floats

    def at(self, time_s: float) -> Floats:
        """Return poses (N, 3) at a time."""
        step = time_s * self.speed
        turn = self.pose[:, 2]
        return self.pose + np.stack((step * np.cos(turn), step * np.sin(turn), 0 * step), 1)


def make_landmark_scene(spec: LandmarkSpec, seed: int, scene: int) -> LandmarkScene:
    """Make one scene, a pure function of the specification, the seed and the number of the scene."""
    rng = keyed_generator(seed, "landmark scene", scene)
    here = _traffic(rng)
    there = _traffic(rng) if spec.disjoint else here
    num_common = int(rng.choice(len(DAIR_COMMON), p=np.array(DAIR_COMMON) / sum(DAIR_COMMON)))
    num_common = num_common if spec.num_common is None else spec.num_common
    ego_now, ego_speed = _vehicle(rng)
    unit = _roadside(rng)
    ego, other, then = [], [], []
    now_common, now_xy = np.zeros((0, 2), np.int64), np.zeros((0, 2))
    for instant in range(spec.num_instants):
        time = -instant * spec.period_s
        pose = ego_now + np.array([np.cos(ego_now[2]), np.sin(ego_now[2]), 0.0]) * ego_speed * time
        rows, other_rows = _select_visible(
            rng, spec, 0 if spec.disjoint else num_common, (here, pose), (there, unit), time
        )
        order, other_order = rng.permutation(len(rows)), rng.permutation(len(other_rows))
        ego.append(_boxes(rng, here, rows[order], pose, time, spec.noise))
        other.append(_boxes(rng, there, other_rows[other_order], unit, time, spec.noise))
        then.append(relative_pose(ego_now, pose))
        if instant == 0 and not spec.disjoint:
            now_common = np.stack((np.argsort(order)[:num_common], np.argsort(other_order)[:num_common]), 1)
            now_xy = _local(here.at(0.0)[rows[:num_common]], pose)[:, :2]
    return LandmarkScene(
        tuple(ego),
        tuple(other),
        relative_pose(ego_now, unit),
        np.array(then),
        np.zeros((spec.num_instants, 3)),
        now_common,
        now_xy,
    )


def relative_pose(a: Floats, b: Floats) -> Floats:
    """a_from_b of two poses (3,) in one frame."""
    return _local(b[None], a)[0]


def _local(poses: Floats, frame: Floats) -> Floats:
    """Return poses (N, 3) as seen from a frame (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    dx, dy = poses[:, 0] - frame[0], poses[:, 1] - frame[1]
    yaw = np.remainder(poses[:, 2] - frame[2] + np.pi, 2 * np.pi) - np.pi
    return np.stack((c * dx + s * dy, c * dy - s * dx, yaw), 1)


def _traffic(rng: np.random.Generator) -> _Traffic:
    """Everything that stands or drives near one crossing; nothing overlaps at time 0."""
    rows = []
    for road in range(2):
        for side in (0, 1):
            for lane in _LANES_M:
                pace = rng.uniform(4.0, 13.0)
                longitudinal = -_HALF_ROAD_M + rng.uniform(0, 15)
                while longitudinal < _HALF_ROAD_M:
                    lateral, turn = -lane + 0.3 * rng.standard_normal(), math.radians(1.5) * rng.standard_normal()
                    rows.append((road, side, longitudinal, lateral, turn, pace))
                    longitudinal += 7.0 + rng.exponential(11.0)
            for leg in (-1, 1):
                if rng.random() < 0.4:
                    continue
                for place in np.arange(18.0, 85.0, 6.5):
                    if rng.random() < 0.7:
                        turn = math.radians(2.0) * rng.standard_normal() + math.pi * (rng.random() < 0.1)
                        row = leg * (place + 0.5 * rng.standard_normal())
                        rows.append((road, side, row, -_PARKED_M + 0.15 * rng.standard_normal(), turn, 0.0))
    road, side, longitudinal, lateral, turn, speed = np.array(rows).T
    direction = road * np.pi / 2 + side * np.pi
    c, s = np.cos(direction), np.sin(direction)
    pose = np.stack((c * longitudinal - s * lateral, s * longitudinal + c * lateral, direction + turn), 1)
    large = rng.random(len(pose)) < 0.1
    length = np.where(large, rng.uniform(5.5, 11.0, len(pose)), 4.5 + 0.3 * rng.standard_normal(len(pose)))
    width = np.where(large, rng.uniform(2.1, 2.6, len(pose)), 1.85 + 0.08 * rng.standard_normal(len(pose)))
    near = np.hypot(*(pose[:, None, :2] - pose[None, :, :2]).transpose(2, 0, 1)) < 4.0
    keep = ~np.tril(near, -1).any(1)
    return _Traffic(pose[keep], speed[keep], np.stack((length, width), 1)[keep])


def _vehicle(rng: np.random.Generator) -> tuple[Floats, float]:
    """Return a vehicle's pose and speed, in a lane within 50 m of the crossing."""
    direction = rng.integers(4) * np.pi / 2
    longitudinal, lateral = rng.uniform(-50, 50), -_LANES_M[rng.integers(3)]
    c, s = np.cos(direction), np.sin(direction)
    return np.array([c * longitudinal - s * lateral, s * longitudinal + c * lateral, direction]), rng.uniform(0, 12)


def _roadside(rng: np.random.Generator) -> Floats:
    """Return a pole's pose at a corner of the crossing, with a uniform heading."""
    corner = np.array([rng.choice([-1.0, 1.0]), rng.choice([-1.0, 1.0])]) * rng.uniform(13, 18, 2)
    return np.array([*corner, rng.uniform(-np.pi, np.pi)])


def _select_visible(
    rng: np.random.Generator,
    spec: LandmarkSpec,
    num_common: int,
    ego: tuple[_Traffic, Floats],
    other: tuple[_Traffic, Floats],
    time: float,
) -> tuple[Ints, Ints]:
    """Return rows that each agent sees: those in common first."""
    near = [np.hypot(*_local(t.at(time), pose)[:, :2].T) < _RANGE_M for t, pose in (ego, other)]
    if spec.disjoint:
        sets = [rng.permutation(np.flatnonzero(n)) for n in near]
        return sets[0][: spec.num_ego_only], sets[1][: spec.num_other_only]
    shared = rng.permutation(np.flatnonzero(near[0] & near[1]))[:num_common]
    left = rng.permutation(np.setdiff1d(np.flatnonzero(near[0]), shared))[: spec.num_ego_only]
    taken = np.concatenate((shared, left))
    right = rng.permutation(np.setdiff1d(np.flatnonzero(near[1]), taken))[: spec.num_other_only]
    return taken, np.concatenate((shared, right))


def _boxes(
    rng: np.random.Generator, traffic: _Traffic, rows: Ints, pose: Floats, time: float, noise: BoxNoise
) -> Boxes:
    """Detections, in the agent's frame, of objects at the rows."""
    n = len(rows)
    local = _local(traffic.at(time)[rows], pose)
    xy = local[:, :2] + noise.sigma_xy_m * rng.standard_normal((n, 2))
    yaw = local[:, 2] + noise.sigma_yaw_rad * rng.standard_normal(n) + np.pi * (rng.random(n) < noise.p_flip)
    size = np.maximum(traffic.size[rows] + noise.sigma_size_m * rng.standard_normal((n, 2)) * np.array([1.0, 0.5]), 0.5)
    sigma = torch.full((n,), noise.sigma_xy_m, dtype=torch.float64)
    return Boxes(
        torch.from_numpy(np.column_stack((xy, np.full(n, 0.8)))),
        torch.from_numpy(np.column_stack((size, np.full(n, 1.6)))),
        torch.from_numpy(yaw),
        torch.from_numpy(rng.uniform(0.3, 1.0, n)),
        torch.zeros(n, dtype=torch.int64),
        torch.full((n,), -1, dtype=torch.int64),
        sigma,
        torch.full((n,), noise.sigma_yaw_rad, dtype=torch.float64),
        torch.full((n,), noise.p_flip, dtype=torch.float64),
        torch.zeros(n, 2, dtype=torch.float64),
    )
