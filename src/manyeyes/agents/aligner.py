# SPDX-License-Identifier: Apache-2.0
"""Before messages are fused: where their senders really are, from what both detect; whom not to believe; who drifts.

No byte is added for this: the landmarks of a sender are the boxes it sends, or those that its tokens propose, or, where it
sends its cloud, what the ego's own eyes find in it, and beside them its own vehicle, which others see. Boxes seen earlier are
moved by their velocity to the ego's instant.
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

from manyeyes.agents.collaboration.heading import age_s
from manyeyes.agents.describing import described, seen_points, told_points
from manyeyes.agents.eyes import Eyes
from manyeyes.alignment.decide import inflated
from manyeyes.alignment.estimate import PoseClaim, PoseEstimate, PoseStatus, upright
from manyeyes.alignment.feakm import Feakm
from manyeyes.alignment.landmarks import Landmarks
from manyeyes.alignment.pose_graph import Link, settle
from manyeyes.alignment.rivals.table import corrector
from manyeyes.alignment.watchman import Health, Report, WatchConfig, WatchState, watch
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.box_head import RawBoxes
from manyeyes.models.feakm import FeakmNet
from manyeyes.models.proposal import PROPOSAL

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
class Aligned:
    """messages: those to be fused, corrected; verdicts: one for each that came; states: what to remember, by sender."""

    messages: tuple[Message, ...]
    verdicts: tuple[Verdict, ...]
    states: Mapping[int, WatchState]


@dataclass(frozen=True)
class Aligner:
    """Settings. corrector: of two agents' landmarks, by name (alignment/rivals/table.py), read again where this is sent to
    another process. score_min: boxes below it are no landmarks. unsure_m: a message whose cells may lie this far off (one
    standard deviation, reach_m from its sender) is not fused. speed_sigma_mps: error of an object's stated velocity.
    """

    corrector: str = "vote"
    score_min: float = 0.3
    unsure_m: float = 0.5
    reach_m: float = 20.0
    speed_sigma_mps: float = 1.0
    watch: WatchConfig = field(default_factory=WatchConfig)

    def __post_init__(self) -> None:
        corrector(self.corrector)
        if not (self.unsure_m > 0 and self.reach_m >= 0 and self.speed_sigma_mps >= 0):
            raise ConfigError("Aligner needs unsure_m > 0, reach_m >= 0 and speed_sigma_mps >= 0.")

    def align(
        self, frame: AgentFrame, eyes: Eyes, messages: Sequence[Message], states: Mapping[int, WatchState]
    ) -> Aligned:
        """The messages that came for a frame, put where they belong. states: of the frame before, by sender."""
        now_s = frame.timestamp_ns * 1e-9
        watched = {a: s for a, s in states.items() if not len(s.time) or abs(now_s - s.time[-1]) <= FORGET_S}
        if not messages:
            return Aligned((), (), watched)
        own = self.own_landmarks(frame, eyes)
        marks = [self._told_landmarks(eyes, message, age_s(frame, message)) for message in messages]
        claims = [PoseClaim.between(frame, message) for message in messages]
        answers = [corrector(self.corrector)(own, theirs, claim) for theirs, claim in zip(marks, claims)]
        health = []
        for message, claim, answer in zip(messages, claims, answers):
            state, report = self._watched(watched.get(message.agent_id), message, claim, answer)
            watched[message.agent_id] = state
            health.append(report)
        settled, contradicted = self._settled(messages, marks, claims, answers)
        kept, verdicts = [], []
        for n, message in enumerate(messages):
            estimate = settled.get(n, answers[n])
            use, sigma = self._use(estimate, answers[n], n in settled, n in contradicted, health[n])
            verdicts.append(Verdict(message.agent_id, message.is_infrastructure, use, estimate, sigma, health[n]))
            if use is Use.CLAIMED:
                kept.append(message)
            elif use is Use.CORRECTED:
                kept.append(moved(message, frame, estimate))
        return Aligned(tuple(kept), tuple(verdicts), watched)

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
