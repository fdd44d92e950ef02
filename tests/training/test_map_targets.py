# SPDX-License-Identifier: Apache-2.0
"""Targets of the map head: equal spacing, and all orders that draw one figure."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE, MapElements
from manyeyes.training.maps.targets import enumerate_orders, make_map_target, resample_evenly, select_observed

TILE = BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0)
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def test_a_line_has_equal_steps_and_both_its_ends():
    bent = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(resample_evenly(bent, 5, ring=False), [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]])


def test_ring_has_distinct_points_and_is_invariant_to_its_start():
    expected = [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]
    for shift in range(4):
        np.testing.assert_allclose(resample_evenly(np.roll(SQUARE, shift, axis=0), 8, ring=True), expected)
    back = resample_evenly(SQUARE[::-1], 8, ring=True)
    np.testing.assert_allclose(back, [expected[0], *expected[:0:-1]])


def test_the_orders_of_a_line_are_two_and_of_a_ring_all_turns_both_ways():
    points = torch.arange(5.0)[:, None].expand(2, 5, 2).contiguous()
    orders = enumerate_orders(points, torch.tensor([False, True]))
    assert orders.shape == (2, 10, 5, 2)
    lines = {tuple(order) for order in orders[0, ..., 0].tolist()}
    assert lines == {(0, 1, 2, 3, 4), (4, 3, 2, 1, 0)}
    rings = {tuple(order) for order in orders[1, ..., 0].tolist()}
    turns = {tuple((s + k) % 5 for k in range(5)) for s in range(5)}
    assert rings == turns | {tuple(reversed(turn)) for turn in turns} and len(rings) == 10


@pytest.mark.parametrize("ring", [False, True])
def test_the_set_of_orders_is_that_of_the_reversed_and_of_the_turned(ring):
    points = torch.rand(1, 6, 2)
    flag = torch.tensor([ring])
    same = {tuple(o.flatten().tolist()) for o in enumerate_orders(points, flag)[0]}
    assert same == {tuple(o.flatten().tolist()) for o in enumerate_orders(points.flip(1), flag)[0]}
    turned = {tuple(o.flatten().tolist()) for o in enumerate_orders(points.roll(2, 1), flag)[0]}
    assert (same == turned) == ring


def test_targets_are_tile_fractions_and_only_of_requested_kinds():
    truth = MapElements.of(
        [[[-10.0, 0.0], [10.0, 0.0]], [[0.0, 0.0], [1.0, 1.0]], SQUARE, [[0.0, -5.0], [0.0, 5.0]]],
        [DIVIDER, STOP_LINE, CROSSING, BOUNDARY],
    )
    target = make_map_target(truth, TILE, ("boundary", "divider", "crossing"), 4)
    assert target.kind.tolist() == [1, 2, 0] and target.ring.tolist() == [False, True, False]
    assert target.orders.shape == (3, 8, 4, 2)
    torch.testing.assert_close(target.orders[0, 0, :, 0], torch.linspace(0, 1, 4))
    torch.testing.assert_close(target.orders[2, 0, :, 1], torch.linspace(0, 1, 4))
    assert float(target.orders[1, 0].min()) == 0.5 and target.repeat(3).kind.tolist() == [1, 2, 0] * 3


def test_an_empty_tile_has_no_targets():
    target = make_map_target(MapElements.empty(), TILE, ("divider",), 4)
    assert len(target) == 0 and target.orders.shape == (0, 8, 4, 2)


def test_unobserved_elements_are_no_targets():
    lines = MapElements.of([[[-10, 0.5], [10, 0.5]], [[5, 4.5], [10, 4.5]], [[-10, -3.9], [-4, -3.9]]], DIVIDER)
    seen = torch.zeros(10, 20, dtype=torch.bool)
    assert (
        len(select_observed(lines, seen, TILE)) == 0 and len(select_observed(MapElements.of([], []), seen, TILE)) == 0
    )
    # Cells from x = -4 to 4: 40 % of the first line, nothing of the others; then the whole second, and a sixth of the third.
    seen[:, 6:14] = True
    np.testing.assert_allclose(select_observed(lines, seen, TILE).points, lines.polyline(0))
    seen[9, 15:], seen[1, 5] = True, True
    assert len(select_observed(lines, seen, TILE)) == 2
    seen[1, 4] = True
    assert len(select_observed(lines, seen, TILE)) == 3
    # A line on the tile's border lies in the cells inside it.
    assert (
        len(
            select_observed(
                MapElements.of([[[10.0, -5.0], [10.0, 5.0]]], DIVIDER), torch.ones(10, 20, dtype=torch.bool), TILE
            )
        )
        == 1
    )
