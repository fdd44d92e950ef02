# SPDX-License-Identifier: Apache-2.0
"""Places of false objects around an ego, chosen by what a sweep shows: on road that is seen, or where nothing is seen.

A white box uses the sweep of the ego, every other attacker its own.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from manyeyes.datatypes import AgentFrame, Boxes, Message, Transform
from manyeyes.evaluation.attacks.sight import MIN_CHECKING_RAYS, count_rays
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.attacks.interface import AttackInput, AttackKey, Placement
from manyeyes.studies.attacks.message_edit import CAR_SIZE, list_objects

NUM_CANDIDATES = 400
MIN_GAP_M = 4.5
"""Minimum distance of a false object from all detected objects, and from other false ones."""
NEAR_M, FAR_M = 8.0, 40.0
AHEAD_M, AHEAD_ASIDE_M = (8.0, 25.0), 3.0
FLAT_GROUND_M, GROUND_RADIUS_M = 0.3, 2.5


def choose_places(given: AttackInput, key: AttackKey, placement: Placement, count: int, draw: int = 0) -> Boxes:
    """Return up to count boxes of false cars, world frame, float64, with the ids 0, 1, ...; draw: number of the random draw."""
    candidates = _draw_candidates(given.victim_pose, key, placement, draw)
    observer = given.frame if given.victim is None else given.victim.frame
    here = candidates.transform(observer.world_from_agent.inverse())
    free = _distance_to_objects(candidates.center[:, :2], given) >= MIN_GAP_M
    order = _rank(observer, here, placement, free)
    chosen: list[int] = []
    for row in order.tolist():
        gaps = [float((candidates.center[row] - candidates.center[other])[:2].norm()) for other in chosen]
        if len(chosen) < count and min(gaps, default=math.inf) >= MIN_GAP_M:
            chosen.append(row)
    boxes = candidates[torch.tensor(chosen, dtype=torch.int64)]
    return Boxes(**{**vars(boxes), "id": torch.arange(len(boxes))})


def _draw_candidates(victim_pose: Transform, key: AttackKey, placement: Placement, draw: int) -> Boxes:
    """Return NUM_CANDIDATES cars on the ground plane of the ego, parallel to it, world frame."""
    unit = keyed_uniform((NUM_CANDIDATES, 2), key.seed, "false objects", key.scenario, key.group, draw)
    if placement == "ahead":
        x = AHEAD_M[0] + unit[:, 0] * (AHEAD_M[1] - AHEAD_M[0])
        y = (2 * unit[:, 1] - 1) * AHEAD_ASIDE_M
    else:
        radius, angle = NEAR_M + unit[:, 0] * (FAR_M - NEAR_M), 2 * math.pi * unit[:, 1]
        x, y = radius * angle.cos(), radius * angle.sin()
    center = torch.stack((x, y, torch.full_like(x, CAR_SIZE[2] / 2)), 1)
    size = torch.tensor(CAR_SIZE, dtype=torch.float64).expand(len(x), 3)
    return Boxes.of(center, size, torch.zeros_like(x)).transform(victim_pose)


def _rank(observer: AgentFrame, boxes: Boxes, placement: Placement, free: Tensor) -> Tensor:
    """Return rows of candidates, in the observer's frame, that fit the placement, in the order of their draw."""
    if placement == "ahead":
        return free.nonzero()[:, 0]
    rows = free.nonzero()[:, 0]
    counts = count_rays(observer, boxes[rows])
    crossing, inside = torch.from_numpy(counts.num_crossing), torch.from_numpy(counts.num_inside)
    if placement == "blind":
        return rows[(crossing == 0) & (inside == 0)]
    is_road = _has_ground(observer, boxes[rows].center)
    return rows[(crossing >= 2 * MIN_CHECKING_RAYS) & (inside == 0) & is_road]


def _has_ground(observer: AgentFrame, centers: Tensor) -> Tensor:
    """Return (N,) bool: whether ground is seen near the foot of a box."""
    points = observer.points.xyz.double()
    flat = points[points[:, 2].abs() <= FLAT_GROUND_M][:, :2]
    if not len(flat) or not len(centers):
        return torch.zeros(len(centers), dtype=torch.bool)
    return (torch.cdist(centers[:, :2].double(), flat) <= GROUND_RADIUS_M).any(1)


def _distance_to_objects(xy: Tensor, given: AttackInput) -> Tensor:
    """Return (N,) metres from places in the world to the nearest object of any known message, and to all agents."""
    # Colluding white boxes know the same, and choose the same places.
    known = (given.victim.own, *given.victim.messages) if given.victim else (given.message, *given.received)
    places = [message.world_from_agent.translation[None, :2] for message in known]
    places.append(given.victim_pose.translation[None, :2])
    for message in known:
        places.append(object_centers(message))
    return torch.cdist(xy, torch.cat(places).double()).amin(1)


def object_centers(message: Message, min_score: float = 0.2) -> Tensor:
    """Return (M, 2) world positions of the objects of a message: its boxes, or the proposals of its tokens."""
    xy = list_objects(message, min_score).center[:, :2].double()
    return message.world_from_agent.apply(torch.cat((xy, xy.new_zeros(len(xy), 1)), 1))[:, :2]
