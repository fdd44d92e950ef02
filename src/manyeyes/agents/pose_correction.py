# SPDX-License-Identifier: Apache-2.0
"""Before messages are fused: where their senders really are, from what both detect; whom not to believe; who drifts.

No byte is added for this: the landmarks of a sender are the boxes it sends, or those that its tokens propose, or, where it
sends its cloud, what the ego's own eyes find in it, and beside them its own vehicle, which others see. Boxes seen earlier are
moved by their velocity to the ego's instant. A sender whom nobody recognises now is followed from where it was placed a moment ago:
what it sees itself now is matched with what it saw then.
Where the corrector is FeaKM's, senders add descriptors, and the boxes that these describe where they send none
(describing.py): 32 and 13 bytes an object. Spec: specs/pose.md 4.4, 4.7, 4.8.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.agents.descriptors import described, seen_points, told_points
from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.proposal import PROPOSAL
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.pose.corrector import inflated
from manyeyes.pose.feakm import Feakm
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.pose_graph import Link, settle
from manyeyes.pose.pose_monitor import Health, Report, WatchConfig, WatchState, watch
from manyeyes.pose.registry import corrector
from manyeyes.pose.types import PoseClaim, PoseEstimate, PoseStatus, upright

Floats = NDArray[np.float64]

FORGET_S = 60.0
"""A sender that was silent for so long is judged anew."""
_OFF = (Health.OFFSET, Health.DRIFTING)
EGO = 0
"""The ego's node in the graph; senders are 1, 2, ... in the order of their messages."""


class Use(Enum):
    """What became of a message. CLAIMED: fused where its sender says it is. CORRECTED: fused where objects and claim put
    it. UNSURE: left out, since nobody knows well enough where it belongs. CONTRADICTED: left out, since what its sender
    sees fits nobody else's view in one way.
    """

    CLAIMED = "claimed"
    CORRECTED = "corrected"
    UNSURE = "unsure"
    CONTRADICTED = "contradicted"


@dataclass(frozen=True)
class Verdict:
    """One message: what objects say of its sender's pose, how far off what is used may be, and how its claims have been.

    sigma_m: one standard deviation of where the sender's cells land, see Aligner.reach_m. health: the watchman's report.
    """

    agent_id: int
    is_infrastructure: bool
    use: Use
    estimate: PoseEstimate
    sigma_m: float
    health: Report

    @property
    def distrusted(self) -> bool:
        """Whether nothing that its sender said a moment ago is to be used either."""
        return self.use is Use.CONTRADICTED or (self.use is Use.UNSURE and self.health.health in _OFF)


@dataclass(frozen=True)
class Known:
    """What to remember of a sender. placed: its last message that objects put where it belongs, near what it claimed."""

    watch: WatchState
    placed: Message | None = None


@dataclass(frozen=True)
class Aligned:
    """messages: those to be fused, corrected; verdicts: one for each that came; states: what to remember, by sender."""

    messages: tuple[Message, ...]
    verdicts: tuple[Verdict, ...]
    states: Mapping[int, Known]


