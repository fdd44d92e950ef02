# SPDX-License-Identifier: Apache-2.0
"""Boxes of previous frames: propagated by their velocity, with scores that decay by age."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch

from manyeyes.agents.strategies.late import LateFusion
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.strategies.temporal_boxes import SCORE_DECAY_PER_100MS, decay_scores, merge_boxes_nms
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Message, PointCloud, Transform

TENTH_NS = 100_000_000


def boxes(*places: float, score: float = 0.8, speed: float = 0.0) -> Boxes:
    """Cars at (x, 0) that drive along x."""
    n = len(places)
    center = torch.tensor([[x, 0.0, 0.8] for x in places]).view(n, 3)
    blank = Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(n, 3), torch.zeros(n))
    return replace(blank, score=torch.full((n,), score), velocity=torch.tensor([[speed, 0.0]]).expand(n, 2))


def frame(at: int, x: float = 0.0) -> AgentFrame:
    cloud = PointCloud.of(torch.zeros(0, 3))
    return replace(AgentFrame.of(cloud, Transform.from_xyz_yaw(x, 0.0)), timestamp_ns=at * TENTH_NS)


@dataclass
class FixedOutput:
    boxes: Boxes


class FixedCache:
    """A perception cache with these boxes, newest first, a tenth of a second apart, while the agent drove on at 1 m a sweep."""

    detector = SimpleNamespace(grid=BevGrid(-100.0, -40.0, -3.0, 100.0, 40.0, 1.0))

    def __init__(self, *views: Boxes) -> None:
        self.views = [(frame(9 - i, -float(i)), FixedOutput(view)) for i, view in enumerate(views)]

    def process(self, frame: AgentFrame) -> FixedOutput:
        return self.views[0][1]

    def previous_outputs(self, frame: AgentFrame, num_frames: int = 2) -> list[tuple[AgentFrame, FixedOutput]]:
        return self.views[1 : 1 + num_frames]


def message_of(at: int, some: Boxes) -> Message:
    return Message(5, at * TENTH_NS, Transform.identity(), torch.zeros(3, 3).double(), objects=some)


def test_scores_fade_by_the_tenth_of_a_second_and_places_stay() -> None:
    some = boxes(3.0)
    assert float(decay_scores(some, 0.2).score) == pytest.approx(0.8 * SCORE_DECAY_PER_100MS**2)
    assert torch.equal(decay_scores(some, 0.2).center, some.center) and torch.equal(
        decay_scores(some, 0.0).score, some.score
    )


def test_of_boxes_that_overlap_the_best_stays() -> None:
    kept = merge_boxes_nms([boxes(0.0, 20.0, score=0.5), boxes(0.5, 40.0, score=0.7)])
    assert sorted(kept.center[:, 0].tolist()) == [0.5, 20.0, 40.0] and kept.score[0] == pytest.approx(0.7)


def test_an_occluded_object_is_propagated_by_its_velocity() -> None:
    """Seen at 30 m a tenth of a second ago, at 10 m/s: 1 m farther on, 1 m nearer for the agent's own motion."""
    found = get_strategy("late-temporal").fuse(FixedCache(boxes(), boxes(30.0, speed=10.0)), frame(9), ())
    assert found.center[:, 0].tolist() == pytest.approx([30.0]) and float(found.score) == pytest.approx(
        0.8 * SCORE_DECAY_PER_100MS
    )
    still = get_strategy("late-temporal").fuse(FixedCache(boxes(), boxes(30.0)), frame(9), ())
    assert still.center[:, 0].tolist() == pytest.approx([29.0])


def test_current_boxes_win_over_past_ones() -> None:
    found = get_strategy("late-temporal").fuse(FixedCache(boxes(30.0), boxes(31.0)), frame(9), ())
    assert len(found) == 1 and float(found.score) == pytest.approx(0.8) and float(found.center[0, 0]) == 30.0


def test_scores_of_earlier_messages_decay_but_not_of_a_late_one() -> None:
    messages = [message_of(6, boxes(10.0)), message_of(5, boxes(10.5, 50.0))]
    found = get_strategy("late-temporal").fuse(FixedCache(boxes()), frame(9), messages)
    by_place = dict(zip(found.center[:, 0].tolist(), found.score.tolist()))
    assert by_place == {10.0: pytest.approx(0.8), 50.0: pytest.approx(0.8 * SCORE_DECAY_PER_100MS)}


def test_late_fusion_uses_only_the_newest_messages() -> None:
    found = LateFusion().fuse(FixedCache(boxes(), boxes(30.0)), frame(9), [message_of(6, boxes(10.0))])
    assert found.center[:, 0].tolist() == [10.0] and not LateFusion().uses_history


def test_boxes_of_others_are_cropped_and_capped_before_they_are_ranked() -> None:
    """Boxes beyond 100 m are cropped; of 200 boxes within, the best 128 of the message and the ego's own are ranked."""
    crowd = replace(boxes(*torch.linspace(-98, 98, 40).tolist() * 5), score=torch.linspace(0.1, 0.9, 200))
    rows = torch.arange(200)
    crowd = replace(crowd, center=crowd.center + torch.stack((0 * rows, 10 + 4.0 * (rows // 40), 0 * rows), 1))
    found = LateFusion().fuse(
        FixedCache(boxes(0.0, score=0.1)), frame(9), [message_of(9, Boxes.cat([boxes(150.0, score=1.0), crowd]))]
    )
    assert len(found) == 129 and float(found.center[:, 0].max()) < 100
    assert found.center[found.score.argmin()].tolist() == pytest.approx([0.0, 0.0, 0.8])


def test_a_suppressed_own_box_is_restored_at_half_its_score_if_the_other_is_displaced() -> None:
    """At 0 m another box stands 0.9 m aside, the same place; at 20 m it stands 1.5 m aside."""
    own = boxes(0.0, 20.0, score=0.3)
    found = LateFusion().fuse(FixedCache(own), frame(9), [message_of(9, boxes(0.9, 21.5, score=0.9))])
    assert found.center[:, 0].tolist() == pytest.approx([0.9, 21.5, 20.0])
    assert found.score.tolist() == pytest.approx([0.9, 0.9, 0.15])
