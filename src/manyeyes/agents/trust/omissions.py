# SPDX-License-Identifier: Apache-2.0
"""Omissions: objects that the ego detects for some frames, in free line of sight of a sender that claims to list all it detects.

A byte budget and request maps make missing tokens legitimate; hence only complete lists of objects are checked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from manyeyes.agents.trust.association import Floats, Rows, associate
from manyeyes.agents.trust.claims import Claims
from manyeyes.datatypes import AgentFrame, Boxes
from manyeyes.ops.lidar.box_rays import count_box_rays

PROBE_SIZE_M = (1.0, 1.0, 1.8)
PROBE_STEP_M, END_M = 1.5, 4.0
"""Probes of the line of sight: boxes on the ground, from END_M before the sender to END_M before the object."""
SAME_OBJECT_M = 3.0
"""A claim closer to an object than this, and than two standard deviations, is of it."""


@dataclass(frozen=True)
class OmissionConfig:
    """min_score, min_returns, min_frames: of an own object. max_distance_m: from the sender. min_missing: an
    object that is not claimed in so many consecutive frames is omitted. max_checks: lines of sight of one sender and frame.
    """

    min_score: float = 0.6
    min_returns: int = 30
    min_frames: int = 3
    max_distance_m: float = 40.0
    min_missing: int = 4
    max_checks: int = 4


@dataclass(frozen=True)
class OwnObjects:
    """K objects of the ego, in its frame: xy (K, 2) metres, velocity (K, 2) m/s, num_frames (K,), number of consecutive frames."""

    xy: Floats
    velocity: Floats
    num_frames: Rows

    @classmethod
    def empty(cls) -> OwnObjects:
        """Return an instance without objects."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))

    def follow(self, own: Boxes, rotation: Floats, shift: Floats, seconds: float, min_score: float) -> OwnObjects:
        """Return the objects of this frame, after the motion of the ego, rotation (2, 2) and shift (2,), and of the objects."""
        kept = own[own.score >= min_score]
        xy, velocity = kept.center[:, :2].double().numpy(), kept.velocity.double().numpy()
        partner = associate(xy, (self.xy + self.velocity * seconds) @ rotation.T + shift, 2.0)
        before = self.num_frames[partner.clip(0)] if len(self.num_frames) else np.zeros(len(xy), np.int64)
        return OwnObjects(xy, velocity, np.where(partner >= 0, before + 1, 1))


def count_omitted(before: OwnObjects, xy: Floats, rotation: Floats, shift: Floats) -> OwnObjects:
    """Return the objects that a sender does not claim now, xy (N, 2), with the number of consecutive frames of each."""
    partner = associate(xy, before.xy @ rotation.T + shift, 2.0)
    earlier = before.num_frames[partner.clip(0)] if len(before.num_frames) else np.zeros(len(xy), np.int64)
    return OwnObjects(xy, np.zeros_like(xy), np.where(partner >= 0, earlier + 1, 1))


def find_omitted(frame: AgentFrame, own: Boxes, objects: OwnObjects, claims: Claims, config: OmissionConfig) -> Floats:
    """Return (K, 2) metres: the positions of own objects that a sender omits in this frame."""
    none = np.zeros((0, 2))
    if not claims.is_complete or not len(objects.xy) or claims.age_s > 0.3:
        return none
    sender = np.array(claims.sender_xy)
    from_sender = np.hypot(*(objects.xy - sender).T)
    distance_m = from_sender <= config.max_distance_m
    rows = np.flatnonzero((objects.num_frames >= config.min_frames) & distance_m & (from_sender > 2 * END_M))
    stated = claims.boxes.center[:, :2].double().numpy()
    if not len(rows):
        return none
    gate = max(SAME_OBJECT_M, 2 * float(claims.sigma_m.max())) if len(claims) else SAME_OBJECT_M
    is_claimed = np.hypot(*(objects.xy[rows, None] - stated[None]).transpose(2, 0, 1)).min(1, initial=np.inf) <= gate
    rows = rows[~is_claimed][: config.max_checks]
    confident = own[own.score >= config.min_score]
    is_omitted = [_is_visible(frame, confident, int(row), sender, config) for row in rows]
    return objects.xy[rows[np.array(is_omitted, np.bool_)]]


def _is_visible(frame: AgentFrame, own: Boxes, row: int, sender: Floats, config: OmissionConfig) -> bool:
    """Return whether the ego has returns of an object, and sees through all of the line from a sender to it."""
    origin = torch.tensor([0.0, 0.0, frame.sensor_height_m], dtype=torch.float64)
    box = own[torch.tensor([row])]
    target = box.center[0, :2].double().numpy()
    length = math.dist(sender.tolist(), target.tolist())
    num = max(2, math.ceil((length - 2 * END_M) / PROBE_STEP_M) + 1)
    at = np.linspace(END_M, length - END_M, num)[:, None] / length
    places = torch.from_numpy(sender + at * (target - sender))
    bottom = float(box.center[0, 2] - box.size[0, 2] / 2)
    center = torch.cat((places, torch.full((num, 1), bottom + PROBE_SIZE_M[2] / 2)), 1)
    probes = Boxes.of(center, torch.tensor(PROBE_SIZE_M).repeat(num, 1).double(), torch.zeros(num).double())
    probes = Boxes.cat([box.to(torch.float64), probes])
    rays = count_box_rays(frame.points.xyz, origin, probes, torch.zeros(num + 1))
    is_free = (rays.num_passing[1:] > 0) & (rays.num_hits[1:] == 0)
    return int(rays.num_hits[0]) >= config.min_returns and bool(is_free.all())
