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

from manyeyes.agents.descriptors import attach_descriptors, extract_message_keypoints, extract_own_keypoints
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.pose.corrector import inflate_covariance
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.pose_graph import RelativePoseEdge, optimize_poses
from manyeyes.pose.pose_monitor import PoseHealth, PoseMonitorConfig, PoseMonitorState, PoseReport, update_monitor
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3

Floats = NDArray[np.float64]

MAX_SILENCE_S = 60.0
"""A sender that was silent for so long is judged anew."""
_FAULTY = (PoseHealth.OFFSET, PoseHealth.DRIFTING)
EGO_NODE = 0
"""The ego's node in the graph; senders are 1, 2, ... in the order of their messages."""


class MessageUse(Enum):
    """What became of a message. PRIOR: fused where its sender says it is. CORRECTED: fused where objects and claim put
    it. UNCERTAIN: left out, since nobody knows well enough where it belongs. INCONSISTENT: left out, since what its sender
    sees fits nobody else's view in one way.
    """

    PRIOR = "prior"
    CORRECTED = "corrected"
    UNCERTAIN = "uncertain"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True)
class CorrectionOutcome:
    """One message: what objects say of its sender's pose, how far off what is used may be, and how its claims have been.

    sigma_m: one standard deviation of where the sender's cells land, see Aligner.reach_m. health: the watchman's report.
    """

    agent_id: int
    is_infrastructure: bool
    use: MessageUse
    estimate: PoseEstimate
    sigma_m: float
    health: PoseReport

    @property
    def untrusted(self) -> bool:
        """Whether nothing that its sender said a moment ago is to be used either."""
        return self.use is MessageUse.INCONSISTENT or (
            self.use is MessageUse.UNCERTAIN and self.health.health in _FAULTY
        )


@dataclass(frozen=True)
class SenderState:
    """What to remember of a sender. last_corrected: its last message that objects put where it belongs, near what it claimed."""

    monitor: PoseMonitorState
    last_corrected: Message | None = None


@dataclass(frozen=True)
class CorrectedMessages:
    """messages: those to be fused, corrected; corrections: one for each that came; states: what to remember, by sender."""

    messages: tuple[Message, ...]
    corrections: tuple[CorrectionOutcome, ...]
    states: Mapping[int, SenderState]


