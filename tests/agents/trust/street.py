# SPDX-License-Identifier: Apache-2.0
"""A street of boxes on flat ground, scanned by exact rays from the ego at the origin::

        y
        |   wall at x = 20, y = 6 .. 14 hides (30, 15)
    ego +-----------> x      car at (15, 0), free road at (12, -6)

Claims are made by hand; no network is involved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.interface import Assessment, MisbehaviourDetector, MisbehaviourInput, SenderAssessment
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Transform

TENTH_NS = 100_000_000
HEIGHT_M, RANGE_M = 1.9, 80.0
CAR, WALL = (4.5, 1.9, 1.6), (0.5, 8.0, 3.0)
SEEN, SEEN_TOO, HIDDEN, FREE, FREE_TOO = (15.0, 0.0), (12.0, 12.0), (30.0, 15.0), (12.0, -6.0), (18.0, -8.0)
OTHER_AGENT = (25.0, -4.0)


def cars(*places: tuple[float, float], score: float = 0.9) -> Boxes:
    """Cars along x."""
    n = len(places)
    center = torch.tensor([[x, y, CAR[2] / 2] for x, y in places], dtype=torch.float64).reshape(n, 3)
    size = torch.tensor(CAR, dtype=torch.float64).repeat(n, 1)
    return Boxes.of(center, size, torch.zeros(n).double(), torch.full((n,), score).double())


def wall() -> Boxes:
    return Boxes.of(torch.tensor([[20.0, 10.0, 1.5]]).double(), torch.tensor([WALL]).double(), torch.zeros(1).double())


def scan(solid: Boxes) -> torch.Tensor:
    """First returns (N, 3) of 720 by 40 rays on ground and boxes; rays that meet nothing return from RANGE_M."""
    azimuth, elevation = torch.meshgrid(
        torch.arange(720).double() * math.radians(0.5), torch.linspace(-0.3, 0.03, 40).double(), indexing="ij"
    )
    ray = torch.stack((azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()), -1)
    ray = ray.reshape(-1, 3)
    distance = torch.where(ray[:, 2] < 0, -HEIGHT_M / ray[:, 2].clamp_max(-1e-9), RANGE_M).clamp_max(RANGE_M)
    origin = torch.tensor([0.0, 0.0, HEIGHT_M]).double()
    for center, size in zip(solid.center, solid.size):
        one, two = (center - size / 2 - origin) / ray, (center + size / 2 - origin) / ray
        enter, leave = torch.minimum(one, two).amax(1), torch.maximum(one, two).amin(1)
        distance = torch.where((enter > 0) & (enter < leave) & (enter < distance), enter, distance)
    return origin + ray * distance[:, None]


@dataclass
class Street:
    """The ego's view over time. solid: what is there; own: what the ego detects. spoil: changes the returns of a frame. stated:
    positions that senders state in their own frames, by id. sender_places: of senders, by id; others are 5 m apart.
    """

    detector: MisbehaviourDetector
    solid: Boxes = field(default_factory=lambda: Boxes.cat([cars(SEEN, SEEN_TOO, HIDDEN), wall()]))
    own: Boxes = field(default_factory=lambda: cars(SEEN, SEEN_TOO))
    spoil: Callable[[torch.Tensor, int], torch.Tensor] = lambda points, index: points
    state: object | None = None
    index: int = 0
    stated: Mapping[int, np.ndarray] = field(default_factory=dict)
    is_infrastructure: bool = False
    sender_places: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def step(
        self,
        claims: Mapping[int, Boxes],
        sigma_m: float = 0.1,
        sender_xy: tuple[float, float] = OTHER_AGENT,
        is_complete: bool = False,
        faulty: Sequence[int] = (),
    ) -> Assessment:
        """Assess the claims of senders in the next frame."""
        now_ns = TENTH_NS * (self.index + 1)
        points = self.spoil(scan(self.solid), self.index)
        pose = Transform.identity()
        frame = AgentFrame.of(PointCloud.of(points), pose, 0, now_ns, sensor_height_m=HEIGHT_M)
        frame = replace(frame, is_infrastructure=self.is_infrastructure)
        stated = tuple(
            replace(
                Claims.of(agent_id, boxes, np.full(len(boxes), sigma_m)),
                sender_xy=self.sender_places.get(agent_id, (sender_xy[0], sender_xy[1] - 5.0 * number)),
                is_complete=is_complete,
                stated_xy=self.stated.get(agent_id),
            )
            for number, (agent_id, boxes) in enumerate(sorted(claims.items()))
        )
        messages = tuple(Message(one.agent_id, now_ns, pose, torch.zeros(3, 3).double()) for one in stated)
        content = MisbehaviourInput(
            frame, self.own, messages, lambda: stated, lambda senders: self.fused(claims, senders), frozenset(faulty)
        )
        found = self.detector.assess(content, self.state)
        self.state, self.index = found.state, self.index + 1
        return found

    def fused(self, claims: Mapping[int, Boxes], senders: Collection[int]) -> Boxes:
        """The boxes of the ego and of some senders, one at each place."""
        found = [self.own]
        for sender in sorted(senders):
            kept = Boxes.cat(found)
            far = torch.cdist(claims[sender].center[:, :2], kept.center[:, :2]).min(1).values > 2.0
            found.append(claims[sender][far])
        return Boxes.cat(found)

    def run(self, num_frames: int, claims: Mapping[int, Boxes], **options: object) -> Assessment:
        """Assess the same claims in each of some frames; return the last assessment."""
        return [self.step(claims, **options) for _ in range(num_frames)][-1]  # type: ignore[arg-type]


def sender(found: Assessment, agent_id: int) -> SenderAssessment:
    (one,) = (s for s in found.senders if s.agent_id == agent_id)
    return one


def kinds(found: Assessment, agent_id: int) -> list[int]:
    """The evidence on the claims of one sender."""
    assert found.claims is not None
    (one,) = (c for c in found.claims if c.agent_id == agent_id)
    return one.evidence.tolist()
