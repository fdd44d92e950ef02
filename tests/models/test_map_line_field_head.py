# SPDX-License-Identifier: Apache-2.0
"""Line proposals from a line field: every line once, rings as rectangles, duplicates with low scores; suppression
against a loop.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.models.maps.line_field_head import (
    DUPLICATE_SCORE,
    LineFieldHead,
    RawLineField,
    outline_rectangles,
    propose_lines,
    suppress_duplicates,
)
from manyeyes.training.maps.line_field_targets import make_line_field_target

TILE = BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=1.0)
KINDS = ("divider", "boundary", "crossing")
RINGS = torch.tensor([False, False, True])
TRUTH = MapElements.of(
    [
        np.array([[-20.0, 0.3], [3.0, 0.3]]),
        np.array([[-20.0, -4.0], [-2.0, -4.0], [0.0, -5.0], [1.0, -10.0]]),
        np.array([[8.0, -6.0], [12.0, -6.0], [12.0, 6.0], [8.0, 6.0]]),
    ],
    [DIVIDER, BOUNDARY, CROSSING],
)


def perfect(truth=TRUTH):
    """The line field of the ground truth."""
    target = make_line_field_target(truth, TILE, KINDS)
    ink, end = (torch.logit(share.clamp(0.001, 0.999))[None] for share in (target.line_prob, target.end_mask))
    return RawLineField(ink, end, target.offset_to_line[None], target.direction[None], target.half_width[None])


def proposed(line_field, count=5, seeds=40):
    return propose_lines(line_field, RINGS, count, 8, seeds, 0.3)


def test_every_line_of_a_true_field_is_proposed_once():
    found = proposed(perfect())
    sure = found.score[0] > 2 * DUPLICATE_SCORE
    assert sorted(found.kind[0, sure].tolist()) == [0, 1, 2]
    drawn = {int(kind): point for kind, point in zip(found.kind[0, sure], found.point[0, sure])}
    metres = {kind: point * torch.tensor([40.0, 20.0]) - torch.tensor([20.0, 10.0]) for kind, point in drawn.items()}
    for kind, ends in ((0, [[-20.0, 0.3], [3.0, 0.3]]), (1, [[-20.0, -4.0], [1.0, -10.0]])):
        mine = metres[kind][[0, -1]]
        mine = mine if float(mine[0, 0]) < float(mine[1, 0]) else mine.flip(0)
        assert torch.allclose(mine, torch.tensor(ends), atol=1.5)
    ring = metres[2]
    assert torch.allclose(ring.amin(0), torch.tensor([8.0, -6.0]), atol=1.2)
    assert torch.allclose(ring.amax(0), torch.tensor([12.0, 6.0]), atol=1.2)


def test_proposals_descend_by_score_and_length_and_duplicates_score_low():
    found = proposed(perfect(), count=40)
    sure = found.score[0]
    own = sure > 2 * DUPLICATE_SCORE
    assert bool(own[:3].all()) and not bool(own[3:].any()) and torch.equal(sure[3:], torch.full((37,), DUPLICATE_SCORE))
    assert found.kind[0, :2].tolist() == [0, 1]
    every = propose_lines(perfect(), RINGS, 10, 8, 40, 0.3, duplicate_distance=0.0)
    assert float(every.score.min()) > 2 * DUPLICATE_SCORE and set(every.kind[0].tolist()) <= {0, 1}


def test_two_lines_of_a_kind_that_meet_end_to_end_stay_two():
    lines = [np.array([[-20.0, 2.0], [0.0, 2.0]]), np.array([[0.0, 2.0], [20.0, 2.0]])]
    found = proposed(perfect(MapElements.of(lines, [BOUNDARY, BOUNDARY])))
    sure = found.score[0] > 2 * DUPLICATE_SCORE
    assert int(sure.sum()) == 2
    middles = sorted(float(p[:, 0].mean()) for p in found.point[0, sure])
    assert middles == pytest.approx([0.25, 0.75], abs=0.04)


def test_tiles_of_a_batch_are_independent():
    other = perfect(TRUTH.take(np.array([2, 0])))
    one = perfect()
    both = RawLineField(
        *(torch.cat((getattr(one, f.name), getattr(other, f.name))) for f in dataclasses.fields(RawLineField))
    )
    together, alone = proposed(both), proposed(other)
    for name in ("point", "kind", "score"):
        assert torch.allclose(getattr(together, name)[1].float(), getattr(alone, name)[0].float(), atol=1e-6)


def test_a_rectangle_is_drawn_about_its_middle_line():
    first, last, half = torch.tensor([[1.0, 1.0]]), torch.tensor([[1.0, 5.0]]), torch.tensor([1.0])
    points = outline_rectangles(first, last, half, 12)[0]
    assert points.shape == (12, 2)
    # A perimeter of 12: a point a cell, all four corners among them, none twice.
    corners = {(0.0, 1.0), (2.0, 1.0), (2.0, 5.0), (0.0, 5.0)}
    vertices = {(round(x, 3), round(y, 3)) for x, y in points.tolist()}
    assert corners <= vertices and len(vertices) == 12
    nothing = outline_rectangles(first, first, half, 8)
    assert bool(torch.isfinite(nothing).all())


def test_suppression_equals_a_loop():
    rng = np.random.default_rng(4)
    on = torch.from_numpy(rng.random((3, 12, 12)) < 0.25)
    order = torch.stack([torch.from_numpy(rng.permutation(12)) for _ in range(3)])
    slow = torch.ones(3, 12, dtype=torch.bool)
    for tile in range(3):
        ranks = order[tile].tolist()
        for place, first in enumerate(ranks):
            for later in ranks[place + 1 :]:
                if slow[tile, first] and on[tile, first, later]:
                    slow[tile, later] = False
    assert torch.equal(suppress_duplicates(on, order), slow)
    assert 0 < int(slow.sum()) < slow.numel()


def test_head_covers_every_cell_and_starts_with_low_line_probability():
    line_field = LineFieldHead(16, 3)(torch.randn(2, 16, 10, 20))
    assert line_field.line_logit.shape == line_field.end_logit.shape == line_field.half_width.shape == (2, 3, 10, 20)
    assert line_field.offset_to_line.shape == line_field.direction.shape == (2, 3, 2, 10, 20)
    assert float(line_field.line_logit.detach().sigmoid().mean()) == pytest.approx(0.05, abs=0.03)
    assert math.isfinite(float(line_field.direction.detach().sum()))
