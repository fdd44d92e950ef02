# SPDX-License-Identifier: Apache-2.0
"""Scenes of boxes for pose correction: detections of two agents at a crossing, and the true poses.

No sensor is simulated, so a thousand scenes take seconds. True scenes have a given number of common objects, or one drawn from the
counts of DAIR-V2X's official labels. Null scenes have none: agents at two crossings, at one crossing with different objects, or at
one crossing minutes apart, where lanes and some parked vehicles are the same. Errors of boxes: landmark_errors.py. Visible objects
are drawn independently at each instant; there is no model of occlusion, and an agent's own motion is known exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import AgentBody, Boxes, ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.fleet.landmark_errors import (
    BoxNoise,
    MeasuredBoxErrors,
    draw_latent,
    make_errors,
    step_latent,
)
from manyeyes.simulator.fleet.landmark_traffic import (
    Traffic,
    make_later_traffic,
    make_traffic,
    place_roadside_unit,
    place_vehicle,
    place_vehicle_near,
    relative_pose,
    to_frame,
)
from manyeyes.simulator.fleet.street_layouts import StreetLayout, make_street_traffic, place_beside_road, place_in_lane

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DAIR_COMMON = (1784, 584, 612, 503, 478, 584, 633, 616, 415, 261, 110, 31, 5)
"""Frames of DAIR-V2X with 0, 1, ... 12 boxes in common, of 6,616, counted on the official labels."""
Placement = Literal["roadside", "near", "beside", "ahead"]
"""Where the other agent is: a roadside unit, or a vehicle 10 to 40 m away, beside the ego or ahead of it."""

_RANGE_M = 80.0
_BODY_SIZE_M = (4.5, 1.9, 1.6)
_BODY_CLEARANCE_M = 5.0


@dataclass(frozen=True)
class SensorClutter:
    """False boxes that do not move with the agent: num_boxes within radius_m of the sensor; shared_fraction of them are at the same
    places in both agents' frames, within sigma_m and sigma_yaw_rad.
    """

    num_boxes: int = 0
    shared_fraction: float = 1.0
    radius_m: float = 60.0
    sigma_m: float = 0.1
    sigma_yaw_rad: float = 0.03


@dataclass(frozen=True)
class LandmarkSpec:
    """Numbers of visible objects at each instant.

    num_common: objects that both agents observe, or None to draw the number from DAIR_COMMON. num_ego_only, num_other_only:
    objects that only one observes. disjoint: the other agent stands at another crossing. num_instants: number of instants,
    period_s apart, the last is now. parked_fraction: where it is given, the other agent observes the crossing minutes later, with
    this fraction of the parked vehicles still there. body_offset_m: where it is given, both agents are vehicles that observe each
    other, and their middles are so far ahead of the origins of their frames; bodies are not counted in num_common. layout: of the
    streets, and other_layout where the other agent is elsewhere; None: the crossing of landmark_traffic.py.
    """

    num_common: int | None = None
    num_ego_only: int = 18
    num_other_only: int = 24
    noise: BoxNoise | MeasuredBoxErrors = BoxNoise()
    disjoint: bool = False
    num_instants: int = 1
    period_s: float = 1.0
    parked_fraction: float | None = None
    clutter: SensorClutter = SensorClutter()
    placement: Placement = "roadside"
    body_offset_m: float | None = None
    layout: StreetLayout | None = None
    other_layout: StreetLayout | None = None

    def __post_init__(self) -> None:
        if min(self.num_ego_only, self.num_other_only, self.num_common or 0) < 0 or self.num_instants < 1:
            raise ConfigError("LandmarkSpec needs counts of at least 0 and at least one instant.")
        if self.body_offset_m is not None and self.placement == "roadside":
            raise ConfigError("LandmarkSpec.body_offset_m needs two vehicles: a placement near, beside or ahead.")

    @property
    def is_null(self) -> bool:
        """Whether no object is observed by both at one instant, but for parked vehicles."""
        return self.disjoint or self.parked_fraction is not None


@dataclass(frozen=True)
class LandmarkScene:
    """ego, other: boxes of each instant, now first, each in the agent's frame of that instant. ego_from_other: (3,) now.

    ego_from_then, other_from_then: (instants, 3) each agent's own motion, its frame now from its frame then. common_pairs: (K, 2)
    rows of boxes, now, of one object. common_xy: (K, 2) true places, in the ego's frame, of the objects in common now. body: of
    both agents, in their frames; None where bodies are not observed.
    """

    ego: tuple[Boxes, ...]
    other: tuple[Boxes, ...]
    ego_from_other: Floats
    ego_from_then: Floats
    other_from_then: Floats
    common_pairs: Ints
    common_xy: Floats
    body: AgentBody | None = None


def make_landmark_scene(spec: LandmarkSpec, seed: int, scene: int) -> LandmarkScene:
    """Make one scene, a pure function of the specification, the seed and the number of the scene."""
    rng = keyed_generator(seed, "landmark scene", scene)
    here = _make_traffic(spec.layout, rng)
    there = _make_traffic(spec.other_layout, rng) if spec.disjoint else here
    num_common = int(rng.choice(len(DAIR_COMMON), p=np.array(DAIR_COMMON) / sum(DAIR_COMMON)))
    num_common = num_common if spec.num_common is None else spec.num_common
    ego_now, ego_speed = place_vehicle(rng) if spec.layout is None else place_in_lane(spec.layout, rng)
    unit_layout = spec.other_layout if spec.disjoint else spec.layout
    unit = place_roadside_unit(rng) if unit_layout is None else place_beside_road(unit_layout, rng)
    # Draws of their own, so that they leave the scenes of simpler specifications as they are.
    extra_rng = keyed_generator(seed, "landmark extras", scene)
    if spec.parked_fraction is not None:
        there = make_later_traffic(here, extra_rng, spec.parked_fraction, partial(_make_traffic, spec.layout))
    if spec.placement != "roadside":
        unit = place_vehicle_near(ego_now, spec.placement, extra_rng)
    observers = _SceneObserver(spec, here, extra_rng), _SceneObserver(spec, there, extra_rng)
    ego, other, then = [], [], []
    now_common, now_xy = np.zeros((0, 2), np.int64), np.zeros((0, 2))
    for instant in range(spec.num_instants):
        time = -instant * spec.period_s
        pose = ego_now + np.array([np.cos(ego_now[2]), np.sin(ego_now[2]), 0.0]) * ego_speed * time
        rows, other_rows = _select_visible(
            rng, spec, 0 if spec.is_null else num_common, (here, pose), (there, unit), time
        )
        order, other_order = rng.permutation(len(rows)), rng.permutation(len(other_rows))
        clutter = _make_clutter(spec.clutter, extra_rng)
        for boxes, observer, visible, frame, false_boxes in (
            (ego, observers[0], rows[order], (pose, unit), clutter[0]),
            (other, observers[1], other_rows[other_order], (unit, pose), clutter[1]),
        ):
            boxes.append(Boxes.cat([observer.detect(rng, visible, *frame, time), *false_boxes]))
        then.append(relative_pose(ego_now, pose))
        if instant == 0 and not spec.is_null:
            now_common = np.stack((np.argsort(order)[:num_common], np.argsort(other_order)[:num_common]), 1)
            now_xy = to_frame(here.at(0.0)[rows[:num_common]], pose)[:, :2]
    return LandmarkScene(
        tuple(ego),
        tuple(other),
        relative_pose(ego_now, unit),
        np.array(then),
        np.zeros((spec.num_instants, 3)),
        now_common,
        now_xy,
        None if spec.body_offset_m is None else AgentBody.standing(spec.body_offset_m, 0.0, _BODY_SIZE_M),
    )


def _make_traffic(layout: StreetLayout | None, rng: np.random.Generator) -> Traffic:
    return make_traffic(rng) if layout is None else make_street_traffic(layout, rng)


class _SceneObserver:
    """One agent's detector, whose errors of an object are correlated over time."""

    def __init__(self, spec: LandmarkSpec, traffic: Traffic, rng: np.random.Generator) -> None:
        self.spec, self.traffic, self.rng = spec, traffic, rng
        # The last row is the other agent's body.
        self.latent = draw_latent(len(traffic.pose) + 1, rng)

    def detect(self, rng: np.random.Generator, rows: Ints, pose: Floats, partner: Floats, time: float) -> Boxes:
        """Detect the objects at rows, and the body of the partner, from a pose; the next call is one instant earlier."""
        local, size = to_frame(self.traffic.at(time)[rows], pose), self.traffic.size[rows]
        if self.spec.body_offset_m is not None:
            arm = self.spec.body_offset_m * np.array([np.cos(partner[2]), np.sin(partner[2]), 0.0])
            local = np.concatenate((local, to_frame((partner + arm)[None], pose)))
            size = np.concatenate((size, np.array([_BODY_SIZE_M[:2]])))
            rows = np.append(rows, len(self.traffic.pose))
        noise = self.spec.noise
        if isinstance(noise, BoxNoise):
            return _perturb_independently(rng, local, size, noise)
        errors = make_errors(noise, self.latent[rows])
        self.latent = step_latent(self.latent, noise.autocorrelation, self.rng)
        c, s = np.cos(local[:, 2]), np.sin(local[:, 2])
        xy = local[:, :2] + np.stack(
            (c * errors.xy[:, 0] - s * errors.xy[:, 1], s * errors.xy[:, 0] + c * errors.xy[:, 1]), 1
        )
        score = rng.uniform(0.3, 1.0, len(rows))
        return _make_boxes(xy, local[:, 2] + errors.yaw, size + errors.size, score)


