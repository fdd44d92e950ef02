# SPDX-License-Identifier: Apache-2.0
"""Pose correction of received messages before fusion, from objects that ego and sender both detect.

No bytes are added: the landmarks of a sender are the boxes it sends, those proposed by its tokens, or detections in its cloud, and
its own vehicle, which other agents detect (``AgentFrame.body``). Boxes of an earlier timestamp are propagated by their velocity. A
sender without a match is propagated from its last corrected pose: its current landmarks are matched with its earlier ones. A match
that contradicts both that pose and the prior, where these agree, is rejected. Pairs of senders are matched too; a pose graph
combines all matches and isolates inconsistent senders. A monitor reports senders whose prior poses have an offset or drift. With a
FeaKM corrector, senders add descriptors of 32 bytes an object, and boxes of 14 bytes where they send none.
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
from manyeyes.agents.pose_plausibility import has_known_pose
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.pose.body_estimate import BodyEstimate, append_body, update_body
from manyeyes.pose.corrector import inflate_covariance
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.pose_graph import RelativePoseEdge, optimize_poses
from manyeyes.pose.pose_monitor import PoseHealth, PoseMonitorConfig, PoseMonitorState, PoseReport, update_monitor
from manyeyes.pose.propagated_prior import contradicts_both, priors_agree, propagate_prior
from manyeyes.pose.registry import find_joint_corrector, load_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3, no_estimate

Floats = NDArray[np.float64]

MAX_SILENCE_S = 60.0
"""The monitor of a sender restarts after a longer gap."""
MAX_MESSAGE_AGE_S = 1.0
"""Maximum age of a received message, and of the message before whose pose is propagated to it, beyond propagate_s."""
MAX_SENDER_STATES = 256
"""Number of senders whose state is kept, the last received ones."""
_FAULTY = (PoseHealth.OFFSET, PoseHealth.DRIFTING)
EGO_NODE = 0
"""The ego's node in the pose graph; senders are 1, 2, ... in the order of their messages."""


class MessageUse(Enum):
    """How a message is used.

    PRIOR: fused at its prior pose. CORRECTED: fused at the corrected pose. UNCERTAIN: excluded, since its pose is too uncertain.
    INCONSISTENT: excluded, since its matches contradict those of the other agents.
    """

    PRIOR = "prior"
    CORRECTED = "corrected"
    UNCERTAIN = "uncertain"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True)
class CorrectionOutcome:
    """Outcome for one message: the estimated pose of its sender, its uncertainty, and the health of its prior poses.

    sigma_m: standard deviation of the position of the sender's cells at PoseCorrection.lever_arm_m. health: report of the monitor.
    """

    agent_id: int
    is_infrastructure: bool
    use: MessageUse
    estimate: PoseEstimate
    sigma_m: float
    health: PoseReport

    @property
    def is_faulty(self) -> bool:
        """Whether the prior poses of the sender have an offset or a drift."""
        return self.health.health in _FAULTY

    @property
    def untrusted(self) -> bool:
        """Whether earlier messages of the sender are excluded too."""
        return self.use is MessageUse.INCONSISTENT or (self.use is MessageUse.UNCERTAIN and self.is_faulty)


@dataclass(frozen=True)
class SenderState:
    """State of one sender, or of the ego itself. last_corrected: its last message at an estimated pose that is consistent with the
    prior. body: where its vehicle is in its frame, estimated where it is not stated.
    """

    monitor: PoseMonitorState
    last_corrected: Message | None = None
    body: BodyEstimate | None = None

    def drop_expired(self, now_s: float, max_message_age_s: float) -> SenderState | None:
        """Return the state without a monitor or body silent for MAX_SILENCE_S or an older message; None if nothing is left."""
        time_s, last = self.monitor.time_s, self.last_corrected
        is_silent = not len(time_s) or abs(now_s - time_s[-1]) > MAX_SILENCE_S
        is_old = last is None or abs(now_s - last.timestamp_ns * 1e-9) > max_message_age_s
        body = self.body if self.body is not None and abs(now_s - self.body.time_s) <= MAX_SILENCE_S else None
        if is_silent and is_old and body is None:
            return None
        return SenderState(PoseMonitorState.new() if is_silent else self.monitor, None if is_old else last, body)


