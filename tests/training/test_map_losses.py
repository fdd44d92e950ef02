# SPDX-License-Identifier: Apache-2.0
"""Losses of the map head: hand-worked numbers, who answers for what, and that the order of points means nothing."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.models.maps.head import RawMap
from manyeyes.training.maps.losses import (
    MapLossConfig,
    direction_loss,
    edge_loss,
    focal_loss,
    head_terms,
    map_terms,
    match_queries,
    segmentation_loss,
)
from manyeyes.training.maps.targets import MapTarget, enumerate_orders, make_map_target

CONFIG = MapLossConfig()


def targets(points, ring, kind):
    points, flags = torch.as_tensor(points, dtype=torch.float32), torch.tensor(ring)
    return MapTarget(torch.tensor(kind), flags, enumerate_orders(points, flags))


def random_case(seed, elements=3, queries=5, points=6):
    generator = torch.Generator().manual_seed(seed)
    where = torch.rand(elements, points, 2, generator=generator)
    ring = [i % 2 == 1 for i in range(elements)]
    raw = RawMap(
        torch.randn(1, queries, 3, generator=generator).requires_grad_(),
        torch.rand(1, queries, points, 2, generator=generator).requires_grad_(),
    )
    return where, ring, raw


def test_loss_is_invariant_to_line_direction_and_ring_start():
    where, ring, raw = random_case(0)
    kind = [0, 2, 1]
    total = None
    for line_back, turn, ring_back in itertools.product((False, True), range(6), (False, True)):
        drawn = where.clone()
        if line_back:
            drawn[0] = drawn[0].flip(0)
        drawn[1] = drawn[1].roll(turn, 0)
        if ring_back:
            drawn[1] = drawn[1].flip(0)
        terms = map_terms([raw], [], torch.zeros(()), torch.zeros(()), [targets(drawn, ring, kind)], CONFIG)
        loss = terms.total(CONFIG)
        grads = torch.autograd.grad(loss, (raw.logit, raw.point))
        if total is None:
            total = (loss, *grads)
        # Identical, to the last bit: the same order of points is found, however they were given.
        assert torch.equal(loss, total[0])
        assert torch.equal(grads[0], total[1]) and torch.equal(grads[1], total[2])


def test_the_loss_of_a_tile_is_the_same_however_its_map_is_stored():
    generator, tile = torch.Generator().manual_seed(5), BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=1.0)
    raw = RawMap(
        torch.randn(1, 5, 3, generator=generator).requires_grad_(),
        torch.rand(1, 5, 6, 2, generator=generator).requires_grad_(),
    )
    line = np.array([[-15.0, -3.0], [-2.0, 1.5], [4.0, 1.0], [18.0, 7.0]])
    ring = np.array([[3.0, -6.0], [7.0, -6.5], [8.0, 2.0], [4.0, 2.5]])
    grads = []
    for drawn, turn, way in itertools.product((line, line[::-1]), range(4), (1, -1)):
        truth = MapElements.of([drawn, np.roll(ring, turn, 0)[::way]], [DIVIDER, CROSSING])
        target = make_map_target(truth, tile, ("divider", "boundary", "crossing"), 6)
        loss = map_terms([raw], [], torch.zeros(()), torch.zeros(()), [target], CONFIG).total(CONFIG)
        grads.append((loss, *torch.autograd.grad(loss, (raw.logit, raw.point))))
    for case in grads[1:]:
        # Arc lengths are summed from the other end, so places agree to rounding.
        assert all(
            torch.allclose(mine, first, rtol=1e-5, atol=1e-5) for mine, first in zip(case, grads[0], strict=True)
        )


def test_element_far_from_every_query_stays_unmatched():
    ends = torch.tensor([[[0.0, 0.5], [1.0, 0.5]], [[0.0, 0.9], [1.0, 0.9]]])
    target = targets(ends, [False, False], [0, 0])
    # The first query is .1 from the first line and .3 from the second, at each of its points; the other is .3 from the second.
    raw = torch.stack((ends[0] + torch.tensor([0.0, 0.1]), ends[1] - torch.tensor([0.3, 0.0])))
    found = match_queries(torch.zeros(2, 3), raw, target, CONFIG)
    assert (found.query.tolist(), found.element.tolist()) == ([0], [0])
    near = match_queries(torch.zeros(2, 3), torch.stack((raw[0], raw[1] + torch.tensor([0.15, 0.0]))), target, CONFIG)
    assert near.query.tolist() == [0, 1] and near.element.tolist() == [0, 1]


def test_the_match_is_the_best_of_all_assignments():
    for seed in range(5):
        where, ring, raw = random_case(seed, elements=3, queries=4)
        target = targets(where, ring, [0, 2, 1])
        found = match_queries(
            raw.logit[0].detach(), raw.point[0].detach(), target, replace(CONFIG, max_match_distance=math.inf)
        )
        logit, point = raw.logit[0].detach(), raw.point[0].detach()

        def cost(query, element, logit=logit, point=point, target=target):
            p = torch.sigmoid(logit[query, target.kind[element]])
            class_cost = -0.25 * (1 - p) ** 2 * p.log() + 0.75 * p**2 * (1 - p).log()
            away = min(float((point[query] - order).abs().sum()) for order in target.orders[element])
            return CONFIG.classification * float(class_cost) + CONFIG.point * away

        best = min(sum(cost(q, e) for e, q in enumerate(chosen)) for chosen in itertools.permutations(range(4), 3))
        pairs = list(zip(found.query.tolist(), found.element.tolist()))
        assert sorted(e for _, e in pairs) == [0, 1, 2]
        assert sum(cost(q, e) for q, e in pairs) == pytest.approx(best, abs=1e-4)


def test_perfect_prediction_leaves_only_the_classification_loss():
    where, ring, _ = random_case(3)
    kind = [0, 2, 1]
    logit = torch.full((1, 4, 3), -12.0)
    for query, k in ((2, 0), (0, 2), (3, 1)):
        logit[0, query, k] = 12.0
    point = torch.rand(1, 4, 6, 2)
    point[0, 2], point[0, 0], point[0, 3] = where[0].flip(0), where[1].roll(3, 0), where[2]
    terms = head_terms([RawMap(logit, point)], [targets(where, ring, kind)], CONFIG)
    assert [float(t) for t in terms] == pytest.approx([0, 0, 0, 0], abs=1e-5)


def test_terms_by_hand():
    # One line of three points from (0, 0) to (1, 0); one query, off by 0.1 in y at its end.
    target = targets([[[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]]], [False], [0])
    raw = RawMap(torch.zeros(1, 1, 1), torch.tensor([[[[1.0, 0.1], [0.5, 0.0], [0.0, 0.0]]]]))
    kind, point, direction, edge = head_terms([raw, raw], [target], CONFIG)
    assert float(point) == pytest.approx(2 * 0.1)
    assert float(direction) == pytest.approx(2 * (1 - 0.5 / math.hypot(0.5, 0.1)), abs=1e-5)
    assert float(edge) == pytest.approx(2 * 0.1)
    assert float(kind) == pytest.approx(2 * 0.25 * 0.25 * math.log(2))


def test_only_a_ring_has_a_closing_edge():
    # The last point lies off, so that the edge back to the first is turned by ninety degrees.
    mine = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]])
    theirs = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]]) + torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert direction_loss(mine, theirs, torch.tensor([True])).tolist() == pytest.approx([0])
    bent = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]])
    line, ring = (float(direction_loss(mine, bent, torch.tensor([flag]))) for flag in (False, True))
    assert line == pytest.approx(1.0) and ring == pytest.approx(2 - math.cos(math.pi / 4), abs=1e-5)


def test_a_displaced_line_has_no_error_of_edges_and_an_uneven_one_has():
    line = torch.tensor([[[0.0, 0.0], [0.25, 0.0], [0.5, 0.0]]])
    moved, uneven = line + torch.tensor([0.1, -0.2]), line + torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]])
    open_line, ring = torch.tensor([False]), torch.tensor([True])
    assert edge_loss(moved, line, ring).tolist() == pytest.approx([0.0], abs=1e-6)
    assert edge_loss(uneven, line, open_line).tolist() == pytest.approx([0.2])
    assert edge_loss(line.flip(1), line, open_line).tolist() == pytest.approx([1.0])
    assert edge_loss(line.flip(1), line, ring).tolist() == pytest.approx([2.0])


def test_focal_loss_is_its_formula():
    logit = torch.tensor([-2.0, 0.3, 1.5], dtype=torch.float64)
    p = logit.sigmoid()
    torch.testing.assert_close(focal_loss(logit, torch.ones_like(logit)), -0.25 * (1 - p) ** 2 * p.log())
    torch.testing.assert_close(focal_loss(logit, torch.zeros_like(logit)), -0.75 * p**2 * (1 - p).log())


def test_tile_without_elements_has_only_negative_classification_loss():
    raw = RawMap(torch.zeros(1, 4, 3, requires_grad=True), torch.rand(1, 4, 6, 2, requires_grad=True))
    empty = MapTarget(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool), torch.zeros(0, 12, 6, 2))
    kind, *rest = head_terms([raw], [empty], CONFIG)
    assert float(kind.detach()) > 0 and not any(float(term.detach()) for term in rest)
    kind.backward()
    assert raw.logit.grad is not None and bool((raw.logit.grad > 0).all())


def test_of_the_many_queries_each_element_has_several():
    where, ring, _ = random_case(1)
    target = targets(where, ring, [0, 2, 1])
    config = MapLossConfig(one_to_many_repeats=2)
    logit = torch.full((1, 6, 3), -12.0)
    point = torch.rand(1, 6, 6, 2)
    for query in range(6):
        logit[0, query, target.kind[query % 3]] = 12.0
        point[0, query] = where[query % 3]
    one, many = RawMap(logit[:, :3], point[:, :3]), RawMap(logit, point)
    terms = map_terms([one], [many], torch.zeros(()), torch.zeros(()), [target], config)
    assert float(terms.one_to_many) == pytest.approx(0, abs=1e-4)
    thrice = map_terms([one], [many], torch.zeros(()), torch.zeros(()), [target], MapLossConfig(one_to_many_repeats=3))
    assert float(thrice.total(CONFIG)) == pytest.approx(float(thrice.one_to_many), abs=1e-4)


def test_segmentation_weights_positives_four_times():
    logit = torch.zeros(2, 1)
    on, off = (float(segmentation_loss(logit, torch.full((2, 1), v))) for v in (1.0, 0.0))
    assert on == pytest.approx(4 * math.log(2)) and off == pytest.approx(math.log(2))