def _select_visible(
    rng: np.random.Generator,
    spec: LandmarkSpec,
    num_common: int,
    ego: tuple[Traffic, Floats],
    other: tuple[Traffic, Floats],
    time: float,
) -> tuple[Ints, Ints]:
    """Return rows that each agent sees: those in common first."""
    near = [np.hypot(*to_frame(t.at(time), pose)[:, :2].T) < _RANGE_M for t, pose in (ego, other)]
    if spec.placement != "roadside":
        # Nothing stands where the vehicles of the agents are.
        for pose in (ego[1], other[1]):
            near = [
                n & (np.hypot(*to_frame(t.at(time), pose)[:, :2].T) > _BODY_CLEARANCE_M)
                for n, (t, _) in zip(near, (ego, other))
            ]
    if spec.is_null:
        sets = [rng.permutation(np.flatnonzero(n)) for n in near]
        return sets[0][: spec.num_ego_only], sets[1][: spec.num_other_only]
    shared = rng.permutation(np.flatnonzero(near[0] & near[1]))[:num_common]
    left = rng.permutation(np.setdiff1d(np.flatnonzero(near[0]), shared))[: spec.num_ego_only]
    taken = np.concatenate((shared, left))
    right = rng.permutation(np.setdiff1d(np.flatnonzero(near[1]), taken))[: spec.num_other_only]
    return taken, np.concatenate((shared, right))


