# SPDX-License-Identifier: Apache-2.0
"""Messages of boxes and points within a budget: never above it, of the best boxes, more with more bytes."""

from __future__ import annotations

import pytest
import torch

from manyeyes.agents.content_budget import BudgetedStrategy, limit_contents
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.comms import wire
from manyeyes.datatypes import Boxes, Message, PointCloud, Transform

RNG = torch.Generator().manual_seed(0)
BUDGETS = (100, 200, 512, 1398, 4096, 100_000)


def make_message(boxes: int = 0, points: int = 0) -> Message:
    center, score = torch.rand(boxes, 3, generator=RNG), torch.rand(boxes, generator=RNG)
    return Message(
        1,
        0,
        Transform.identity(),
        torch.zeros(3, 3),
        objects=Boxes.of(center, torch.ones(boxes, 3), torch.zeros(boxes), score=score) if boxes else None,
        points=PointCloud.of(torch.rand(points, 3, generator=RNG)) if points else None,
    )


@pytest.mark.parametrize("contents", [(150, 0), (0, 2000), (40, 2000)])
def test_bytes_on_the_wire_stay_within_the_budget_and_grow_with_it(contents: tuple[int, int]) -> None:
    message, kept = make_message(*contents), []
    for budget in BUDGETS:
        limited = limit_contents(message, budget)
        kept.append(0)
        if limited is not None:
            assert sum(map(len, wire.encode(limited))) <= budget
            boxes = 0 if limited.objects is None else len(limited.objects)
            kept[-1] = boxes + (0 if limited.points is None else len(limited.points))
    assert kept == sorted(kept) and kept[-1] == sum(contents) and len(set(kept)) > 3


def test_the_boxes_of_highest_score_are_kept() -> None:
    message = make_message(60)
    limited = limit_contents(message, 400)
    assert message.objects is not None and limited is not None and limited.objects is not None
    count = len(limited.objects)
    best = message.objects.score.sort(descending=True).values[:count]
    assert 0 < count < 60 and torch.equal(limited.objects.score, best)


def test_points_are_chosen_evenly() -> None:
    line = torch.arange(1000)[:, None].expand(-1, 3) / 100
    message = Message(1, 0, Transform.identity(), torch.zeros(3, 3), points=PointCloud.of(line))
    limited = limit_contents(message, 800)
    assert limited is not None and limited.points is not None
    gaps = limited.points.xyz[1:, 0] - limited.points.xyz[:-1, 0]
    assert len(limited.points) > 50 and float(gaps.max() - gaps.min()) < 0.011


def test_empty_boxes_and_no_contents_are_sent_as_they_are() -> None:
    plain = make_message()
    assert limit_contents(plain, 1) is plain
    assert limit_contents(make_message(1), 10) is None


@pytest.mark.parametrize("name", list_strategies())
def test_a_strategy_keeps_its_attributes(name: str) -> None:
    inner = get_strategy(name)
    wrapped = BudgetedStrategy(inner, 1000)
    for attribute in (
        "uses_history",
        "needs_tokens",
        "uses_points",
        "waits_for_messages",
        "needs_request_map",
        "score_form",
    ):
        assert getattr(wrapped, attribute) == getattr(inner, attribute)
