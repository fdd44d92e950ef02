# SPDX-License-Identifier: Apache-2.0
"""One agent's whole step: share(own observation) to bytes, perceive(own observation, inbox) to boxes."""

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
    """boxes: in the agent's own frame, best first. received: the messages that took part, by agent id, from where they were
    believed to come. corrections: on every message that came, where the agent aligns them. rejected: senders whose content took no
    part, or only part of it, and why.
    """

    boxes: Boxes
    received: tuple[ReceivedMessage, ...]
    corrections: tuple[CorrectionOutcome, ...] = ()
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class _State:
    """What a perception leaves behind; it is taken over only where the whole perception succeeded."""

    message_history: MessageHistory
    sender_states: dict[int, SenderState]
    history: History


class Agent:
    """A detector, a way to collaborate, and a limit in bytes for each message.

    Nothing but the bytes of share passes between two agents; frames carry no labels, so truth cannot leak by type.
    token_encoding: how tokens are written; None: as is usual for these weights (``agents.token_codec``).
    send_request_map: its messages of tokens say, a byte a window, where it needs no help (``comms.request_map``).
    pose_correction: corrects where others say they are before anything is fused; None believes them. map_predictor: draws what the
    agent then says of the map (``agents.map_perception``); None: nothing.
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
        """The packets that this frame is worth to others, most important first; none if there is nothing to say.

        budget_bytes: less than the agent's own, where others need the channel too. A message of tokens is never longer, be
        it that nothing is said; objects, points and the map know no budget, but what they take is not there for tokens. requests:
        what came from others; those with a request weigh the tokens by what they do not see themselves.
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
        """How sure the agent itself is of the objects around it, in the coarsest windows that its grid knows."""
        boxes = self.perception_cache.process(frame).boxes
        return build_request_map(
            boxes.center[:, :2], boxes.score, self.perception_cache.detector.config.grid.at(REQUEST_MAP_STRIDE)
        )

    @property
    def token_format(self) -> TokenFormat:
        """What tokens must look like to be fused by this agent."""
        return make_token_format(self.perception_cache.detector, self._tables)

    def inbox(self, expire_ns: int | None = None) -> Inbox:
        """An inbox that keeps no tokens but those that this agent can fuse."""
        return Inbox(expire_ns=expire_ns, token_format=self.token_format)

    def perceive(self, frame: AgentFrame, inbox: Inbox | Iterable[bytes] = (), now_ns: int | None = None) -> Perception:
        """Boxes around the agent from its own frame and whatever of others' messages has come.

        What others send never raises: tokens of another form are left out, and a sender whose content makes fusion fail is left
        out whole; both stand in ``Perception.rejected``. Nothing of a perception that failed is remembered.

        inbox: an Inbox that packets were pushed into, best the agent's own (``inbox``), or plain packets. now_ns: when the ego
        stops waiting; messages that the inbox holds too old by then are left out.
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
        """Fuse what can be fused; the rejections of those whose content cannot."""
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
                # Each passes alone and all fail together: nobody can be named, so nobody takes part, not even what is remembered.
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
        """Those of a group that fails whose content alone makes fusion fail, by halving the group."""
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
        """One perception and the state after it; the agent's own state is as before, also after an error."""
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
        """What was heard from where it belongs, without what belongs nowhere."""
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
    """Without the box that others see where the agent itself stands."""
    if frame.is_infrastructure:
        return boxes
    return boxes[(boxes.center[:, 0].abs() > EGO_HALF_SIZE_M[0]) | (boxes.center[:, 1].abs() > EGO_HALF_SIZE_M[1])]