def _make_clutter(clutter: SensorClutter, rng: np.random.Generator) -> tuple[Sequence[Boxes], Sequence[Boxes]]:
    """Return false boxes of both agents, each in its own frame; none where there are none."""
    n = clutter.num_boxes
    if not n:
        return (), ()
    places = [_draw_places(n, clutter.radius_m, rng) for _ in range(2)]
    is_shared = np.arange(n) < round(clutter.shared_fraction * n)
    sides = []
    for place in (places[0], np.where(is_shared[:, None], places[0], places[1])):
        xy = place[:, :2] + clutter.sigma_m * rng.standard_normal((n, 2))
        yaw = place[:, 2] + clutter.sigma_yaw_rad * rng.standard_normal(n)
        size = place[:, 3:] + clutter.sigma_m * rng.standard_normal((n, 2))
        sides.append([_make_boxes(xy, yaw, size, rng.uniform(0.3, 1.0, n))])
    return sides[0], sides[1]


def _draw_places(count: int, radius_m: float, rng: np.random.Generator) -> Floats:
    """Return (N, 5) x, y, yaw, length and width of vehicles anywhere in a disc."""
    radius, angle = radius_m * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    size = np.array([4.5, 1.85]) + np.array([0.3, 0.08]) * rng.standard_normal((count, 2))
    yaw = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), yaw, size))


def _perturb_independently(rng: np.random.Generator, local: Floats, size: Floats, noise: BoxNoise) -> Boxes:
    """Return detections of objects at local poses (N, 3), with the stated Gaussian errors."""
    n = len(local)
    xy = local[:, :2] + noise.sigma_xy_m * rng.standard_normal((n, 2))
    yaw = local[:, 2] + noise.sigma_yaw_rad * rng.standard_normal(n) + np.pi * (rng.random(n) < noise.p_flip)
    size = size + noise.sigma_size_m * rng.standard_normal((n, 2)) * np.array([1.0, 0.5])
    return _make_boxes(xy, yaw, size, rng.uniform(0.3, 1.0, n), (noise.sigma_xy_m, noise.sigma_yaw_rad, noise.p_flip))


def _make_boxes(
    xy: Floats, yaw: Floats, size: Floats, score: Floats, stated: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Boxes:
    """Return boxes that state a standard deviation of position and heading and a probability of a turned heading; 0: none."""
    n = len(xy)
    sigma_xy, sigma_yaw, p_flip = (torch.full((n,), value, dtype=torch.float64) for value in stated)
    return Boxes(
        torch.from_numpy(np.column_stack((xy, np.full(n, 0.8)))),
        torch.from_numpy(np.column_stack((np.maximum(size, 0.5), np.full(n, 1.6)))),
        torch.from_numpy(yaw),
        torch.from_numpy(score),
        torch.zeros(n, dtype=torch.int64),
        torch.full((n,), -1, dtype=torch.int64),
        sigma_xy,
        sigma_yaw,
        p_flip,
        torch.zeros(n, 2, dtype=torch.float64),
    )