@dataclass(frozen=True)
class Aligner:
    """Settings. corrector: of two agents' landmarks, by name (pose/registry.py), read again where this is sent to
    another process. score_min: boxes below it are no landmarks. unsure_m: a message whose cells may lie this far off (one
    standard deviation, reach_m from its sender) is not fused. speed_sigma_mps: error of an object's stated velocity. follow_s: how
    long ago a sender may have been placed to be followed from there, 0 for never; pace_mps, pace_rps: how fast it may have gone and
    turned since, one standard deviation.
    """

    corrector: str = "vote"
    score_min: float = 0.3
    unsure_m: float = 0.5
    reach_m: float = 20.0
    speed_sigma_mps: float = 1.0
    follow_s: float = 0.5
    pace_mps: float = 15.0
    pace_rps: float = 0.5
    watch: WatchConfig = field(default_factory=WatchConfig)

    def __post_init__(self) -> None:
        corrector(self.corrector)
        if not (self.unsure_m > 0 and min(self.reach_m, self.speed_sigma_mps, self.follow_s) >= 0):
            raise ConfigError("Aligner needs unsure_m > 0, and reach_m, speed_sigma_mps and follow_s of 0 or more.")
        if not min(self.pace_mps, self.pace_rps) > 0:
            raise ConfigError("Aligner needs pace_mps > 0 and pace_rps > 0.")

    def align(self, frame: AgentFrame, eyes: Eyes, messages: Sequence[Message], states: Mapping[int, Known]) -> Aligned:
        """The messages that came for a frame, put where they belong. states: of the frame before, by sender."""
        now_s = frame.timestamp_ns * 1e-9
        known = {a: s for a, s in states.items() if not len(s.watch.time) or abs(now_s - s.watch.time[-1]) <= FORGET_S}
        if not messages:
            return Aligned((), (), known)
        own = self.own_landmarks(frame, eyes)
        marks = [self._told_landmarks(eyes, message, age_s(frame, message)) for message in messages]
        claims = [PoseClaim.between(frame, message) for message in messages]
        answers = [corrector(self.corrector)(own, theirs, claim) for theirs, claim in zip(marks, claims)]
        health, placed = [], {a: s.placed for a, s in known.items()}
        for message, claim, answer in zip(messages, claims, answers):
            before = known.get(message.agent_id)
            state, report = self._watched(before.watch if before else None, message, claim, answer)
            known[message.agent_id] = Known(state)
            health.append(report)
        followed = set[int]()
        for n, message in enumerate(messages):
            last = placed.get(message.agent_id)
            since = None if last is None or answers[n].status.answered else self._followed(frame, eyes, last, message)
            if since is not None:
                claims[n], answers[n] = since, corrector(self.corrector)(own, marks[n], since)
                followed.add(n)
        settled, contradicted = self._settled(messages, marks, claims, answers)
        kept, verdicts = [], []
        for n, message in enumerate(messages):
            estimate = settled.get(n, answers[n])
            use, sigma = self._use(estimate, answers[n], n in settled or n in followed, n in contradicted, health[n])
            verdicts.append(Verdict(message.agent_id, message.is_infrastructure, use, estimate, sigma, health[n]))
            if use is Use.CLAIMED:
                kept.append(message)
            elif use is Use.CORRECTED:
                kept.append(moved(message, frame, estimate))
            # Whom objects put elsewhere than it says is not followed from there: were it a mistake, it would go on.
            refuted = use is Use.CONTRADICTED or estimate.status is PoseStatus.CONFLICT
            put = kept[-1] if use is Use.CORRECTED else placed.get(message.agent_id)
            known[message.agent_id] = Known(known[message.agent_id].watch, None if refuted else put)
        return Aligned(tuple(kept), tuple(verdicts), known)

    @property
    def net(self) -> FeakmNet | None:
        """Whose descriptors the corrector reads, if any."""
        found = corrector(self.corrector)
        return found.net if isinstance(found, Feakm) else None

    def describe(self, frame: AgentFrame, eyes: Eyes, message: Message) -> Message:
        """An agent's own message with what the corrector needs beside; one that is dated otherwise than the frame stays."""
        if self.net is None or message.timestamp_ns != frame.timestamp_ns:
            return message
        return described(self.net, eyes, frame, message)

    def own_landmarks(self, frame: AgentFrame, eyes: Eyes) -> Landmarks:
        """What an agent itself sees, as far as the corrector goes by it."""
        if self.net is None:
            seen = self._landmarks(eyes.see(frame).boxes, None, 0.0)
            return seen if frame.is_infrastructure else seen.with_body()
        points = seen_points(self.net, eyes, frame)
        return self._landmarks(points.boxes, points.descriptor, 0.0)

    def _told_landmarks(self, eyes: Eyes, message: Message, seconds: float) -> Landmarks:
        """What a message says that left so long ago; nothing, where the corrector needs descriptors and none came."""
        if self.net is None:
            told = self._landmarks(boxes_of(eyes, message), None, seconds)
            # Where a sender was is not where it is: how fast it goes, it does not say.
            return told if message.is_infrastructure or seconds else told.with_body()
        points = told_points(message)
        return Landmarks.empty() if points is None else self._landmarks(points.boxes, points.descriptor, seconds)

    def _landmarks(self, boxes: Boxes, look: Tensor | None, seconds: float) -> Landmarks:
        """Boxes that are sure enough, seen so long ago, where they are now."""
        sure = boxes.score >= self.score_min
        now = boxes[sure].after(seconds)
        marks = Landmarks.of_boxes(now) if look is None else Landmarks.of_keypoints(Keypoints(now, look[sure]))
        drifted = self.speed_sigma_mps * abs(seconds)
        return replace(marks, sigma_xy=np.hypot(marks.sigma_xy, drifted)) if drifted else marks

    def _followed(self, frame: AgentFrame, eyes: Eyes, last: Message, message: Message) -> PoseClaim | None:
        """Where a sender is, by where it was placed when it said something before and what it saw then and sees now; None where
        that is too long ago, or does not fit.
        """
        seconds = (message.timestamp_ns - last.timestamp_ns) * 1e-9
        if not 0 < seconds <= self.follow_s:
            return None
        then, now = self._told_landmarks(eyes, last, seconds), self._told_landmarks(eyes, message, 0.0)
        stayed = np.array([self.pace_mps, self.pace_mps, self.pace_rps]) * seconds
        moved_on = corrector(self.corrector)(then, now, PoseClaim(Transform.identity(), np.diag(stayed**2)))
        if not moved_on.status.answered or moved_on.ego_from_other is None:
            return None
        there = PoseClaim.between(frame, last)
        x, y = (there.ego_from_other.rotation[:2, :2] @ moved_on.ego_from_other.translation[:2]).tolist()
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        turn = np.eye(3)
        turn[:2, :2] = there.ego_from_other.rotation[:2, :2].numpy()
        covariance = lever @ there.covariance @ lever.T + turn @ moved_on.covariance @ turn.T
        return PoseClaim(there.ego_from_other @ moved_on.ego_from_other, (covariance + covariance.T) / 2)

    def _watched(
        self, state: WatchState | None, message: Message, claim: PoseClaim, answer: PoseEstimate
    ) -> tuple[WatchState, Report]:
        """The watchman's state and word after this message; one heard before says nothing new."""
        state, time_s = state or WatchState.new(), message.timestamp_ns * 1e-9
        # Where time goes back, another drive has begun.
        state = WatchState.new() if len(state.time) and time_s < state.time[-1] else state
        again = bool(len(state.time)) and time_s == state.time[-1]
        return watch(state, answer, None if again else claim, time_s, self.watch)

    def _settled(
        self,
        messages: Sequence[Message],
        marks: Sequence[Landmarks],
        claims: Sequence[PoseClaim],
        answers: Sequence[PoseEstimate],
    ) -> tuple[dict[int, PoseEstimate], set[int]]:
        """What all agents say together of each sender's pose, where two senders also recognise each other's objects; and
        who contradicts the others.
        """
        links = [_link(EGO, n + 1, answer) for n, answer in enumerate(answers)]
        across = []
        for i, j in itertools.combinations(range(len(messages)), 2):
            said = corrector(self.corrector)(marks[i], marks[j], PoseClaim.between(messages[i], messages[j]))
            across.append(_link(i + 1, j + 1, said))
        if not any(across):
            return {}, set()
        given = {
            n + 1: inflated(claim, answer.distance)
            for n, (claim, answer) in enumerate(zip(claims, answers))
            if answer.status is not PoseStatus.CONFLICT
        }
        joint = settle(EGO, [link for link in (*links, *across) if link is not None], given)
        joined = {agent for link in joint.kept for agent in (link.i, link.j)} - {EGO}
        poses = {
            n - 1: replace(
                answers[n - 1],
                ego_from_other=upright(joint.pose[n], claims[n - 1]),
                covariance=joint.covariance[n],
            )
            for n in joined & joint.pose.keys()
        }
        return poses, {n - 1 for n in joint.isolated}

    def _use(
        self, estimate: PoseEstimate, answer: PoseEstimate, joined: bool, contradicted: bool, health: Report
    ) -> tuple[Use, float]:
        """What to do with a message whose pose would be this; joined: others, if not the ego, recognise its objects."""
        sigma = math.inf
        if np.isfinite(estimate.covariance).all():
            across = np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]
            sigma = math.sqrt(max(float(across + self.reach_m**2 * estimate.covariance[2, 2]), 0.0))
        answered = joined or answer.status.answered
        caught = not answered and health.health in _OFF
        if contradicted:
            return Use.CONTRADICTED, sigma
        if estimate.ego_from_other is None or caught or not sigma <= self.unsure_m:
            return Use.UNSURE, sigma
        return Use.CORRECTED if answered else Use.CLAIMED, sigma


