# SPDX-License-Identifier: Apache-2.0
"""Messages of boxes or points within a byte budget: the boxes of highest score, or evenly chosen points.

``Agent.share`` limits tokens alone; this wraps a strategy, so that methods which send anything else have a curve of AP against
bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import FusionStrategy
from manyeyes.comms import wire
from manyeyes.datatypes import AgentFrame, Boxes, Message


class BudgetedStrategy(FusionStrategy):
    """A strategy whose boxes and points are limited to a byte budget; its tokens are limited by the agent."""

    def __init__(self, inner: FusionStrategy, budget_bytes: int) -> None:
        self.inner, self.budget_bytes = inner, budget_bytes
        self.uses_history, self.needs_tokens = inner.uses_history, inner.needs_tokens
        self.uses_points, self.waits_for_messages = inner.uses_points, inner.waits_for_messages
        self.needs_request_map = getattr(inner, "needs_request_map", False)
        self.score_form = inner.score_form

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return the message with as many boxes and points as fit."""
        message = self.inner.compose_message(cache, frame, requests)
        return None if message is None else limit_contents(message, self.budget_bytes)

    def record_sent(self, cache: PerceptionCache, frame: AgentFrame, message: Message) -> None:
        """Record the message as it was sent."""
        self.inner.record_sent(cache, frame, message)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return the boxes of the strategy."""
        return self.inner.fuse(cache, frame, messages)


def limit_contents(message: Message, budget_bytes: int) -> Message | None:
    """Return a message whose boxes and points take at most so many bytes on the wire; None where not one of them fits.

    Boxes are kept by falling score, then points evenly over the sweep. A message without them is returned as it is.
    """
    boxes, points = message.objects, message.points
    limited: Message | None = replace(message, points=None)
    if boxes is not None:
        limited = _limit_boxes(replace(message, points=None), boxes, budget_bytes)
    if points is None or limited is None:
        return message if boxes is None else limited
    base = limited

    def with_points(count: int) -> Message:
        rows = torch.arange(count) * len(points) // max(count, 1)
        return replace(base, points=points[rows])

    return _find_largest(with_points, len(points), budget_bytes) or (None if boxes is None else limited)


def _limit_boxes(message: Message, boxes: Boxes, budget_bytes: int) -> Message | None:
    order = boxes.score.argsort(descending=True, stable=True)

    def with_boxes(count: int) -> Message:
        rows, descriptors = order[:count], message.descriptors
        return replace(message, objects=boxes[rows], descriptors=None if descriptors is None else descriptors[rows])

    return _find_largest(with_boxes, len(boxes), budget_bytes)


def _find_largest(make: Callable[[int], Message], count: int, budget_bytes: int) -> Message | None:
    """Return the message of most contents, of those that make returns for 1 to count, within the budget; None without any."""
    if count == 0 or _count_bytes(make(count)) <= budget_bytes:
        return make(count)
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _count_bytes(make(middle)) <= budget_bytes else (low, middle)
    return make(low) if low else None


def _count_bytes(message: Message) -> int:
    """Return bytes of the packets of a message without its tokens."""
    return wire.count_bytes(wire.encode_other_sections(message), message.body)
