# SPDX-License-Identifier: Apache-2.0
"""One agent's whole step: share(own observation) to bytes, perceive(own observation, inbox) to boxes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from manyeyes.agents.message_history import Memory
from manyeyes.agents.perception_cache import Eyes, History
from manyeyes.agents.pose_correction import Aligner, Known, Verdict
from manyeyes.agents.strategies import Collaboration, Intermediate
from manyeyes.agents.strategies.message_header import header
from manyeyes.agents.token_codec import codebook_of, coded, readable, tables_of, token_format_of, usual_precision
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox, Reception, Rejection
from manyeyes.comms.request_map import need, request_map
from manyeyes.comms.token_format import TokenFormat, within_range
from manyeyes.comms.token_selection import within_budget
from manyeyes.comms.wire import Precision
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.datatypes.message import RequestMap
from manyeyes.models.detector.detector import Detector

if TYPE_CHECKING:
    from manyeyes.agents.map_perception import Survey

OWN_BODY_M = (2.6, 1.3)
WINDOW_STRIDE = 32
"""Pillars on an edge of a window of a request map."""


@dataclass(frozen=True)
class Perception:
    """boxes: in the agent's own frame, best first. heard: the messages that took part, by agent id, from where they were
    believed to come. verdicts: on every message that came, where the agent aligns them. rejected: senders whose content took no
    part, or only part of it, and why.
    """

    boxes: Boxes
    heard: tuple[Reception, ...]
    verdicts: tuple[Verdict, ...] = ()
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class _State:
    """What a perception leaves behind; it is taken over only where the whole perception succeeded."""

    memory: Memory
    known: dict[int, Known]
    history: History


class Agent:
    """A detector, a way to collaborate, and a limit in bytes for each message.

    Nothing but the bytes of share passes between two agents; frames carry no labels, so truth cannot leak by type.
    precision: how tokens are written; None: as is usual for these weights (``agents.token_codec``).
    requests: its messages of tokens say, a byte a window, where it needs no help (``comms.request_map``).
    aligner: corrects where others say they are before anything is fused; None believes them. survey: draws what the agent then
    says of the map (``agents.map_perception``); None: nothing.
    """

    def __init__(
        self,
        detector: Detector,
        collaboration: Collaboration | None = None,
        precision: Precision | None = None,
        budget_bytes: int | None = 1 << 17,
        eyes: Eyes | None = None,
        aligner: Aligner | None = None,
        requests: bool = False,
        survey: Survey | None = None,
    ) -> None:
        self.eyes, self.memory = eyes or Eyes(detector), Memory()
        self.aligner, self._known = aligner, dict[int, Known]()
        self.collaboration = collaboration or Intermediate()
        self.precision: Precision = precision or usual_precision(detector)
        self.budget_bytes = budget_bytes
        self.requests, self.survey = requests, survey
        self._tables = tables_of(detector)
        if precision == "codes":
            codebook_of(detector)

    def share(self, frame: AgentFrame, budget_bytes: int | None = None, asked: Sequence[Message] = ()) -> list[bytes]:
        """The packets that this frame is worth to others, most important first; none if there is nothing to say.

        budget_bytes: less than the agent's own, where others need the channel too. A message of tokens is never longer, be
        it that nothing is said; objects, points and the map know no budget, but what they take is not there for tokens. asked:
        what came from others; those with a request weigh the tokens by what they do not see themselves.
        """
        budget = min((b for b in (self.budget_bytes, budget_bytes) if b is not None), default=None)
        message = self.collaboration.say(self.eyes, frame)
        seen_map = None if self.survey is None else self.survey(frame, asked)
        if seen_map is not None:
            message = replace(message or header(frame, self.eyes.detector.fingerprint), seen_map=seen_map)
        if message is None:
            return []
        if self.aligner is not None:
            message = self.aligner.describe(frame, self.eyes, message)
        if message.tokens is not None and message.token_score is not None:
            told = message.tokens.with_features(within_range(message.tokens.features))
            tokens = coded(told, self.eyes.detector) if self.precision == "codes" else told
            score = message.token_score * need(tokens.sites.xy, frame.world_from_agent, asked)
            left = budget
            if self.requests:
                message = replace(message, request=self._request(frame))
            if any(part is not None for part in (message.request, message.objects, message.seen_map)):
                spent = wire.encode(replace(message, tokens=None), precision=self.precision)
                left = None if budget is None else budget - sum(map(len, spent))
            tokens, score = within_budget(tokens, score, left, self.precision, tables=self._tables)
            self.eyes.said(frame, told.keep(torch.isin(told.sites.key, tokens.sites.key)))
            message = replace(message, tokens=tokens, token_score=score)
        packets = wire.encode(message, precision=self.precision, tables=self._tables)
        too_long = budget is not None and message.tokens is not None and sum(map(len, packets)) > budget
        return [] if too_long else packets

    def _request(self, frame: AgentFrame) -> RequestMap:
        """How sure the agent itself is of the objects around it, in the coarsest windows that its grid knows."""
        boxes = self.eyes.see(frame).boxes
        return request_map(boxes.center[:, :2], boxes.score, self.eyes.detector.config.grid.at(WINDOW_STRIDE))

    @property
    def token_format(self) -> TokenFormat:
        """What tokens must look like to be fused by this agent."""
        return token_format_of(self.eyes.detector, self._tables)

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
        rejected, heard, form = list(inbox.take_rejections()), list[Reception](), self.token_format
        for reception in inbox.receptions(now_ns):
            if reception.message.agent_id != frame.agent_id:
                usable, rejection = readable(reception, self.eyes.detector, form)
                heard.append(usable)
                rejected += [] if rejection is None else [rejection]
        perception, failed = self._perceive(frame, heard)
        for rejection in failed:
            inbox.discard(rejection.agent_id)
        return replace(perception, rejected=(*rejected, *failed))

    def _perceive(self, frame: AgentFrame, heard: list[Reception]) -> tuple[Perception, list[Rejection]]:
        """Fuse what can be fused; the rejections of those whose content cannot."""
        failed: list[Rejection] = []
        try:
            perception, state = self._attempt(frame, heard)
        except Exception as error:
            failed = self._failing(frame, heard, error)
            names = {rejection.agent_id for rejection in failed}
            left = [reception for reception in heard if reception.message.agent_id not in names]
            try:
                perception, state = self._attempt(frame, left)
            except Exception as together:
                # Each passes alone and all fail together: nobody can be named, so nobody takes part, not even what is remembered.
                failed += [_content_error(reception, together) for reception in left]
                self.memory, self._known = Memory(), {}
                perception, state = self._attempt(frame, [])
        self.memory, self._known, self.eyes.history = state.memory, state.known, state.history
        return perception, failed

    def _failing(self, frame: AgentFrame, heard: Sequence[Reception], error: Exception) -> list[Rejection]:
        """Those of a group that fails whose content alone makes fusion fail, by halving the group."""
        if len(heard) <= 1:
            return [_content_error(reception, error) for reception in heard]
        failed = []
        for half in (heard[: len(heard) // 2], heard[len(heard) // 2 :]):
            try:
                self._attempt(frame, half)
            except Exception as of_half:
                failed += self._failing(frame, half, of_half)
        return failed

    def _attempt(self, frame: AgentFrame, heard: Sequence[Reception]) -> tuple[Perception, _State]:
        """One perception and the state after it; the agent's own state is as before, also after an error."""
        before = _State(copy(self.memory), self._known, self.eyes.history)
        try:
            usable, verdicts = self._aligned(frame, tuple(heard))
            messages = [reception.message for reception in usable]
            if self.collaboration.remembers:
                distrusted = [verdict.agent_id for verdict in verdicts if verdict.distrusted]
                messages = self.memory.recall(messages, frame.timestamp_ns, distrusted)
            boxes = self.collaboration.hear(self.eyes, frame, messages)
            return Perception(_others(boxes, frame), usable, verdicts), _State(
                self.memory, self._known, self.eyes.history
            )
        finally:
            self.memory, self._known, self.eyes.history = before.memory, before.known, before.history

    def _aligned(
        self, frame: AgentFrame, heard: tuple[Reception, ...]
    ) -> tuple[tuple[Reception, ...], tuple[Verdict, ...]]:
        """What was heard from where it belongs, without what belongs nowhere."""
        if self.aligner is None:
            return heard, ()
        aligned = self.aligner.align(frame, self.eyes, [r.message for r in heard], self._known)
        self._known = dict(aligned.states)
        said = {message.agent_id: message for message in aligned.messages}
        kept = (replace(r, message=said[r.message.agent_id]) for r in heard if r.message.agent_id in said)
        return tuple(kept), aligned.verdicts


def _content_error(reception: Reception, error: Exception) -> Rejection:
    text = " ".join(f"fusing its content failed: {type(error).__name__}: {error}".split())
    return Rejection(reception.message.agent_id, "content_error", text, error)


def _others(boxes: Boxes, frame: AgentFrame) -> Boxes:
    """Without the box that others see where the agent itself stands."""
    if frame.is_infrastructure:
        return boxes
    return boxes[(boxes.center[:, 0].abs() > OWN_BODY_M[0]) | (boxes.center[:, 1].abs() > OWN_BODY_M[1])]
