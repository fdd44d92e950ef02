# SPDX-License-Identifier: Apache-2.0
"""The step of one agent: share encodes its observation to packets, perceive fuses it with received packets to boxes."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from manyeyes.agents.fusion_selection import KnownSenders, first_fusion_ns, select_for_fusion, update_known_senders
from manyeyes.agents.isolation import Quarantine, content_error, isolate_failing
from manyeyes.agents.message_history import MessageHistory
from manyeyes.agents.own_detections import remove_own_body, restore_own_boxes
from manyeyes.agents.perception_cache import History, PerceptionCache
from manyeyes.agents.pose_correction import CorrectionOutcome, PoseCorrection, SenderState
from manyeyes.agents.pose_plausibility import (
    AcceptedPoses,
    accept_poses,
    find_pose_fault,
    has_known_pose,
    with_unknown_pose,
)
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.agents.strategies.registry import FusionStrategy
from manyeyes.agents.strategies.request_maps import make_request_map
from manyeyes.agents.token_codec import (
    compress_tokens,
    decode_tokens,
    default_token_encoding,
    encode_tokens,
    has_token_history,
    make_token_format,
    pack_tokens,
    require_clusters,
    require_codebook,
    unpack_tokens,
)
from manyeyes.agents.trust.claims import extract_claims
from manyeyes.agents.trust.fusion_weights import weigh_received
from manyeyes.agents.trust.interface import Assessment, MisbehaviourDetector, MisbehaviourInput
from manyeyes.agents.trust.orphans import bound_orphans, find_orphans
from manyeyes.agents.trust.result_evidence import ResultEvidence, bound_scores, find_result_evidence
from manyeyes.comms import wire
from manyeyes.comms.admission import Authenticator
from manyeyes.comms.agent_body import count_agent_body_bytes
from manyeyes.comms.inbox import Inbox, ReceivedMessage, Rejection
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.signatures.envelope import UNSIGNED, EnvelopeSize
from manyeyes.comms.token_selection import SelectedTokens, select_for_packets
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev
from manyeyes.models.detector.protocols import BoxDetector, check_detector, require_tokens
from manyeyes.models.score_calibration import calibrate_boxes
from manyeyes.ops.lidar.free_range import measure_sight

if TYPE_CHECKING:
    from manyeyes.agents.map_perception import MapPredictor


@dataclass(frozen=True)
class Perception:
    """Result of one perception.

    boxes: in the agent's frame, by falling score, which is calibrated where the weights are (``models.score_calibration``).
    received: the fused messages by agent id, with their corrected poses. corrections: one for each received message, where the
    agent corrects poses, between levelled frames. rejected: senders whose content was excluded, wholly or in part, with the reason.
    assessment: of the senders, where the agent has a misbehaviour detector. evidence: on each box, where it assesses claims.
    """

    boxes: Boxes
    received: tuple[ReceivedMessage, ...]
    corrections: tuple[CorrectionOutcome, ...] = ()
    rejected: tuple[Rejection, ...] = ()
    assessment: Assessment | None = None
    evidence: ResultEvidence | None = None


@dataclass(frozen=True)
class _State:
    """State of an agent; a new one is stored only if the whole perception succeeded."""

    message_history: MessageHistory
    sender_states: Mapping[int, SenderState]
    accepted_poses: AcceptedPoses
    history: History
    assessment: Assessment | None


@dataclass(frozen=True)
class _Attempt:
    """One successful fusion, and the state after it."""

    perception: Perception
    state: _State


class Agent:
    """A detector, the shipped one or your own, a fusion strategy, and a byte budget for each message.

    Agents exchange nothing but the packets of share; frames carry no labels, so ground truth cannot leak by type.
    token_encoding: of the tokens; None: the default of these weights (``agents.token_codec``).
    send_request_map: messages with tokens carry a request map, one byte a window (``comms.request_map``).
    send_sight: messages carry the free space about the agent's LiDAR, 248 bytes (``datatypes.sight``).
    pose_correction: corrects prior poses of senders before fusion; None uses the prior poses. map_predictor: predicts the local map
    that the agent sends (``agents.map_perception``); None sends no map. token_format: of the tokens that the agent can fuse.
    misbehaviour: assesses senders before fusion (``agents.trust``); None fuses all with weight 1.
    """

    def __init__(
        self,
        detector: BoxDetector,
        strategy: FusionStrategy | None = None,
        token_encoding: TokenEncoding | None = None,
        budget_bytes: int | None = 1 << 17,
        perception_cache: PerceptionCache | None = None,
        pose_correction: PoseCorrection | None = None,
        send_request_map: bool = False,
        map_predictor: MapPredictor | None = None,
        misbehaviour: MisbehaviourDetector | None = None,
        send_sight: bool = False,
    ) -> None:
        check_detector(detector)
        self.perception_cache, self.message_history = perception_cache or PerceptionCache(detector), MessageHistory()
        self.pose_correction = pose_correction
        self.misbehaviour = misbehaviour
        self._assessment: Assessment | None = None
        self._sender_states: Mapping[int, SenderState] = {}
        self._accepted_poses: AcceptedPoses = {}
        self._known_senders: KnownSenders = {}
        self.strategy = strategy or IntermediateFusion(novelty_score, uses_history=True)
        self._quarantine = Quarantine()
        self.limits = ReceiverLimits() if self.strategy.uses_points else ReceiverLimits(max_points=0)
        if self.strategy.needs_tokens:
            require_tokens(detector)
        self.token_encoding: TokenEncoding = token_encoding or default_token_encoding(detector)
        self.budget_bytes = budget_bytes
        self.send_request_map, self.map_predictor = send_request_map, map_predictor
        self.send_sight = send_sight
        self.token_format = make_token_format(detector)
        if token_encoding == "codebook":
            require_codebook(detector)
        if token_encoding == "clusters":
            require_clusters(detector)

    def share(
        self,
        frame: AgentFrame,
        budget_bytes: int | None = None,
        requests: Sequence[Message] = (),
        envelope: EnvelopeSize = UNSIGNED,
    ) -> list[bytes]:
        """Return packets of this frame, most important first; an empty list if there is nothing to send.

        budget_bytes: a limit below the agent's own, for a shared channel. A message with tokens never exceeds it, even if nothing
        is sent; objects, points and the map are not limited, but reduce the bytes left for tokens. requests: received messages;
        those with a request map weight the tokens by the sender's lack of confidence there. envelope: bytes that a signature adds
        to the packets before they are sent: packets leave room for it, and the budget includes it.
        """
        frame = self.perception_cache.level(frame).levelled
        untrusted = self._find_excluded(requests, frame.timestamp_ns)
        requests = [request for request in requests if request.agent_id not in untrusted]
        budget = min((b for b in (self.budget_bytes, budget_bytes) if b is not None), default=None)
        message = self._compose(frame, requests)
        if message is None:
            return []
        mtu = wire.DEFAULT_MTU - envelope.max_bytes
        bodies = wire.encode_other_sections(message, mtu)
        if message.tokens is None:
            return wire.make_packets(message, bodies)
        budget = None if budget is None else budget - envelope.message_bytes
        left = None if budget is None else budget - wire.count_bytes(bodies, message.body, envelope.packet_bytes)
        kept, selected = self._select(message, message.tokens, left, envelope)
        encoded = replace(message, tokens=selected.tokens, token_score=selected.score)
        bodies += wire.encode_tokens(
            encoded,
            token_encoding=self.token_encoding,
            mtu=mtu,
            tables=self.token_format.tables,
            counts=selected.counts,
            own_bytes=self._own_bytes,
        )
        packets = wire.make_packets(message, bodies)
        self.strategy.record_sent(self.perception_cache, frame, kept)
        num_bytes = sum(len(packet) + envelope.packet_bytes for packet in packets)
        return [] if budget is not None and num_bytes > budget else packets

    @property
    def _own_bytes(self) -> int:
        """Last bytes of a row of clusters, which are the token's own; 0 of other encodings."""
        form = self.token_format.cluster_form
        return 0 if form is None or self.token_encoding != "clusters" else form[1]

    def _compose(self, frame: AgentFrame, requests: Sequence[Message]) -> Message | None:
        """Return the message of the strategy, with the local map, descriptors, request map and sight that the agent adds."""
        message = self.strategy.compose_message(self.perception_cache, frame, requests)
        local_map = None if self.map_predictor is None else self.map_predictor(frame, requests)
        if local_map is not None:
            message = replace(
                message or make_header(frame, self.perception_cache.detector.fingerprint), local_map=local_map
            )
        if message is not None and self.pose_correction is not None:
            message = self.pose_correction.attach_descriptors(frame, self.perception_cache, message)
        sends_request_map = self.send_request_map or getattr(self.strategy, "needs_request_map", False)
        if message is not None and message.tokens is not None and sends_request_map and message.request is None:
            message = replace(message, request=make_request_map(self.perception_cache, frame))
        if message is not None and self.send_sight and message.sight is None:
            message = replace(message, sight=measure_sight(frame.points.xyz, frame.sensor_height_m))
        return message

    def _select(
        self, message: Message, tokens: SparseBev, budget_bytes: int | None, envelope: EnvelopeSize
    ) -> tuple[Message, SelectedTokens]:
        """Return the message with the tokens that fit into a budget, as the detector made them, and them as they are encoded."""
        detector = self.perception_cache.detector
        packed = pack_tokens(compress_tokens(tokens, detector), detector)
        packed = packed.with_features(self.token_format.clamp(packed.features))
        tokens = unpack_tokens(packed, detector)
        encoded, tables = encode_tokens(packed, detector, self.token_encoding), self.token_format.tables
        score = torch.ones(len(tokens.sites)) if message.token_score is None else message.token_score
        mtu = wire.DEFAULT_MTU - envelope.max_bytes - count_agent_body_bytes(message.body)
        selected = select_for_packets(
            encoded, score, budget_bytes, self.token_encoding, mtu, tables, envelope.packet_bytes, self._own_bytes
        )
        if selected.tokens is not encoded:
            tokens = tokens.keep(torch.isin(tokens.sites.key, selected.tokens.sites.key))
        return replace(message, tokens=tokens, token_score=selected.score), selected

    def inbox(self, expire_ns: int | None = None, authenticator: Authenticator | None = None) -> Inbox:
        """Return an inbox that accepts only tokens that this agent can fuse, from senders that the authenticator accepts."""
        limits = self.limits if expire_ns is None else replace(self.limits, max_age_ns=expire_ns)
        return Inbox(token_format=self.token_format, limits=limits, authenticator=authenticator)

    def perceive(self, frame: AgentFrame, inbox: Inbox | Iterable[bytes] = (), now_ns: int | None = None) -> Perception:
        """Return boxes around the agent from its own frame and from the messages received so far.

        Received content never raises: what cannot be fused is excluded and listed in ``Perception.rejected``. A failed perception
        changes no state.

        inbox: an Inbox that packets were pushed into, preferably the agent's own (``inbox``), or plain packets, which arrive at
        now_ns. now_ns: end of the latency budget, by default the time of the frame; ages of messages are relative to it.
        """
        level = self.perception_cache.level(frame)
        frame = level.levelled
        now_ns = frame.timestamp_ns if now_ns is None else now_ns
        if not isinstance(inbox, Inbox):
            packets, inbox = inbox, self.inbox()
            for packet in packets:
                inbox.push(packet, now_ns)
        rejected, received = list(inbox.take_rejections()), list[ReceivedMessage]()
        for reception in inbox.received_messages(now_ns):
            if reception.message.agent_id != frame.agent_id:
                checked, rejections = self._check(frame, reception, now_ns, inbox.limits)
                received += [] if checked is None else [checked]
                rejected += rejections
        weights = self._find_weights([reception.message for reception in received], now_ns)
        selected, left_out = select_for_fusion(frame, received, self._known_senders, inbox.limits, weights)
        perception, failed = self._perceive(frame, selected)
        for rejection in failed:
            inbox.discard(rejection.agent_id)
        if perception.assessment is not None:
            inbox.set_trust({sender.agent_id: sender.trust for sender in perception.assessment.senders})
        fused = {reception.message.agent_id for reception in perception.received}
        self._known_senders = update_known_senders(self._known_senders, fused, frame.timestamp_ns)
        # The pose of a fused sender was estimated.
        rejected = [
            rejection for rejection in rejected if rejection.reason != "pose" or rejection.agent_id not in fused
        ]
        boxes = calibrate_boxes(self.perception_cache.detector, self.strategy.score_form, perception.boxes)
        if level.levelled_from_agent is not None:
            boxes = boxes.transform(level.levelled_from_agent.inverse())
        evidence = perception.evidence
        if evidence is not None:
            boxes, evidence = bound_scores(boxes, evidence)
        rejected += perception.rejected
        return replace(perception, boxes=boxes, evidence=evidence, rejected=(*rejected, *left_out, *failed))

    def reset_history(self) -> None:
        """Forget what was received and perceived before: times before now are those of another clock."""
        self.perception_cache.clear()
        self.message_history = MessageHistory()
        self._sender_states, self._accepted_poses, self._known_senders, self._assessment = {}, {}, {}, None

    def _check(
        self, frame: AgentFrame, reception: ReceivedMessage, now_ns: int, limits: ReceiverLimits
    ) -> tuple[ReceivedMessage | None, list[Rejection]]:
        """Return a message with decoded tokens and a plausible or an unknown pose, or None; and what is rejected of it."""
        message = reception.message
        if self._quarantine.contains(message.agent_id, now_ns):
            return None, [Rejection(message.agent_id, "quarantined", "its content made fusion fail before")]
        if not -limits.max_skew_ns <= now_ns - message.timestamp_ns <= limits.max_age_ns:
            text = f"captured {(now_ns - message.timestamp_ns) / 1e9:.4g} s before the receiver's time"
            return None, [Rejection(message.agent_id, "time", text)]
        try:
            decoded, rejection = decode_tokens(reception, self.perception_cache.detector, self.token_format)
            fault = find_pose_fault(frame, message, self._accepted_poses.get(message.agent_id), limits)
        except Exception as error:
            return None, [content_error(message.agent_id, error)]
        rejections = [] if rejection is None else [rejection]
        if decoded.num_tokens > limits.max_fused_message_tokens:
            text = f"{decoded.num_tokens} tokens; at most {limits.max_fused_message_tokens} are fused"
            rejections.append(Rejection(message.agent_id, "cells", text))
            decoded = replace(decoded, message=replace(decoded.message, tokens=None, token_score=None))
        if fault is None:
            return decoded, rejections
        rejections.append(Rejection(message.agent_id, "pose", fault))
        if self.pose_correction is None:
            return None, rejections
        return replace(decoded, message=with_unknown_pose(decoded.message)), rejections

    def _perceive(self, frame: AgentFrame, received: Sequence[ReceivedMessage]) -> tuple[Perception, list[Rejection]]:
        """Fuse the messages that can be fused together, and reject the others; the state is stored."""
        stored, now_ns = self.message_history.senders, frame.timestamp_ns
        current = {reception.message.agent_id: reception for reception in received}
        failed: list[Rejection] = []

        def attempt(senders: Sequence[int]) -> _Attempt:
            usable = [reception for sender, reception in sorted(current.items()) if sender in senders]
            return self._try_perceive(frame, usable, (stored | current.keys()) - set(senders))

        # Of two senders that cannot be fused together, the newer one is excluded.
        senders = sorted(stored | current.keys(), key=lambda s: (first_fusion_ns(self._known_senders, s), s))
        try:
            done = attempt(senders)
        except Exception as error:
            isolated = isolate_failing(attempt, senders, error)
            done = isolated.result
            failed = [content_error(sender, cause) for sender, cause in sorted(isolated.errors.items())]
            for sender in sorted(isolated.errors.keys() - isolated.untested):
                self._quarantine = self._quarantine.add(sender, now_ns)
        self._restore(done.state)
        return done.perception, failed

    def _try_perceive(
        self, frame: AgentFrame, received: Sequence[ReceivedMessage], excluded: Collection[int]
    ) -> _Attempt:
        """Return one perception without excluded senders and the state after it; the agent's own state is restored."""
        before = replace(self._state, message_history=copy(self.message_history))
        try:
            stated = [reception.message for reception in received]
            self._accepted_poses = accept_poses(self._accepted_poses, stated, frame.timestamp_ns)
            watched = self._find_excluded(stated, frame.timestamp_ns)
            corrected, corrections = self._correct_poses(
                frame, tuple(r for r in received if r.message.agent_id not in watched)
            )
            excluded_senders = [r for r in received if r.message.agent_id in watched]
            usable, distrusted = self._assess(frame, (*corrected, *excluded_senders), corrections)
            messages = [reception.message for reception in usable]
            if self.strategy.uses_history and has_token_history(self.perception_cache.detector):
                untrusted = {correction.agent_id for correction in corrections if correction.untrusted}
                untrusted.update(excluded, (rejection.agent_id for rejection in distrusted))
                messages = self.message_history.update_and_get(messages, frame.timestamp_ns, untrusted)
            boxes = self.strategy.fuse(self.perception_cache, frame, messages)
            own = self.perception_cache.process(frame).boxes
            boxes = self._bound_orphans(frame, remove_own_body(restore_own_boxes(boxes, own), frame), messages)
            evidence = find_result_evidence(boxes, own, self._assessment)
            perception = Perception(boxes, usable, corrections, distrusted, self._assessment, evidence)
            return _Attempt(perception, self._state)
        finally:
            self._restore(before)

    def _find_excluded(self, messages: Sequence[Message], now_ns: int) -> frozenset[int]:
        """Return the senders that the misbehaviour detector excludes by its state."""
        if self.misbehaviour is None:
            return frozenset()
        state = None if self._assessment is None else self._assessment.state
        return self.misbehaviour.excluded(state, [message.agent_id for message in messages], now_ns)

    def _find_weights(self, messages: Sequence[Message], now_ns: int) -> dict[int, float]:
        """Return the weights of senders by the last assessment; 0 of those that the misbehaviour detector excludes."""
        last = {} if self._assessment is None else self._assessment.weights
        return {**last, **dict.fromkeys(self._find_excluded(messages, now_ns), 0.0)}

    def _assess(
        self, frame: AgentFrame, received: Sequence[ReceivedMessage], corrections: Sequence[CorrectionOutcome]
    ) -> tuple[tuple[ReceivedMessage, ...], tuple[Rejection, ...]]:
        """Return the messages that are fused, weighted by the trust in their senders; and the senders that are excluded."""
        if self.misbehaviour is None:
            return tuple(received), ()
        cache = self.perception_cache
        known = sorted((r for r in received if has_known_pose(r.message)), key=lambda r: r.message.agent_id)
        messages = tuple(reception.message for reception in known)

        def fuse(senders: Collection[int]) -> Boxes:
            history = cache.history
            try:
                return self.strategy.fuse(cache, frame, [m for m in messages if m.agent_id in senders])
            finally:
                cache.history = history

        content = MisbehaviourInput(
            frame,
            cache.process(frame).boxes,
            messages,
            lambda: extract_claims(frame, cache, messages),
            fuse,
            frozenset(correction.agent_id for correction in corrections if correction.is_faulty),
        )
        state = None if self._assessment is None else self._assessment.state
        self._assessment = self.misbehaviour.assess(content, state)
        return weigh_received(frame, known, self._assessment)

    def _bound_orphans(self, frame: AgentFrame, boxes: Boxes, messages: Sequence[Message]) -> Boxes:
        """Return the boxes with bounded scores where no agent proposes an object; senders of several such are recorded."""
        if self.misbehaviour is None or self._assessment is None or self._assessment.claims is None:
            return boxes
        orphans = find_orphans(frame, boxes, self.perception_cache, messages, self._assessment)
        if orphans is None:
            return boxes
        state = self.misbehaviour.record_orphans(self._assessment.state, orphans.senders)
        self._assessment = replace(self._assessment, state=state)
        return bound_orphans(boxes, orphans)

    @property
    def _state(self) -> _State:
        history = self.perception_cache.history
        return _State(self.message_history, self._sender_states, self._accepted_poses, history, self._assessment)

    def _restore(self, state: _State) -> None:
        self.message_history, self._sender_states = state.message_history, state.sender_states
        self._accepted_poses, self.perception_cache.history = state.accepted_poses, state.history
        self._assessment = state.assessment

    def _correct_poses(
        self, frame: AgentFrame, received: tuple[ReceivedMessage, ...]
    ) -> tuple[tuple[ReceivedMessage, ...], tuple[CorrectionOutcome, ...]]:
        """Return messages with corrected poses, without those whose pose is unknown, uncertain or inconsistent."""
        if self.pose_correction is None:
            return received, ()
        corrected = self.pose_correction.correct(
            frame, self.perception_cache, [r.message for r in received], self._sender_states
        )
        self._sender_states = dict(corrected.states)
        message_of_agent = {message.agent_id: message for message in corrected.messages}
        kept = (
            replace(r, message=message_of_agent[r.message.agent_id])
            for r in received
            if r.message.agent_id in message_of_agent
        )
        return tuple(kept), corrected.corrections
