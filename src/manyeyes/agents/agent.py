# SPDX-License-Identifier: Apache-2.0
"""The step of one agent: share encodes its observation to packets, perceive fuses it with received packets to boxes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from manyeyes.agents.message_history import MessageHistory
from manyeyes.agents.perception_cache import History, PerceptionCache
from manyeyes.agents.pose_correction import CorrectionOutcome, PoseCorrection, SenderState
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.registry import FusionStrategy
from manyeyes.agents.strategies.request_maps import make_request_map
from manyeyes.agents.token_codec import (
    decode_tokens,
    default_token_encoding,
    make_token_format,
    quantise_tokens,
    require_codebook,
)
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox, ReceivedMessage, Rejection
from manyeyes.comms.token_format import clamp_features
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev
from manyeyes.models.detector.protocols import BoxDetector, check_detector, require_tokens

if TYPE_CHECKING:
    from manyeyes.agents.map_perception import MapPredictor

EGO_HALF_SIZE_M = (2.6, 1.3)


@dataclass(frozen=True)
class Perception:
    """Result of one perception.

    boxes: in the agent's frame, by falling score. received: the fused messages by agent id, with their corrected poses.
    corrections: one for each received message, where the agent corrects poses. rejected: senders whose content was excluded, wholly
    or in part, with the reason.
    """

    boxes: Boxes
    received: tuple[ReceivedMessage, ...]
    corrections: tuple[CorrectionOutcome, ...] = ()
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class _State:
    """State after a perception; it is stored only if the whole perception succeeded."""

    message_history: MessageHistory
    sender_states: dict[int, SenderState]
    history: History


class Agent:
    """A detector, the shipped one or your own, a fusion strategy, and a byte budget for each message.

    Agents exchange nothing but the packets of share; frames carry no labels, so ground truth cannot leak by type.
    token_encoding: of the tokens; None: the default of these weights (``agents.token_codec``).
    send_request_map: messages with tokens carry a request map, one byte a window (``comms.request_map``).
    pose_correction: corrects prior poses of senders before fusion; None uses the prior poses. map_predictor: predicts the local map
    that the agent sends (``agents.map_perception``); None sends no map. token_format: of the tokens that the agent can fuse.
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
    ) -> None:
        check_detector(detector)
        self.perception_cache, self.message_history = perception_cache or PerceptionCache(detector), MessageHistory()
        self.pose_correction, self._sender_states = pose_correction, dict[int, SenderState]()
        self.strategy = strategy or IntermediateFusion()
        if self.strategy.needs_tokens:
            require_tokens(detector)
        self.token_encoding: TokenEncoding = token_encoding or default_token_encoding(detector)
        self.budget_bytes = budget_bytes
        self.send_request_map, self.map_predictor = send_request_map, map_predictor
        self.token_format = make_token_format(detector)
        if token_encoding == "codebook":
            require_codebook(detector)

    def share(
        self, frame: AgentFrame, budget_bytes: int | None = None, requests: Sequence[Message] = ()
    ) -> list[bytes]:
        """Return packets of this frame, most important first; an empty list if there is nothing to send.

        budget_bytes: a limit below the agent's own, for a shared channel. A message with tokens never exceeds it, even if nothing
        is sent; objects, points and the map are not limited, but reduce the bytes left for tokens. requests: received messages;
        those with a request map weight the tokens by the sender's lack of confidence there.
        """
        budget = min((b for b in (self.budget_bytes, budget_bytes) if b is not None), default=None)
        message = self._compose(frame, requests)
        if message is None:
            return []
        bodies = wire.encode_other_sections(message)
        if message.tokens is None:
            return wire.make_packets(message, bodies)
        left = None if budget is None else budget - wire.count_bytes(bodies)
        kept, encoded = self._select(message, message.tokens, left)
        bodies += wire.encode_tokens(encoded, token_encoding=self.token_encoding, tables=self.token_format.tables)
        packets = wire.make_packets(message, bodies)
        self.strategy.record_sent(self.perception_cache, frame, kept)
        return [] if budget is not None and sum(map(len, packets)) > budget else packets

    def _compose(self, frame: AgentFrame, requests: Sequence[Message]) -> Message | None:
        """Return the message of the strategy, with the local map, descriptors and request map that the agent adds."""
        message = self.strategy.compose_message(self.perception_cache, frame, requests)
        local_map = None if self.map_predictor is None else self.map_predictor(frame, requests)
        if local_map is not None:
            message = replace(
                message or make_header(frame, self.perception_cache.detector.fingerprint), local_map=local_map
            )
        if message is not None and self.pose_correction is not None:
            message = self.pose_correction.attach_descriptors(frame, self.perception_cache, message)
        if message is not None and message.tokens is not None and self.send_request_map:
            message = replace(message, request=make_request_map(self.perception_cache, frame))
        return message

    def _select(self, message: Message, tokens: SparseBev, budget_bytes: int | None) -> tuple[Message, Message]:
        """Return the message with the tokens that fit into a budget, as the detector made them, and as they are encoded."""
        tokens = tokens.with_features(clamp_features(tokens.features))
        is_coded, tables = self.token_encoding == "codebook", self.token_format.tables
        encoded = quantise_tokens(tokens, self.perception_cache.detector) if is_coded else tokens
        score = torch.ones(len(tokens.sites)) if message.token_score is None else message.token_score
        encoded, score = select_within_budget(encoded, score, budget_bytes, self.token_encoding, tables=tables)
        kept = tokens.keep(torch.isin(tokens.sites.key, encoded.sites.key))
        return replace(message, tokens=kept, token_score=score), replace(message, tokens=encoded, token_score=score)

    def inbox(self, expire_ns: int | None = None) -> Inbox:
        """Return an inbox that accepts only tokens that this agent can fuse."""
        return Inbox(expire_ns=expire_ns, token_format=self.token_format)

    def perceive(self, frame: AgentFrame, inbox: Inbox | Iterable[bytes] = (), now_ns: int | None = None) -> Perception:
        """Return boxes around the agent from its own frame and from the messages received so far.

        Received content never raises: tokens of another format are excluded, and a sender whose content makes fusion fail is
        excluded as a whole; both are listed in ``Perception.rejected``. A failed perception changes no state.

        inbox: an Inbox that packets were pushed into, preferably the agent's own (``inbox``), or plain packets. now_ns: end of the
        latency budget; messages that have expired by then are excluded.
        """
        if not isinstance(inbox, Inbox):
            packets, inbox = inbox, self.inbox()
            for packet in packets:
                inbox.push(packet)
        rejected, received = list(inbox.take_rejections()), list[ReceivedMessage]()
        for reception in inbox.received_messages(now_ns):
            if reception.message.agent_id != frame.agent_id:
                decoded, rejection = decode_tokens(reception, self.perception_cache.detector, self.token_format)
                received.append(decoded)
                rejected += [] if rejection is None else [rejection]
        perception, failed = self._perceive(frame, received)
        for rejection in failed:
            inbox.discard(rejection.agent_id)
        return replace(perception, rejected=(*rejected, *failed))

    def _perceive(self, frame: AgentFrame, received: list[ReceivedMessage]) -> tuple[Perception, list[Rejection]]:
        """Fuse the messages that can be fused, and reject the others."""
        failed: list[Rejection] = []
        try:
            perception, state = self._try_perceive(frame, received)
        except Exception as error:
            failed = self._find_failing(frame, received, error)
            agent_ids = {rejection.agent_id for rejection in failed}
            left = [reception for reception in received if reception.message.agent_id not in agent_ids]
            try:
                perception, state = self._try_perceive(frame, left)
            except Exception as joint_error:
                # Each message can be fused alone, but not all together: reject all of them and clear the history.
                failed += [_content_error(reception, joint_error) for reception in left]
                self.message_history, self._sender_states = MessageHistory(), {}
                perception, state = self._try_perceive(frame, [])
        self.message_history, self._sender_states, self.perception_cache.history = (
            state.message_history,
            state.sender_states,
            state.history,
        )
        return perception, failed

    def _find_failing(
        self, frame: AgentFrame, received: Sequence[ReceivedMessage], error: Exception
    ) -> list[Rejection]:
        """Find messages whose content alone makes fusion fail, by bisection of a group that fails."""
        if len(received) <= 1:
            return [_content_error(reception, error) for reception in received]
        failed = []
        for half in (received[: len(received) // 2], received[len(received) // 2 :]):
            try:
                self._try_perceive(frame, half)
            except Exception as half_error:
                failed += self._find_failing(frame, half, half_error)
        return failed

    def _try_perceive(self, frame: AgentFrame, received: Sequence[ReceivedMessage]) -> tuple[Perception, _State]:
        """Return one perception and the state after it; the agent's own state is restored, also after an error."""
        before = _State(copy(self.message_history), self._sender_states, self.perception_cache.history)
        try:
            usable, corrections = self._correct_poses(frame, tuple(received))
            messages = [reception.message for reception in usable]
            if self.strategy.uses_history:
                untrusted = [correction.agent_id for correction in corrections if correction.untrusted]
                messages = self.message_history.update_and_get(messages, frame.timestamp_ns, untrusted)
            boxes = self.strategy.fuse(self.perception_cache, frame, messages)
            return Perception(_remove_own_body(boxes, frame), usable, corrections), _State(
                self.message_history, self._sender_states, self.perception_cache.history
            )
        finally:
            self.message_history, self._sender_states, self.perception_cache.history = (
                before.message_history,
                before.sender_states,
                before.history,
            )

    def _correct_poses(
        self, frame: AgentFrame, received: tuple[ReceivedMessage, ...]
    ) -> tuple[tuple[ReceivedMessage, ...], tuple[CorrectionOutcome, ...]]:
        """Return messages with corrected poses, without those whose pose is uncertain or inconsistent."""
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


def _content_error(reception: ReceivedMessage, error: Exception) -> Rejection:
    text = " ".join(f"fusing its content failed: {type(error).__name__}: {error}".split())
    return Rejection(reception.message.agent_id, "content_error", text, error)


def _remove_own_body(boxes: Boxes, frame: AgentFrame) -> Boxes:
    """Remove the box of the agent itself, which other agents detect."""
    if frame.is_infrastructure:
        return boxes
    return boxes[(boxes.center[:, 0].abs() > EGO_HALF_SIZE_M[0]) | (boxes.center[:, 1].abs() > EGO_HALF_SIZE_M[1])]