@dataclass(frozen=True)
class CorrectedMessages:
    """messages: to be fused, with corrected poses; corrections: one a received message; states: of each sender."""

    messages: tuple[Message, ...]
    corrections: tuple[CorrectionOutcome, ...]
    states: Mapping[int, SenderState]


@dataclass(frozen=True)
class PoseCorrection:
    """Settings of pose correction.

    corrector: name in pose/registry.py, loaded again in each process. min_score: of a landmark box. max_sigma_m: messages with a
    larger standard deviation of position, lever_arm_m from their sender, are excluded. sigma_velocity_mps: error of an object's
    velocity. propagate_s: maximum age of a corrected pose that is propagated, 0 for never; sigma_speed_mps, sigma_yaw_rate_rps:
    standard deviations of the sender's motion since.
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
        """Correct the poses of the messages received for a frame. states: of the previous frame, by sender.

        A message with infinite pose covariance has no prior: it is used only if its pose is measured from objects.
        """
        now_s = frame.timestamp_ns * 1e-9
        current = {a: s.drop_expired(now_s, self.propagate_s + MAX_MESSAGE_AGE_S) for a, s in states.items()}
        new_states = {a: s for a, s in current.items() if s is not None}
        if not messages:
            return CorrectedMessages((), (), new_states)
        bodies = {agent: state.body for agent, state in new_states.items()}
        own = self.extract_own_landmarks(frame, cache, bodies.get(frame.agent_id))
        landmarks = [
            self._message_landmarks(cache, message, age_s(frame, message), bodies.get(message.agent_id))
            for message in messages
        ]
        priors = [_make_prior(frame, message) for message in messages]
        pairwise_estimates = [
            load_corrector(self.corrector)(own, theirs, prior) for theirs, prior in zip(landmarks, priors)
        ]
        last_corrected = {a: s.last_corrected for a, s in new_states.items()}
        propagated = self._propagate_priors(frame, cache, messages, last_corrected, pairwise_estimates)
        for n, estimate in enumerate(pairwise_estimates):
            if n in propagated and contradicts_both(estimate, priors[n], propagated[n]):
                pairwise_estimates[n] = no_estimate(priors[n], PoseStatus.AMBIGUOUS)
        health = [
            self._update_monitor(new_states, bodies, message, prior, estimate)
            for message, prior, estimate in zip(messages, priors, pairwise_estimates)
        ]
        at_propagated = self._use_propagated(own, landmarks, priors, pairwise_estimates, propagated, health)
        bodies = self._update_bodies(frame, messages, (own, *landmarks), pairwise_estimates, bodies)
        joint, inconsistent = self._optimize_jointly(messages, (own, *landmarks), priors, pairwise_estimates)
        kept, corrections = [], []
        for n, message in enumerate(messages):
            estimate = joint.get(n, pairwise_estimates[n])
            use, sigma = self._decide_use(
                estimate, pairwise_estimates[n], n in joint or n in at_propagated, n in inconsistent, health[n]
            )
            corrections.append(
                CorrectionOutcome(message.agent_id, message.is_infrastructure, use, estimate, sigma, health[n])
            )
            if use is MessageUse.PRIOR:
                kept.append(message)
            elif use is MessageUse.CORRECTED:
                kept.append(apply_correction(message, frame, estimate))
            last = last_corrected.get(message.agent_id)
            if use is MessageUse.INCONSISTENT or estimate.status is PoseStatus.CONFLICT:
                # Do not propagate from a pose that conflicts with the prior: an error would persist.
                last = None
            elif use is MessageUse.CORRECTED or pairwise_estimates[n].status.has_estimate:
                # Also where the estimate is too uncertain to be used: with the next one it may be certain enough.
                last = apply_correction(message, frame, estimate)
            elif n in propagated:
                # The prior is not part of it: what is propagated stays independent of it.
                last = apply_correction(message, frame, no_estimate(propagated[n]))
            new_states[message.agent_id] = replace(
                new_states[message.agent_id], last_corrected=last, body=bodies.get(message.agent_id)
            )
        if bodies.get(frame.agent_id) is not None:
            before = new_states.pop(frame.agent_id, SenderState(PoseMonitorState.new()))
            new_states[frame.agent_id] = replace(before, body=bodies[frame.agent_id])
        return CorrectedMessages(tuple(kept), tuple(corrections), dict([*new_states.items()][-MAX_SENDER_STATES:]))

    @property
    def net(self) -> FeakmNet | None:
        """The net whose descriptors the corrector uses, if any."""
        found = load_corrector(self.corrector)
        return found.net if isinstance(found, FeakmCorrector) else None

    def attach_descriptors(self, frame: AgentFrame, cache: PerceptionCache, message: Message) -> Message:
        """Add the descriptors that the corrector needs; a message of another timestamp than the frame is unchanged."""
        if self.net is None or message.timestamp_ns != frame.timestamp_ns:
            return message
        return attach_descriptors(self.net, cache, frame, message)

    def extract_own_landmarks(
        self, frame: AgentFrame, cache: PerceptionCache, body: BodyEstimate | None = None
    ) -> Landmarks:
        """Return landmarks of an agent's own frame for the corrector; body: of its vehicle, used where the frame states none."""
        if self.net is None:
            landmarks = self._select_landmarks(cache.process(frame).boxes, None, 0.0)
            return landmarks if frame.is_infrastructure else append_body(landmarks, frame.body, body)
        points = extract_own_keypoints(self.net, cache, frame)
        return self._select_landmarks(points.boxes, points.descriptor, 0.0)

    def _message_landmarks(
        self, cache: PerceptionCache, message: Message, seconds: float, body: BodyEstimate | None = None
    ) -> Landmarks:
        """Return landmarks of a message of that age; none if the corrector needs descriptors and the message has none."""
        if self.net is None:
            landmarks = self._select_landmarks(extract_message_boxes(cache, message), None, seconds)
            # An older message does not give the sender's own position now: its velocity is not sent.
            return landmarks if message.is_infrastructure or seconds else append_body(landmarks, message.body, body)
        points = extract_message_keypoints(message)
        return Landmarks.empty() if points is None else self._select_landmarks(points.boxes, points.descriptor, seconds)

    def _update_bodies(
        self,
        frame: AgentFrame,
        messages: Sequence[Message],
        landmarks: Sequence[Landmarks],
        estimates: Sequence[PoseEstimate],
        bodies: Mapping[int, BodyEstimate | None],
    ) -> dict[int, BodyEstimate | None]:
        """Return the estimated bodies of the ego and of senders that state none. landmarks: of the ego, then of the senders."""
        updated = dict(bodies)
        if self.net is not None:
            return updated
        own = landmarks[0] if frame.is_infrastructure else landmarks[0][:-1]
        for message, theirs, estimate in zip(messages, landmarks[1:], estimates):
            if message.timestamp_ns != frame.timestamp_ns or not estimate.status.has_estimate:
                continue
            time_s, pairs = frame.timestamp_ns * 1e-9, estimate.pairs
            theirs = theirs if message.is_infrastructure else theirs[:-1]
            if message.body is None and not message.is_infrastructure:
                agent = message.agent_id
                updated[agent] = update_body(updated.get(agent), own, theirs, pairs, time_s)
            if frame.body is None and not frame.is_infrastructure:
                agent = frame.agent_id
                updated[agent] = update_body(updated.get(agent), theirs, own, pairs[:, ::-1], time_s)
        return updated

    def _select_landmarks(self, boxes: Boxes, descriptor: Tensor | None, seconds: float) -> Landmarks:
        """Return boxes above min_score, propagated by their age."""
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

    def _propagate_priors(
        self,
        frame: AgentFrame,
        cache: PerceptionCache,
        messages: Sequence[Message],
        last_corrected: Mapping[int, Message | None],
        estimates: Sequence[PoseEstimate],
    ) -> dict[int, PosePrior]:
        """Propagated priors, by message, of senders whose estimate does not agree with the prior."""
        propagated = dict[int, PosePrior]()
        for n, (message, estimate) in enumerate(zip(messages, estimates)):
            last = last_corrected.get(message.agent_id)
            if last is None or estimate.status in (PoseStatus.OK, PoseStatus.CORRECTED):
                continue
            prior = self._propagate_prior(frame, cache, last, message)
            if prior is not None:
                propagated[n] = prior
        return propagated

    def _use_propagated(
        self,
        own: Landmarks,
        landmarks: Sequence[Landmarks],
        priors: list[PosePrior | None],
        estimates: list[PoseEstimate],
        propagated: Mapping[int, PosePrior],
        health: Sequence[PoseReport],
    ) -> set[int]:
        """Match again with the propagated priors where nothing was measured, and put these and the new estimates in place where
        they are better, as where the stated priors have an offset or a drift; returns the rows of these.
        """
        used = set[int]()
        for n, prior in propagated.items():
            if estimates[n].status.has_estimate:
                continue
            estimate = load_corrector(self.corrector)(own, landmarks[n], prior)
            if contradicts_both(estimate, priors[n], prior):
                estimate = no_estimate(prior, PoseStatus.AMBIGUOUS)
            is_faulty = health[n].health in _FAULTY
            if estimate.status.has_estimate or is_faulty or not self._supports_stated(priors[n], prior):
                priors[n], estimates[n] = prior, estimate
                used.add(n)
        return used

    def _propagate_prior(
        self, frame: AgentFrame, cache: PerceptionCache, last: Message, message: Message
    ) -> PosePrior | None:
        """Prior of a sender from its last corrected pose and its motion between both messages; None if the last message is too old
        or its landmarks do not match.
        """
        seconds = (message.timestamp_ns - last.timestamp_ns) * 1e-9
        if not 0 < seconds <= self.propagate_s:
            return None
        then, now = self._message_landmarks(cache, last, seconds), self._message_landmarks(cache, message, 0.0)
        sigma_motion = np.array([self.sigma_speed_mps, self.sigma_speed_mps, self.sigma_yaw_rate_rps]) * seconds
        motion = load_corrector(self.corrector)(then, now, PosePrior(Transform.identity(), np.diag(sigma_motion**2)))
        return propagate_prior(PosePrior.between(frame, last), motion)

    def _update_monitor(
        self,
        states: dict[int, SenderState],
        bodies: Mapping[int, BodyEstimate | None],
        message: Message,
        prior: PosePrior | None,
        estimate: PoseEstimate,
    ) -> PoseReport:
        """Update the monitor of a message's sender and return its report; a repeated message does not change the monitor."""
        # The last entries are those of the last received senders.
        before = states.pop(message.agent_id, None)
        monitor, time_s = before.monitor if before else PoseMonitorState.new(), message.timestamp_ns * 1e-9
        if len(monitor.time_s) and time_s < monitor.time_s[-1]:
            # A decreasing timestamp starts a new drive.
            monitor = PoseMonitorState.new()
        again = bool(len(monitor.time_s)) and time_s == monitor.time_s[-1]
        monitor, report = update_monitor(monitor, estimate, None if again else prior, time_s, self.monitor)
        states[message.agent_id] = SenderState(monitor, body=bodies.get(message.agent_id))
        return report

    def _optimize_jointly(
        self,
        messages: Sequence[Message],
        landmarks: Sequence[Landmarks],
        priors: Sequence[PosePrior | None],
        pairwise_estimates: Sequence[PoseEstimate],
    ) -> tuple[dict[int, PoseEstimate], set[int]]:
        """Joint estimates of the senders' poses where pairs of senders match too; and the isolated senders.

        landmarks: of the ego, then of the senders.
        """
        correct_jointly = find_joint_corrector(self.corrector)
        if correct_jointly is not None:
            estimates = correct_jointly(landmarks, priors)
            return {n: estimate for n, estimate in enumerate(estimates) if estimate.status.has_estimate}, set()
        ego_edges = [_make_edge(EGO_NODE, n + 1, pairwise) for n, pairwise in enumerate(pairwise_estimates)]
        sender_edges = []
        for i, j in itertools.combinations(range(len(messages)), 2):
            prior = _make_prior(messages[i], messages[j])
            estimate = load_corrector(self.corrector)(landmarks[i + 1], landmarks[j + 1], prior)
            sender_edges.append(_make_edge(i + 1, j + 1, estimate))
        if not any(sender_edges):
            return {}, set()
        prior_by_node = {
            n + 1: inflate_covariance(prior, pairwise.mahalanobis_squared)
            for n, (prior, pairwise) in enumerate(zip(priors, pairwise_estimates))
            if prior is not None and pairwise.status is not PoseStatus.CONFLICT
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

    def _supports_stated(self, stated: PosePrior | None, propagated: PosePrior) -> bool:
        """Whether a propagated pose agrees with a prior that is more certain."""
        return (
            stated is not None
            and priors_agree(stated, propagated)
            and self._sigma_m(stated.covariance) <= self._sigma_m(propagated.covariance)
        )

    def _sigma_m(self, covariance: Floats) -> float:
        """Standard deviation (m) of a position at lever_arm_m from the sender."""
        if not np.isfinite(covariance).all():
            return math.inf
        variance_xy = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        return math.sqrt(max(variance_xy + self.lever_arm_m**2 * float(covariance[2, 2]), 0.0))

    def _decide_use(
        self, estimate: PoseEstimate, pairwise: PoseEstimate, connected: bool, inconsistent: bool, health: PoseReport
    ) -> tuple[MessageUse, float]:
        """Use of a message with this estimate; connected: its landmarks match those of any other agent."""
        sigma = self._sigma_m(estimate.covariance)
        has_estimate = connected or pairwise.status.has_estimate
        is_faulty = not has_estimate and health.health in _FAULTY
        if inconsistent:
            return MessageUse.INCONSISTENT, sigma
        if estimate.ego_from_other is None or is_faulty or not sigma <= self.max_sigma_m:
            return MessageUse.UNCERTAIN, sigma
        return MessageUse.CORRECTED if has_estimate else MessageUse.PRIOR, sigma


def extract_message_boxes(cache: PerceptionCache, message: Message) -> Boxes:
    """Objects of a message in its sender's frame: sent, proposed by its tokens, or detected in its points."""
    if message.objects is not None:
        return message.objects
    tokens = message.tokens
    if tokens is not None and tokens.features.is_floating_point() and tokens.features.shape[1] >= PROPOSAL_DIM:
        return cache.decode(RawBoxes.of(tokens.features[:, -PROPOSAL_DIM:].float(), tokens.sites))
    return cache.run_detector(message.points).boxes if message.points is not None else Boxes.empty()


def apply_correction(message: Message, frame: AgentFrame, estimate: PoseEstimate) -> Message:
    """Return the message with its sender's pose replaced by the estimate, relative to the ego's prior pose."""
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


def _make_prior(one: AgentFrame | Message, other: Message) -> PosePrior | None:
    """Return the prior of two agents' reported poses; None if a pose is unknown."""
    return PosePrior.between(one, other) if has_known_pose(one) and has_known_pose(other) else None


def _make_edge(i: int, j: int, estimate: PoseEstimate) -> RelativePoseEdge | None:
    """Return the pose graph edge of two agents; None without a match."""
    if not estimate.status.has_estimate or estimate.measured is None or estimate.measured_covariance is None:
        return None
    return RelativePoseEdge(i, j, estimate.measured, estimate.measured_covariance)
