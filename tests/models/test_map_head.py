# SPDX-License-Identifier: Apache-2.0
"""The map decoder: shapes, its attention against slow twins, and what comes out as elements."""

import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.datatypes.map_element import KINDS
from manyeyes.models.map_head import (
    DeformableAttention,
    MapHead,
    MapHeadConfig,
    RawMap,
    _SelfAttention,
    decode,
    start_lines,
    waves,
)

TINY = MapHeadConfig(elements=6, points=5, many=9, channels=16, feed=32, layers=2, heads=4, places=3)
TILE = BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=2.0)


def test_every_layer_answers_for_every_query_of_its_group():
    head, ground = MapHead(TINY), torch.randn(2, 16, 10, 20)
    for group, count in (("one", 6), ("many", 9)):
        layers = head(ground, group)
        assert len(layers) == 2
        for raw in layers:
            assert raw.logit.shape == (2, count, 3) and raw.point.shape == (2, count, 5, 2)
            assert bool(torch.isfinite(raw.point).all())
    start = head(ground)[0].logit.sigmoid()
    assert 0.001 < float(start.detach().mean()) < 0.1


def test_one_group_knows_nothing_of_the_other():
    head, ground = MapHead(TINY).eval(), torch.randn(1, 16, 10, 20)
    before = head(ground, "one")[-1].point
    with torch.no_grad():
        head.instance[6:] += 1.0
    assert torch.equal(before, head(ground, "one")[-1].point)


def test_tiles_of_a_batch_know_nothing_of_each_other():
    head, ground = MapHead(TINY), torch.randn(3, 16, 10, 20)
    together, alone = head(ground)[-1], head(ground[1:2])[-1]
    assert torch.allclose(together.point[1], alone.point[0], atol=1e-5)


def test_self_attention_is_the_softmax_of_products():
    layer, x, place = _SelfAttention(8, 2), torch.randn(3, 4, 8), torch.randn(4, 8)
    out = torch.zeros(3, 4, 8)
    for b in range(3):
        query, key = (layer.compare(x[b] + place)).chunk(2, -1)
        value = layer.value(x[b])
        for h in range(2):
            own = slice(4 * h, 4 * h + 4)
            weight = (query[:, own] @ key[:, own].T / math.sqrt(4)).softmax(-1)
            out[b, :, own] = weight @ value[:, own]
    assert torch.allclose(layer(x, place), layer.out(out), atol=1e-5)


def test_deformable_attention_looks_where_its_offsets_say():
    torch.manual_seed(2)
    layer = DeformableAttention(8, 2, 2)
    ground = torch.zeros(1, 6, 9, 8)
    ground[0, :, :, :] = torch.arange(9.0)[:, None] / 8
    with torch.no_grad():
        layer.value.weight.copy_(torch.eye(8))
        layer.out.weight.copy_(torch.eye(8))
        for bias in (layer.value.bias, layer.out.bias):
            bias.zero_()
    reference = torch.tensor([[[4.5 / 9, 3.5 / 6]]])
    out = layer(torch.zeros(1, 1, 8), reference, ground)[0, 0]
    # Head 0 looks one and two columns to the right of column 4, head 1 to the left; weights begin equal.
    assert out[:4].tolist() == pytest.approx([5.5 / 8] * 4, abs=1e-5)
    assert out[4:].tolist() == pytest.approx([2.5 / 8] * 4, abs=1e-5)


def test_answers_come_best_first_in_metres_and_only_those_sure_enough():
    config = MapHeadConfig(elements=3, points=2, channels=8, keep=3, threshold=0.3)
    logit = torch.logit(torch.tensor([[[0.1, 0.9, 0.4], [0.2, 0.1, 0.6], [0.35, 0.0, 0.0]]]), 1e-6)
    point = torch.tensor([[[0.0, 0.5], [1.0, 1.0]], [[0.25, 0.25], [0.5, 0.25]], [[0.5, 0.5], [0.75, 0.5]]])[None]
    found = decode(RawMap(logit, point), TILE, config)[0]
    assert found.score.tolist() == pytest.approx([0.9, 0.6, 0.4])
    assert [KINDS[k] for k in found.kind] == ["boundary", "crossing", "crossing"]
    # The first query answers under two kinds; 0.35 is sure enough, but fourth.
    np.testing.assert_allclose(found.polyline(0), [[-20, 0], [20, 10]])
    np.testing.assert_allclose(found.polyline(1), [[-10, -5], [0, -5]])
    np.testing.assert_allclose(found.polyline(2), found.polyline(0))


