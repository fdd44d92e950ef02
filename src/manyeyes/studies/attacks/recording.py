# SPDX-License-Identifier: Apache-2.0
"""Records of an attacked drive: what each frame shows of senders and of false claims, gathered while it is played."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from manyeyes.agents.agent import Perception
from manyeyes.agents.trust.interface import SenderStatus
from manyeyes.datatypes import Boxes, Snapshot
from manyeyes.evaluation.attacks.records import NO_EVIDENCE, ClaimRecord, SenderRecord
from manyeyes.evaluation.attacks.sight import count_rays
from manyeyes.studies.attacks.drive import DriveStep

SURVIVAL_RADIUS_M = 2.0
"""A box of the ego within this distance of a false object, and nearer to no real one, rests on it."""
REAL_RADIUS_M = 1.0


@dataclass(frozen=True)
class SenderFrame:
    """A sender in one frame."""

    trust: float = 1.0
    is_named: bool = False
    is_received: bool = False


@dataclass(frozen=True)
class ClaimFrame:
    """A false claim in one frame, as in ClaimRecord."""

    num_rays: int
    num_ego_rays: int
    is_near_real: bool
    score: float
    evidence: int
    trust: float


@dataclass
class DriveRecorder:
    """Rows of one ego since the attack began. malicious: all identities of malicious agents."""

    ego: int
    malicious: frozenset[int]
    num_frames: int = 0
    _senders: dict[int, dict[int, SenderFrame]] = field(default_factory=dict)
    _claims: dict[tuple[int, int], dict[int, ClaimFrame]] = field(default_factory=dict)

    def add(self, played: DriveStep) -> None:
        """Record one frame of the ego."""
        snapshot, perception, at = played.step.snapshot, played.step.perception, self.num_frames
        self.num_frames += 1
        for sender, row in find_sender_frames(perception).items():
            self._senders.setdefault(sender, {})[at] = row
        for sender, claims in played.claims.items():
            boxes = claims.invented
            rows = self._describe_claims(snapshot, perception, boxes, sender) if len(boxes) else ()
            for claim, row in zip(boxes.id.tolist(), rows):
                self._claims.setdefault((sender, claim), {})[at] = row

    def _describe_claims(
        self, snapshot: Snapshot, perception: Perception, world: Boxes, sender: int
    ) -> Iterable[ClaimFrame]:
        rays, ego_rays = count_honest_rays(snapshot, world, self.malicious, self.ego)
        truth = snapshot.truth.boxes.center[:, :2] if snapshot.truth else world.center[:0, :2]
        real_m = _nearest(world.center[:, :2], truth)
        ego = next(frame for frame in snapshot.frames if frame.agent_id == self.ego)
        here = world.transform(ego.world_from_agent.inverse()).center[:, :2]
        found = perception.boxes.center[:, :2].double()
        scores = perception.boxes.score.double()
        for row in range(len(world)):
            rests = (found - here[row]).norm(dim=1) <= min(SURVIVAL_RADIUS_M, float(real_m[row]))
            best = int(torch.where(rests, scores, -1.0).argmax()) if bool(rests.any()) else -1
            yield ClaimFrame(
                int(rays[row]),
                int(ego_rays[row]),
                bool(real_m[row] <= REAL_RADIUS_M),
                float(scores[best]) if best >= 0 else 0.0,
                find_evidence(perception, best),
                find_sender_frames(perception).get(sender, SenderFrame()).trust,
            )

    def senders(self) -> tuple[SenderRecord, ...]:
        """Return the record of each sender that was received."""
        return make_sender_records(self.ego, self._senders, self.malicious, self.num_frames)

    def claims(self) -> tuple[ClaimRecord, ...]:
        """Return the record of each false claim."""
        absent, frames = ClaimFrame(0, 0, False, 0.0, NO_EVIDENCE, 1.0), range(self.num_frames)
        return tuple(
            ClaimRecord(
                self.ego,
                sender,
                claim,
                any(row.is_near_real for row in rows.values()),
                _booleans(at in rows for at in frames),
                torch.tensor([rows.get(at, absent).num_rays for at in frames]),
                torch.tensor([rows.get(at, absent).num_ego_rays for at in frames]),
                torch.tensor([rows.get(at, absent).score for at in frames], dtype=torch.float64),
                torch.tensor([rows.get(at, absent).evidence for at in frames]),
                torch.tensor([rows.get(at, absent).trust for at in frames], dtype=torch.float64),
            )
            for (sender, claim), rows in sorted(self._claims.items())
        )


def make_sender_records(
    ego: int, senders: Mapping[int, Mapping[int, SenderFrame]], malicious: frozenset[int], num_frames: int
) -> tuple[SenderRecord, ...]:
    """Return the records of senders, each by the number of the frame."""
    frames, absent = range(num_frames), SenderFrame()
    return tuple(
        SenderRecord(
            ego,
            sender,
            sender in malicious,
            _booleans(at in rows for at in frames),
            torch.tensor([rows.get(at, absent).trust for at in frames], dtype=torch.float64),
            _booleans(rows.get(at, absent).is_named for at in frames),
        )
        for sender, rows in sorted(senders.items())
    )


def find_sender_frames(perception: Perception) -> dict[int, SenderFrame]:
    """Return every sender that took part in a perception, or that the defence assessed."""
    found = {r.message.agent_id: SenderFrame(is_received=True) for r in perception.received}
    for sender in perception.assessment.senders if perception.assessment else ():
        found[sender.agent_id] = SenderFrame(sender.trust, sender.status is SenderStatus.MALICIOUS, True)
    return found


def find_evidence(perception: Perception, row: int) -> int:
    """Return the evidence on one box; NO_EVIDENCE without a box, or where the defence gives none."""
    evidence = perception.evidence
    return NO_EVIDENCE if evidence is None or row < 0 else int(evidence.kinds[row])


def count_honest_rays(snapshot: Snapshot, world: Boxes, malicious: frozenset[int], ego: int) -> tuple[Tensor, Tensor]:
    """Return (N,) int64, rays that cross each box in the world, of the honest agent with most of them, and of the ego."""
    num_rays, num_ego_rays = (torch.zeros(len(world), dtype=torch.int64) for _ in range(2))
    for row, frame in enumerate(snapshot.frames):
        if frame.agent_id not in malicious:
            pose = snapshot.truth.world_from_agent[row] if snapshot.truth else frame.world_from_agent
            found = torch.from_numpy(count_rays(frame, world.transform(pose.inverse())).num_crossing)
            num_rays = torch.maximum(num_rays, found)
            if frame.agent_id == ego:
                num_ego_rays = found
    return num_rays, num_ego_rays


def _nearest(points: Tensor, xy: Tensor) -> Tensor:
    """Return (N,) the distance of each point to the nearest place; infinite without places."""
    if not len(xy):
        return torch.full((len(points),), torch.inf, dtype=torch.float64)
    return torch.cdist(points.double(), xy.double()).amin(1)


def _booleans(values: Iterable[bool]) -> Tensor:
    return torch.tensor(list(values), dtype=torch.bool)