@dataclass(frozen=True)
class PoseCorrection:
    """Settings. corrector: of two agents' landmarks, by name (pose/registry.py), read again where this is sent to
    another process. min_score: boxes below it are no landmarks. max_sigma_m: a message whose cells may lie this far off (one
    standard deviation, reach_m from its sender) is not fused. sigma_velocity_mps: error of an object's stated velocity.
    propagate_s: how long ago a sender may have been placed to be followed from there, 0 for never; sigma_speed_mps,
    sigma_yaw_rate_rps: how fast it may have gone and turned since, one standard deviation.
    """

    corrector: str = "voting"
    min_score: float = 0.3
    max_sigma_m: float = 0.5
    lever_arm_m: float = 20.0
    sigma_velocity_mps: float = 1.0
    propagate_s: float = 0.5
    sigma_speed_mps: float = 15.0
    sigma_yaw_rate_rps: float = 0.5
    monitor: PoseMonitorConfig = field(default_factory=PoseMonitorConfig)

    def __post_init__(self) -> None:
        load_corrector(self.corrector)
        if not (self.max_sigma_m > 0 and min(self.lever_arm_m, self.sigma_velocity_mps, self.propagate_s) >= 0):
            raise ConfigError(
                "PoseCorrection needs max_sigma_m > 0, and lever_arm_m, sigma_velocity_mps and propagate_s >= 0."
            )
        if not min(self.sigma_speed_mps, self.sigma_yaw_rate_rps) > 0:
            raise ConfigError("PoseCorrection needs sigma_speed_mps > 0 and sigma_yaw_rate_rps > 0.")

    def correct(
        self, frame: AgentFrame, cache: PerceptionCache, messages: Sequence[Message], states: Mapping[int, SenderState]
    ) -> CorrectedMessages:
        """The messages that came for a frame, put where they belong. states: of the frame before, by sender."""
        now_s = frame.timestamp_ns * 1e-9
        new_states = {
            a: s
            for a, s in states.items()
            if not len(s.monitor.time_s) or abs(now_s - s.monitor.time_s[-1]) <= MAX_SILENCE_S
        }
        if not messages:
            return CorrectedMessages((), (), new_states)
        own = self.extract_own_landmarks(frame, cache)
        landmarks = [self._message_landmarks(cache, message, age_s(frame, message)) for message in messages]
        priors = [PosePrior.between(frame, message) for message in messages]
        pairwise_estimates = [
            load_corrector(self.corrector)(own, theirs, prior) for theirs, prior in zip(landmarks, priors)
        ]
        health, last_corrected = [], {a: s.last_corrected for a, s in new_states.items()}
        for message, prior, pairwise in zip(messages, priors, pairwise_estimates):
            before = new_states.get(message.agent_id)
            state, report = self._update_monitor(before.monitor if before else None, message, prior, pairwise)
            new_states[message.agent_id] = SenderState(state)
            health.append(report)
        propagated = set[int]()
        for n, message in enumerate(messages):
            last = last_corrected.get(message.agent_id)
            propagated_prior = (
                None
                if last is None or pairwise_estimates[n].status.has_estimate
                else self._propagate_prior(frame, cache, last, message)
            )
            if propagated_prior is not None:
                priors[n], pairwise_estimates[n] = (
                    propagated_prior,
                    load_corrector(self.corrector)(own, landmarks[n], propagated_prior),
                )
                propagated.add(n)
        joint, inconsistent = self._optimize_jointly(messages, landmarks, priors, pairwise_estimates)
        kept, corrections = [], []
        for n, message in enumerate(messages):
            estimate = joint.get(n, pairwise_estimates[n])
            use, sigma = self._decide_use(
                estimate, pairwise_estimates[n], n in joint or n in propagated, n in inconsistent, health[n]
            )
            corrections.append(
                CorrectionOutcome(message.agent_id, message.is_infrastructure, use, estimate, sigma, health[n])
            )
            if use is MessageUse.PRIOR:
                kept.append(message)
            elif use is MessageUse.CORRECTED:
                kept.append(apply_correction(message, frame, estimate))
            # Whom objects put elsewhere than it says is not followed from there: were it a mistake, it would go on.
            refuted = use is MessageUse.INCONSISTENT or estimate.status is PoseStatus.CONFLICT
            put = kept[-1] if use is MessageUse.CORRECTED else last_corrected.get(message.agent_id)
            new_states[message.agent_id] = SenderState(new_states[message.agent_id].monitor, None if refuted else put)
        return CorrectedMessages(tuple(kept), tuple(corrections), new_states)

    @property
    def net(self) -> FeakmNet | None:
        """Whose descriptors the corrector reads, if any."""
        found = load_corrector(self.corrector)
        return found.net if isinstance(found, FeakmCorrector) else None

    def attach_descriptors(self, frame: AgentFrame, cache: PerceptionCache, message: Message) -> Message:
        """An agent's own message with what the corrector needs beside; one that is dated otherwise than the frame stays."""
        if self.net is None or message.timestamp_ns != frame.timestamp_ns:
            return message
        return attach_descriptors(self.net, cache, frame, message)

    def extract_own_landmarks(self, frame: AgentFrame, cache: PerceptionCache) -> Landmarks:
        """What an agent itself sees, as far as the corrector goes by it."""
        if self.net is None:
            landmarks = self._select_landmarks(cache.process(frame).boxes, None, 0.0)
            return landmarks if frame.is_infrastructure else landmarks.with_ego_body()
        points = extract_own_keypoints(self.net, cache, frame)
        return self._select_landmarks(points.boxes, points.descriptor, 0.0)

    def _message_landmarks(self, cache: PerceptionCache, message: Message, seconds: float) -> Landmarks:
        """What a message says that left so long ago; nothing, where the corrector needs descriptors and none came."""
        if self.net is None:
            landmarks = self._select_landmarks(extract_message_boxes(cache, message), None, seconds)
            # Where a sender was is not where it is: how fast it goes, it does not say.
            return landmarks if message.is_infrastructure or seconds else landmarks.with_ego_body()
        points = extract_message_keypoints(message)
        return Landmarks.empty() if points is None else self._select_landmarks(points.boxes, points.descriptor, seconds)

    def _select_landmarks(self, boxes: Boxes, descriptor: Tensor | None, seconds: float) -> Landmarks:
        """Boxes that are sure enough, seen so long ago, where they are now."""
        confident = boxes.score >= self.min_score
        now = boxes[confident].after(seconds)
        landmarks = (
            Landmarks.of_boxes(now)
            if descriptor is None
            else Landmarks.of_keypoints(Keypoints(now, descriptor[confident]))
        )
        sigma_motion_m = self.sigma_velocity_mps * abs(seconds)
        return (
            replace(landmarks, sigma_xy=np.hypot(landmarks.sigma_xy, sigma_motion_m)) if sigma_motion_m else landmarks
        )

    def _propagate_prior(
        self, frame: AgentFrame, cache: PerceptionCache, last: Message, message: Message
    ) -> PosePrior | None:
        """Where a sender is, by where it was placed when it said something before and what it saw then and sees now; None where
        that is too long ago, or does not fit.
        """
        seconds = (message.timestamp_ns - last.timestamp_ns) * 1e-9
        if not 0 < seconds <= self.propagate_s:
            return None
        then, now = self._message_landmarks(cache, last, seconds), self._message_landmarks(cache, message, 0.0)
        sigma_motion = np.array([self.sigma_speed_mps, self.sigma_speed_mps, self.sigma_yaw_rate_rps]) * seconds
        motion = load_corrector(self.corrector)(then, now, PosePrior(Transform.identity(), np.diag(sigma_motion**2)))
        if not motion.status.has_estimate or motion.ego_from_other is None:
            return None
        previous = PosePrior.between(frame, last)
        x, y = (previous.ego_from_other.rotation[:2, :2] @ motion.ego_from_other.translation[:2]).tolist()
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        turn = np.eye(3)
        turn[:2, :2] = previous.ego_from_other.rotation[:2, :2].numpy()
        covariance = lever @ previous.covariance @ lever.T + turn @ motion.covariance @ turn.T
        return PosePrior(previous.ego_from_other @ motion.ego_from_other, (covariance + covariance.T) / 2)

    def _update_monitor(
        self, state: PoseMonitorState | None, message: Message, prior: PosePrior, estimate: PoseEstimate
    ) -> tuple[PoseMonitorState, PoseReport]:
        """The watchman's state and word after this message; one heard before says nothing new."""
        state, time_s = state or PoseMonitorState.new(), message.timestamp_ns * 1e-9
        # Where time goes back, another drive has begun.
        state = PoseMonitorState.new() if len(state.time_s) and time_s < state.time_s[-1] else state
        again = bool(len(state.time_s)) and time_s == state.time_s[-1]
        return update_monitor(state, estimate, None if again else prior, time_s, self.monitor)

    def _optimize_jointly(
        self,
        messages: Sequence[Message],
        landmarks: Sequence[Landmarks],
        priors: Sequence[PosePrior],
        pairwise_estimates: Sequence[PoseEstimate],
    ) -> tuple[dict[int, PoseEstimate], set[int]]:
        """What all agents say together of each sender's pose, where two senders also recognise each other's objects; and
        who contradicts the others.
        """
        ego_edges = [_make_edge(EGO_NODE, n + 1, pairwise) for n, pairwise in enumerate(pairwise_estimates)]
        sender_edges = []
        for i, j in itertools.combinations(range(len(messages)), 2):
            estimate = load_corrector(self.corrector)(
                landmarks[i], landmarks[j], PosePrior.between(messages[i], messages[j])
            )
            sender_edges.append(_make_edge(i + 1, j + 1, estimate))
        if not any(sender_edges):
            return {}, set()
        prior_by_node = {
            n + 1: inflate_covariance(prior, pairwise.mahalanobis_squared)
            for n, (prior, pairwise) in enumerate(zip(priors, pairwise_estimates))
            if pairwise.status is not PoseStatus.CONFLICT
        }
        joint = optimize_poses(
            EGO_NODE, [edge for edge in (*ego_edges, *sender_edges) if edge is not None], prior_by_node
        )
        connected = {agent for edge in joint.kept_edges for agent in (edge.i, edge.j)} - {EGO_NODE}
        poses = {
            n - 1: replace(
                pairwise_estimates[n - 1],
                ego_from_other=lift_to_se3(joint.pose[n], priors[n - 1]),
                covariance=joint.covariance[n],
            )
            for n in connected & joint.pose.keys()
        }
        return poses, {n - 1 for n in joint.isolated}

    def _decide_use(
        self, estimate: PoseEstimate, pairwise: PoseEstimate, connected: bool, inconsistent: bool, health: PoseReport
    ) -> tuple[MessageUse, float]:
        """What to do with a message whose pose would be this; connected: others, if not the ego, recognise its objects."""
        sigma = math.inf
        if np.isfinite(estimate.covariance).all():
            variance_xy = np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1]
            sigma = math.sqrt(max(float(variance_xy + self.lever_arm_m**2 * estimate.covariance[2, 2]), 0.0))
        has_estimate = connected or pairwise.status.has_estimate
        is_faulty = not has_estimate and health.health in _FAULTY
        if inconsistent:
            return MessageUse.INCONSISTENT, sigma
        if estimate.ego_from_other is None or is_faulty or not sigma <= self.max_sigma_m:
            return MessageUse.UNCERTAIN, sigma
        return MessageUse.CORRECTED if has_estimate else MessageUse.PRIOR, sigma


def extract_message_boxes(cache: PerceptionCache, message: Message) -> Boxes:
    """What a message says of objects, in its sender's frame: sent, proposed by its tokens, or found in its points."""
    if message.objects is not None:
        return message.objects
    tokens = message.tokens
    if tokens is not None and tokens.features.is_floating_point() and tokens.features.shape[1] >= PROPOSAL_DIM:
        return cache.decode(RawBoxes.of(tokens.features[:, -PROPOSAL_DIM:].float(), tokens.sites))
    return cache.run_detector(message.points).boxes if message.points is not None else Boxes.empty()


def apply_correction(message: Message, frame: AgentFrame, estimate: PoseEstimate) -> Message:
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


def _make_edge(i: int, j: int, estimate: PoseEstimate) -> RelativePoseEdge | None:
    """What objects say of two agents, where they say it."""
    if not estimate.status.has_estimate or estimate.measured is None or estimate.measured_covariance is None:
        return None
    return RelativePoseEdge(i, j, estimate.measured, estimate.measured_covariance)
