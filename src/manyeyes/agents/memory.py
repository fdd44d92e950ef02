# SPDX-License-Identifier: Apache-2.0
"""What an agent remembers of the others: where packets of a message are lost, the message before it fills the gap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from manyeyes.comms.inbox import Reception
from manyeyes.datatypes import Boxes, Message
from manyeyes.models.fusion.gather import FASTEST_MPS
from manyeyes.models.proposal import PROPOSAL, proposed_velocity

SAME_M = 2.4
"""An older token or box this near to a newer one of its sender, both where they should be now, is the same and is dropped."""
KEPT_NS = 500_000_000


class Memory:
    """The last two messages of each sender: what the newer lacks, the older may have said. Older than keep_ns is forgotten."""

    def __init__(self, keep_ns: int = KEPT_NS) -> None:
        self._keep_ns = keep_ns
        self._held: dict[int, tuple[Message, Message | None]] = {}

    def complete(self, heard: Sequence[Reception]) -> list[Message]:
        """The messages heard, and behind each that lacks packets what its sender said before and does not say again.

        Heard again, whole or with more packets than before, a message is completed anew from the same one before it.
        """
        messages = []
        for reception in heard:
            message = reception.message
            before = self._before(message)
            self._held[message.agent_id] = message, before
            rest = None if reception.complete or before is None else _unsaid(before, message)
            messages += [message] if rest is None else [message, rest]
        if heard:
            latest = max(reception.message.timestamp_ns for reception in heard)
            near = ((k, v) for k, v in self._held.items() if abs(latest - v[0].timestamp_ns) <= self._keep_ns)
            self._held = dict(near)
        return messages

    def _before(self, message: Message) -> Message | None:
        """What its sender said last before it, if that is not too long ago; a time that goes back begins anew."""
        newest, before = self._held.get(message.agent_id, (None, None))
        if newest is None or message.timestamp_ns < newest.timestamp_ns:
            return None
        if newest.timestamp_ns < message.timestamp_ns:
            before = newest
        return None if before is None or message.timestamp_ns - before.timestamp_ns > self._keep_ns else before


def _unsaid(older: Message, newer: Message) -> Message | None:
    """The older message without what the newer one speaks of, by place; None where nothing is left."""
    newer_from_older = newer.world_from_agent.inverse() @ older.world_from_agent
    seconds = (newer.timestamp_ns - older.timestamp_ns) / 1e9

    def fresh(xy: Tensor, known: Tensor) -> Tensor:
        there = torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double()
        moved = newer_from_older.apply(there)[:, :2].to(known.dtype)
        return torch.cdist(moved, known).amin(1) > SAME_M if len(known) else torch.ones(len(xy), dtype=torch.bool)

    tokens, score, objects = older.tokens, older.token_score, older.objects
    if tokens is not None:
        known = newer.tokens.sites.xy if newer.tokens is not None else tokens.sites.xy[:0]
        tokens = tokens.keep(fresh(_token_places(tokens.features, tokens.sites.xy, seconds), known))
        score = None
    if objects is not None:
        known = newer.objects.center[:, :2] if newer.objects is not None else objects.center[:0, :2]
        objects = objects[fresh(objects.after(seconds).center[:, :2], known)]
    if not (tokens is not None and len(tokens.sites)) and not (objects is not None and len(objects)):
        return None
    return replace(older, tokens=tokens, token_score=score, objects=_or_none(objects))


def _token_places(rows: Tensor, xy: Tensor, seconds: float) -> Tensor:
    if rows.shape[1] <= PROPOSAL or not rows.is_floating_point():
        return xy
    velocity = proposed_velocity(rows[:, -PROPOSAL:])
    return xy + velocity * seconds * (velocity.norm(dim=1, keepdim=True) <= FASTEST_MPS)


def _or_none(boxes: Boxes | None) -> Boxes | None:
    return boxes if boxes is not None and len(boxes) else None