def boxes_of(eyes: Eyes, message: Message) -> Boxes:
    """What a message says of objects, in its sender's frame: sent, proposed by its tokens, or found in its points."""
    if message.objects is not None:
        return message.objects
    tokens = message.tokens
    if tokens is not None and tokens.features.is_floating_point() and tokens.features.shape[1] >= PROPOSAL:
        return eyes.decode(RawBoxes.of(tokens.features[:, -PROPOSAL:].float(), tokens.sites))
    return eyes.see_cloud(message.points).boxes if message.points is not None else Boxes.empty()


def moved(message: Message, frame: AgentFrame, estimate: PoseEstimate) -> Message:
    """The message from where the estimate puts its sender, as seen from the ego's claimed pose."""
    assert estimate.ego_from_other is not None
    world_from_ego = frame.world_from_agent
    c, s = float(world_from_ego.yaw.cos()), float(world_from_ego.yaw.sin())
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance = torch.from_numpy(turn @ estimate.covariance @ turn.T).to(message.pose_covariance.dtype)
    return replace(
        message,
        world_from_agent=world_from_ego @ estimate.ego_from_other,
        pose_covariance=(covariance + covariance.mT) / 2,
    )


def _link(i: int, j: int, answer: PoseEstimate) -> Link | None:
    """What objects say of two agents, where they say it."""
    if not answer.status.answered or answer.measured is None or answer.measured_covariance is None:
        return None
    return Link(i, j, answer.measured, answer.measured_covariance)
