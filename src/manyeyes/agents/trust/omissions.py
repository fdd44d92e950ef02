# SPDX-License-Identifier: Apache-2.0
"""Omissions: objects that the ego detects for some frames, in free line of sight of a sender that claims to list all it detects.

A byte budget and request maps make missing tokens legitimate; hence only complete lists of objects are checked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from manyeyes._jit import I64x2
from manyeyes.agents.trust.association import Floats, Rows, associate, find_nearest
from manyeyes.agents.trust.claims import Claims

PROBE_SIZE_M = (1.0, 1.0, 1.8)
PROBE_STEP_M, END_M = 1.5, 4.0
"""Probes of the line of sight: boxes on the ground, from END_M before the sender to END_M before the object."""
SAME_OBJECT_M = 3.0
"""A claim closer to an object than this, and than two standard deviations, is of it."""


@dataclass(frozen=True)
class OmissionConfig:
    """min_score, min_returns, min_frames: of an own object. max_distance_m: from the sender. max_age_s: of a message. min_missing:
    an object that is not claimed in so many consecutive frames is omitted.
    """

    min_score: float = 0.6
    min_returns: int = 30
    min_frames: int = 3
    max_distance_m: float = 40.0
    max_age_s: float = 0.3
    min_missing: int = 4


@dataclass(frozen=True)
class OwnObjects:
    """K objects of the ego, in its frame: columns (K, 7) centre, size and yaw; velocity (K, 2) m/s; num_frames (K,), the number of
    consecutive frames.
    """

    columns: Floats
    velocity: Floats
    num_frames: Rows

    @classmethod
    def empty(cls) -> OwnObjects:
        """Return an instance without objects."""
        return cls(np.zeros((0, 7)), np.zeros((0, 2)), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: Rows) -> OwnObjects:
        return OwnObjects(self.columns[rows], self.velocity[rows], self.num_frames[rows])

    def follow(self, now: OwnObjects, rotation: Floats, shift: Floats, seconds: float) -> OwnObjects:
        """Return the objects of now with their number of frames; rotation (2, 2), shift (2,): motion of the ego since."""
        if not len(now):
            return now
        if not len(self):
            return OwnObjects(now.columns, now.velocity, np.ones(len(now), np.int64))
        expected = (self.columns[:, :2] + self.velocity * seconds) @ rotation.T + shift
        partner = associate(now.columns[:, :2], expected, 2.0)
        earlier = np.append(self.num_frames, 0)[partner]
        return OwnObjects(now.columns, now.velocity, earlier + 1)


_NO_OBJECTS = OwnObjects.empty()


def find_unclaimed(objects: OwnObjects, claims: Claims, config: OmissionConfig) -> OwnObjects:
    """Return the objects that a sender nearby does not claim; none if its list may be incomplete."""
    if not claims.is_complete or not len(objects) or abs(claims.age_s) > config.max_age_s:
        return _NO_OBJECTS
    xy = objects.columns[:, :2]
    distance = np.hypot(xy[:, 0] - claims.sender_xy[0], xy[:, 1] - claims.sender_xy[1])
    is_near = (distance <= config.max_distance_m) & (distance > 2 * END_M) & (objects.num_frames >= config.min_frames)
    gate = max(SAME_OBJECT_M, 2 * float(claims.sigma_m.max())) if len(claims) else SAME_OBJECT_M
    return objects[np.flatnonzero(is_near & (find_nearest(xy, claims.xy, gate) < 0))]


def make_probes(unclaimed: OwnObjects, sender_xy: tuple[float, float], config: OmissionConfig) -> Floats:
    """Return boxes (P, 7) whose rays show whether a sender omits an object: the object, then its line of sight; none if it has
    claimed all. Of several objects the one that is not claimed for longest is tested.
    """
    if not len(unclaimed) or int(unclaimed.num_frames.max()) < config.min_missing:
        return np.zeros((0, 7))
    box = unclaimed.columns[int(unclaimed.num_frames.argmax())]
    length = math.dist(sender_xy, box[:2].tolist())
    num = max(2, math.ceil((length - 2 * END_M) / PROBE_STEP_M) + 1)
    probes = np.zeros((num + 1, 7))
    probes[0] = box
    at = np.linspace(END_M, length - END_M, num)[:, None] / length
    probes[1:, :2] = np.array(sender_xy) + at * (box[:2] - np.array(sender_xy))
    probes[1:, 2] = box[2] - box[5] / 2 + PROBE_SIZE_M[2] / 2
    probes[1:, 3:6] = PROBE_SIZE_M
    return probes


def is_in_sight(rays: I64x2, config: OmissionConfig) -> bool:
    """Return whether the ego has returns of an object, and sees through all of its line of sight; rays (P, 3) of the probes."""
    if not len(rays):
        return False
    passing, hits, _ = rays.T
    return bool(hits[0] >= config.min_returns and (passing[1:] > 0).all() and (hits[1:] == 0).all())
