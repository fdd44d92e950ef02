# SPDX-License-Identifier: Apache-2.0
"""What a sketch should say: by hand and against every cell's nearest of many points; the loss by its formula."""

import itertools
import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.models.maps.line_field_head import MAX_LINE_OFFSET, RawLineField
from manyeyes.training.maps.line_field_targets import (
    LINE_SIGMA,
    MIN_NORMALISER,
    SAMPLE_SPACING,
    dilate_observed,
    fit_middle_line,
    line_field_loss,
    make_line_field_target,
)

TILE = BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=2.0)
KINDS = ("divider", "boundary", "crossing")


def test_cells_hold_offset_and_direction_of_the_nearest_line():
    curve = np.array([[-20.0, -3.0], [-4.0, 1.0], [6.0, 2.0], [20.0, 8.0]])
    other = np.array([[-10.0, 9.0], [10.0, -9.0]])
    target = make_line_field_target(MapElements.of([curve, other], [DIVIDER, BOUNDARY]), TILE, KINDS)
    for layer, line in enumerate((curve, other)):
        share = np.linspace(0, 1, 2001)[:, None]
        dense = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(line)])
        dense = (dense - [-20, -10]) / 2
        for row in range(10):
            for column in range(20):
                away = dense - [column + 0.5, row + 0.5]
                gap = np.hypot(*away.T)
                found = bool(target.near_line[layer, row, column])
                if abs(gap.min() - MAX_LINE_OFFSET) > 0.02:
                    assert found == (gap.min() < MAX_LINE_OFFSET)
                if not found:
                    continue
                assert float(target.line_prob[layer, row, column]) == pytest.approx(
                    math.exp(-(gap.min() ** 2) / 2 / LINE_SIGMA**2), abs=0.05
                )
                mine = target.offset_to_line[layer, :, row, column].numpy()
                assert np.hypot(*mine) == pytest.approx(gap.min(), abs=SAMPLE_SPACING / 2)
                assert np.hypot(*target.direction[layer, :, row, column].numpy()) == pytest.approx(1, abs=1e-5)
    doubled = 2 * math.atan2(-18, 20)
    found = target.direction[1][:, target.near_line[1]]
    assert torch.allclose(found, torch.tensor([[math.cos(doubled)], [math.sin(doubled)]]).expand_as(found), atol=1e-5)
    assert not bool(target.near_line[2].any()) and float(target.half_width.abs().max()) == 0


def test_ends_are_where_lines_end_but_not_at_the_border_nor_on_rings():
    ring = np.array([[4.0, 1.0], [8.0, 1.0], [8.0, 5.0], [4.0, 5.0], [4.0, 1.0]])
    line = np.array([[-20.0, -5.0], [1.0, -5.0]])
    target = make_line_field_target(MapElements.of([line, ring], [DIVIDER, BOUNDARY]), TILE, KINDS)
    # (1, -5) is (10.5, 2.5) in cells: the middle of one.
    assert target.end_mask[0].nonzero().tolist() == [[2, 10]]
    assert float(target.end_mask[1:].abs().max()) == 0


def test_a_ring_is_its_middle_line_and_half_its_width():
    angle = 0.4
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    ring = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 10.0], [0.0, 10.0]]) @ turn
    for way in (ring, np.roll(ring, 1, 0), ring[::-1]):
        line, half = fit_middle_line(way)
        expected = np.array([[1.5, 0.0], [1.5, 10.0]]) @ turn
        mine = line if np.hypot(*(line[0] - expected[0])) < 1 else line[::-1]
        np.testing.assert_allclose(mine, expected, atol=1e-9)
        assert half == pytest.approx(1.5)
    target = make_line_field_target(MapElements.of([ring - [0, 5]], [CROSSING]), TILE, KINDS)
    assert torch.allclose(target.half_width[2][target.near_line[2]], torch.tensor(0.75), atol=1e-6)
    assert int(target.near_line[2].sum()) > 8


def test_tile_without_elements_has_zero_target():
    target = make_line_field_target(MapElements.of([], []), TILE, KINDS)
    assert all(float(part.float().abs().max()) == 0 for part in vars(target).values())
    flat, pairs = torch.zeros(1, 3, 10, 20), torch.zeros(1, 3, 2, 10, 20)
    sketch = RawLineField(flat, flat, pairs, pairs, flat)
    # Of each kind 200 cells at a probability of one half: ln 2 each, for ink and half as much for ends.
    assert float(line_field_loss(sketch, [target])) == pytest.approx(1.5 * 200 / MIN_NORMALISER * math.log(2), rel=1e-5)


def test_loss_of_the_truth_is_its_entropy_and_every_part_counts():
    truth = MapElements.of([np.array([[-20.0, 1.0], [4.0, 1.0]])], [DIVIDER])
    target = make_line_field_target(truth, TILE, KINDS)
    ink, end = (torch.logit(share.clamp(1e-6, 1 - 1e-6))[None] for share in (target.line_prob, target.end_mask))
    parts = [ink, end, target.offset_to_line[None], target.direction[None], target.half_width[None]]
    best = float(line_field_loss(RawLineField(*parts), [target]))
    entropy = -(
        target.line_prob * target.line_prob.clamp_min(1e-9).log()
        + (1 - target.line_prob) * (1 - target.line_prob).clamp_min(1e-9).log()
    )
    # One of three kinds is there.
    assert best == pytest.approx(float(entropy.sum() / target.line_prob.sum().clamp_min(MIN_NORMALISER)) / 3, abs=1e-3)
    for k in (2, 3):
        off = [part + 0.5 if i == k else part for i, part in enumerate(parts)]
        # Both coordinates are off by 0.5.
        assert float(line_field_loss(RawLineField(*off), [target])) - best == pytest.approx(1.0, abs=1e-4)
    for k in (0, 1):
        off = [torch.zeros_like(part) if i == k else part for i, part in enumerate(parts)]
        assert float(line_field_loss(RawLineField(*off), [target])) > best + 0.3


def test_lines_are_targets_in_observed_cells_and_a_margin():
    target = make_line_field_target(MapElements.of([np.array([[-20.0, 1.0], [20.0, 1.0]])], [DIVIDER]), TILE, KINDS)
    seen = torch.zeros(1, 10, 20, dtype=torch.bool)
    seen[0, 5, 3] = True
    around = dilate_observed(seen, TILE)
    # Two cells of two metres each way.
    assert around[0].nonzero().min(0).values.tolist() == [3, 1] and around[0].nonzero().max(0).values.tolist() == [7, 5]
    inside = target.mask_unobserved(around[0])
    assert torch.equal(inside.line_prob > 0, (target.line_prob > 0) & around[0]) and torch.equal(
        inside.near_line, inside.line_prob > 0
    )
    assert torch.equal(inside.offset_to_line, target.offset_to_line) and float(inside.end_mask.sum()) <= float(
        target.end_mask.sum()
    )