def test_points_beyond_the_tile_are_drawn_at_its_border():
    config = MapHeadConfig(elements=1, points=3, channels=8)
    raw = RawMap(torch.full((1, 1, 3), 9.0), torch.tensor([[[[-0.2, 0.5], [0.5, 0.5], [1.1, 1.3]]]]))
    np.testing.assert_allclose(decode(raw, TILE, config)[0].polyline(0), [[-20, 0], [0, 0], [20, 10]])


def test_queries_begin_as_straight_lines_all_over_the_tile():
    lines = start_lines(48, 5)
    assert lines.shape == (48, 5, 2) and float(lines.min()) >= 0 and float(lines.max()) <= 1
    whole = lines[((lines > 0) & (lines < 1)).all(-1).all(-1)]
    steps = whole.diff(dim=1)
    assert len(whole) > 30 and torch.allclose(steps, steps[:, :1].expand_as(steps), atol=1e-6)
    assert torch.allclose((whole[:, -1] - whole[:, 0]).norm(dim=1), torch.tensor(0.3), atol=1e-5)
    # Each sixth of the tile, and each quarter of all directions, holds half of its even part or more.
    middle, along = lines[:, 2], whole[:, -1] - whole[:, 0]
    sixth = torch.bincount((middle * torch.tensor([3, 2])).long() @ torch.tensor([2, 1]), minlength=6)
    quarter = torch.bincount((torch.atan2(along[:, 1], along[:, 0]).remainder(math.pi) * 4 / math.pi).long())
    assert int(sixth.min()) >= 4 and int(quarter.min()) >= len(whole) // 6
    assert start_lines(0, 5).shape == (0, 5, 2)


def test_before_anything_is_learnt_every_layer_answers_with_the_lines_that_queries_begin_as():
    head = MapHead(TINY)
    for raw in head(torch.randn(1, 16, 10, 20)):
        assert torch.equal(raw.point[0], start_lines(6, 5))


def test_waves_tell_places_apart_to_a_hundredth_of_the_tile():
    x, y = torch.meshgrid(torch.linspace(0, 1, 101), torch.linspace(0, 1, 51), indexing="ij")
    code = waves(torch.stack((x, y), -1)).flatten(0, 1)
    assert code.shape == (5151, 32)
    some = torch.arange(0, 5151, 37)
    away = torch.cdist(code[some], code)
    away[torch.arange(len(some)), some] = torch.inf
    assert float(away.min()) > 0.5


def test_a_layer_is_told_where_its_points_lie():
    head, ground = MapHead(TINY).eval(), torch.zeros(1, 16, 10, 20)
    before = head(ground)[0].logit
    with torch.no_grad():
        head.start[2, :, 0] += 0.05
    after = head(ground)[0].logit
    # Nothing is seen anywhere, so only the place itself can have changed the answer.
    assert not torch.allclose(before[0, 2], after[0, 2], atol=1e-6)


def test_what_moves_a_point_is_told_where_it_lies():
    head, ground = MapHead(TINY).eval(), torch.zeros(1, 16, 10, 20)
    with torch.no_grad():
        for layer in head.layers:
            for norm in layer.norms:  # a layer that says nothing at all: x is 0, whatever it was told
                norm.weight.zero_()
                norm.bias.zero_()
        for move in head.moves:
            move[-1].weight.normal_(generator=torch.Generator().manual_seed(0))
        moved = head(ground)[0].point[0] - head.start[:6]
        head.start[2, :, 0] += 0.05
        again = head(ground)[0].point[0] - head.start[:6]
    assert float((moved[2] - again[2]).abs().max()) > 1e-3
    assert torch.equal(moved[0], again[0])


def test_nothing_sure_is_an_empty_map():
    raw = RawMap(torch.full((2, 6, 3), -9.0), torch.rand(2, 6, 5, 2))
    assert [len(found) for found in decode(raw, TILE, TINY)] == [0, 0]


@pytest.mark.parametrize("fields", [{"channels": 10}, {"points": 1}, {"kinds": ("divider", "kerb")}, {"kinds": ()}])
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ConfigError, match="MapHeadConfig"):
        MapHeadConfig(**{"heads": 8, **fields})
