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
from manyeyes.agents.strategies import FusionStrategy, IntermediateFusion
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.token_codec import (
    decode_tokens,
    default_token_encoding,
    encode_tokens,
    make_code_tables,
    make_token_format,
    require_codebook,
)
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox, ReceivedMessage, Rejection
from manyeyes.comms.request_map import build_request_map, compute_request_weights
from manyeyes.comms.token_format import TokenFormat, clamp_features
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.datatypes.message import RequestMap
from manyeyes.models.detector.detector import Detector

if TYPE_CHECKING:
    from manyeyes.agents.map_perception import MapPredictor

EGO_HALF_SIZE_M = (2.6, 1.3)
REQUEST_MAP_STRIDE = 32
"""Pillars on an edge of a window of a request map."""


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
    """A detector, a fusion strategy, and a byte budget for each message.

    Agents exchange nothing but the packets of share; frames carry no labels, so ground truth cannot leak by type.
    token_encoding: of the tokens; None: the default of these weights (``agents.token_codec``).
    send_request_map: messages with tokens carry a request map, one byte a window (``comms.request_map``).
    pose_correction: corrects prior poses of senders before fusion; None uses the prior poses. map_predictor: predicts the local map
    that the agent sends (``agents.map_perception``); None sends no map.
    """

    def __init__(
        self,
        detector: Detector,
        strategy: FusionStrategy | None = None,
        token_encoding: TokenEncoding | None = None,
        budget_bytes: int | None = 1 << 17,
        perception_cache: PerceptionCache | None = None,
        pose_correction: PoseCorrection | None = None,
        send_request_map: bool = False,
        map_predictor: MapPredictor | None = None,
    ) -> None:
        self.perception_cache, self.message_history = perception_cache or PerceptionCache(detector), MessageHistory()
        self.pose_correction, self._sender_states = pose_correction, dict[int, SenderState]()
        self.strategy = strategy or IntermediateFusion()
        self.token_encoding: TokenEncoding = token_encoding or default_token_encoding(detector)
        self.budget_bytes = budget_bytes
        self.send_request_map, self.map_predictor = send_request_map, map_predictor
        self._tables = make_code_tables(detector)
        if token_encoding == "codebook":
            require_codebook(detector)

    def share(
        self, frame: AgentFrame, budget_bytes: int | None = None, requests: Sequence[Message] = ()
    ) -> list[bytes]:
        """Packets of this frame, most important first; an empty list if there is nothing to send.

        budget_bytes: a limit below the agent's own, for a shared channel. A message with tokens never exceeds it, even if nothing
        is sent; objects, points and the map are not limited, but reduce the bytes left for tokens. requests: received messages;
        those with a request map weight the tokens by the sender's lack of confidence there.
        """
        budget = min((b for b in (self.budget_bytes, budget_bytes) if b is not None), default=None)
        message = self.strategy.compose_message(self.perception_cache, frame)
        local_map = None if self.map_predictor is None else self.map_predictor(frame, requests)
        if local_map is not None:
            message = replace(
                message or make_header(frame, self.perception_cache.detector.fingerprint), local_map=local_map
            )
        if message is None:
            return []
        if self.pose_correction is not None:
            message = self.pose_correction.attach_descriptors(frame, self.perception_cache, message)
        if message.tokens is not None and message.token_score is not None:
            shared_tokens = message.tokens.with_features(clamp_features(message.tokens.features))
            tokens = (
                encode_tokens(shared_tokens, self.perception_cache.detector)
                if self.token_encoding == "codebook"
                else shared_tokens
            )
            score = message.token_score * compute_request_weights(tokens.sites.xy, frame.world_from_agent, requests)
            left = budget
            if self.send_request_map:
                message = replace(message, request=self._make_request_map(frame))
            if any(part is not None for part in (message.request, message.objects, message.local_map)):
                encoded = wire.encode(replace(message, tokens=None), token_encoding=self.token_encoding)
                left = None if budget is None else budget - sum(map(len, encoded))
            tokens, score = select_within_budget(tokens, score, left, self.token_encoding, tables=self._tables)
            self.perception_cache.record_sent(
                frame, shared_tokens.keep(torch.isin(shared_tokens.sites.key, tokens.sites.key))
            )
            message = replace(message, tokens=tokens, token_score=score)
        packets = wire.encode(message, token_encoding=self.token_encoding, tables=self._tables)
        too_long = budget is not None and message.tokens is not None and sum(map(len, packets)) > budget
        return [] if too_long else packets

    def _make_request_map(self, frame: AgentFrame) -> RequestMap:
        """The confidence of the agent's own objects, in windows of the coarsest stride."""
        boxes = self.perception_cache.process(frame).boxes
        return build_request_map(
            boxes.center[:, :2], boxes.score, self.perception_cache.detector.config.grid.at(REQUEST_MAP_STRIDE)
        )

    @property
    def token_format(self) -> TokenFormat:
        """The token format that this agent can fuse."""
        return make_token_format(self.perception_cache.detector, self._tables)

    def inbox(self, expire_ns: int | None = None) -> Inbox:
        """An inbox that accepts only tokens that this agent can fuse."""
        return Inbox(expire_ns=expire_ns, token_format=self.token_format)

    def perceive(self, frame: AgentFrame, inbox: Inbox | Iterable[bytes] = (), now_ns: int | None = None) -> Perception:
        """Boxes around the agent from its own frame and from the messages received so far.

        Received content never raises: tokens of another format are excluded, and a sender whose content makes fusion fail is
        excluded as a whole; both are listed in ``Perception.rejected``. A failed perception changes no state.

        inbox: an Inbox that packets were pushed into, preferably the agent's own (``inbox``), or plain packets. now_ns: end of the
        latency budget; messages that have expired by then are excluded.
        """
        if not isinstance(inbox, Inbox):
            packets, inbox = inbox, self.inbox()
            for packet in packets:
                inbox.push(packet)
        rejected, received, token_format = list(inbox.take_rejections()), list[ReceivedMessage](), self.token_format
        for reception in inbox.received_messages(now_ns):
            if reception.message.agent_id != frame.agent_id:
                decoded, rejection = decode_tokens(reception, self.perception_cache.detector, token_format)
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
        """One perception and the state after it; the agent's own state is restored, also after an error."""
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
        """Messages with corrected poses, without those whose pose is uncertain or inconsistent."""
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
