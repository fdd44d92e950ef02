# SPDX-License-Identifier: Apache-2.0
"""The map decoder: shapes, its attention against slow twins, and what comes out as elements."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.datatypes.map_element import KINDS
from manyeyes.models.maps.head import (
    DeformableAttention,
    MapHead,
    MapHeadConfig,
    RawMap,
    _SelfAttention,
    decode_elements,
    encode_position,
)

TINY = MapHeadConfig(
    num_queries=6,
    num_points=5,
    num_one_to_many_queries=9,
    channels=16,
    feedforward_channels=32,
    layers=2,
    heads=4,
    num_sampling_points=3,
)
THREE = torch.tensor([[2.0, 0.0], [8.0, 3.0], [5.0, 6.0]])
TILE = BevGrid(-20.0, -10.0, -1.0, 20.0, 10.0, 1.0, pillar=2.0)


def drawn(head, ground, group="one"):
    return head(ground, head.line_field_head(ground), group)


def test_every_layer_answers_for_every_query_of_its_group():
    head, ground = MapHead(TINY), torch.randn(2, 16, 10, 20)
    for group, count in (("one", 6), ("many", 9)):
        layers = drawn(head, ground, group)
        assert len(layers) == 2
        for raw in layers:
            assert raw.logit.shape == (2, count, 3) and raw.point.shape == (2, count, 5, 2)
            assert bool(torch.isfinite(raw.point).all())
    start = drawn(head, ground)[0].logit.sigmoid()
    assert 0.001 < float(start.detach().mean()) < 0.1


def test_query_groups_are_independent():
    few, more = MapHead(TINY).eval(), MapHead(dataclasses.replace(TINY, num_one_to_many_queries=12)).eval()
    more.load_state_dict(few.state_dict())
    ground = torch.randn(1, 16, 10, 20)
    assert torch.equal(drawn(few, ground)[-1].point, drawn(more, ground)[-1].point)
    # The best of all that were followed lead both groups; of the second, copies are as sure as they are.
    one, many = few.init_queries(few.line_field_head(ground)), few.init_queries(few.line_field_head(ground), "many")
    assert torch.equal(one[0][:, 0], many[0][:, 0]) and one[0].shape[1] == 6 and many[0].shape[1] == 9
    assert float(many[1].sigmoid().amax(2).min()) > 0.011


def test_tiles_of_a_batch_are_independent():
    head, ground = MapHead(TINY).eval(), torch.randn(3, 16, 10, 20)
    together, alone = drawn(head, ground)[-1], drawn(head, ground[1:2])[-1]
    assert torch.allclose(together.point[1], alone.point[0], atol=1e-5)


def test_self_attention_is_the_softmax_of_products():
    layer, x, place = _SelfAttention(8, 2), torch.randn(3, 4, 8), torch.randn(4, 8)
    out = torch.zeros(3, 4, 8)
    for b in range(3):
        query, key = (layer.query_key(x[b] + place)).chunk(2, -1)
        value = layer.value(x[b])
        for h in range(2):
            own = slice(4 * h, 4 * h + 4)
            weight = (query[:, own] @ key[:, own].T / math.sqrt(4)).softmax(-1)
            out[b, :, own] = weight @ value[:, own]
    assert torch.allclose(layer(x, place), layer.out(out), atol=1e-5)


def test_deformable_attention_samples_at_its_offsets():
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


def test_decoded_elements_are_sorted_thresholded_and_metric():
    config = MapHeadConfig(num_queries=3, num_points=2, channels=8, max_elements=3, score_threshold=0.3)
    logit = torch.logit(torch.tensor([[[0.1, 0.9, 0.4], [0.2, 0.1, 0.6], [0.35, 0.0, 0.0]]]), 1e-6)
    point = torch.tensor([[[0.0, 0.5], [1.0, 1.0]], [[0.25, 0.25], [0.5, 0.25]], [[0.5, 0.5], [0.75, 0.5]]])[None]
    found = decode_elements(RawMap(logit, point), TILE, config)[0]
    assert found.score.tolist() == pytest.approx([0.9, 0.6, 0.4])
    assert [KINDS[k] for k in found.kind] == ["boundary", "crossing", "crossing"]
    # The first query answers under two kinds; 0.35 is sure enough, but fourth.
    np.testing.assert_allclose(found.polyline(0), [[-20, 0], [20, 10]])
    np.testing.assert_allclose(found.polyline(1), [[-10, -5], [0, -5]])
    np.testing.assert_allclose(found.polyline(2), found.polyline(0))


def test_points_beyond_the_tile_are_drawn_at_its_border():
    config = MapHeadConfig(num_queries=1, num_points=3, channels=8)
    raw = RawMap(torch.full((1, 1, 3), 9.0), torch.tensor([[[[-0.2, 0.5], [0.5, 0.5], [1.1, 1.3]]]]))
    np.testing.assert_allclose(decode_elements(raw, TILE, config)[0].polyline(0), [[-20, 0], [0, 0], [20, 10]])


def test_untrained_layers_return_the_lines_of_the_line_field():
    head, ground = MapHead(TINY), torch.randn(1, 16, 10, 20)
    start, logit, kind = head.init_queries(head.line_field_head(ground))
    for raw in drawn(head, ground):
        assert torch.equal(raw.point, start) and torch.equal(raw.logit, logit)
    own = logit.gather(2, kind[..., None])
    assert torch.allclose(logit.sum(2, keepdim=True) - own, torch.tensor(-2 * math.log(99)), atol=1e-4)


def test_initial_queries_carry_no_gradient_to_the_line_field():
    head, ground = MapHead(TINY), torch.randn(1, 16, 10, 20)
    assert not any(part.requires_grad for part in head.init_queries(head.line_field_head(ground)))
    raw = drawn(head, ground)[-1]
    (raw.point.sum() + raw.logit.sum()).backward()
    assert all(p.grad is None for p in head.line_field_head.parameters())


def test_learned_queries_follow_those_of_the_line_field_and_have_gradients():
    config = dataclasses.replace(TINY, num_queries=10, num_learned_queries=4)
    head, ground = MapHead(config), torch.randn(2, 16, 10, 20)
    sketch = head.line_field_head(ground)
    start, logit, kind = head.init_queries(sketch)
    plain = MapHead(TINY).init_queries(sketch)
    assert torch.equal(start[:, :6], plain[0]) and torch.equal(logit[:, :6], plain[1]) and kind.shape == (2, 6)
    # Of a probability of .01, somewhere on the tile, each elsewhere, the same in every tile.
    torch.testing.assert_close(logit[:, 6:].sigmoid(), torch.full((2, 4, 3), 0.01))
    lines = start[0, 6:].detach()
    assert torch.equal(start[1, 6:], start[0, 6:]) and float(lines.min()) >= 0 and float(lines.max()) <= 1
    assert float(torch.pdist(lines.mean(1)).min()) > 0.1
    for move in head.point_branches:
        torch.nn.init.normal_(list(move.parameters())[-2])  # untaught, nothing moves
    drawn(head, ground)[0].point.square().sum().backward()
    assert all(
        part.grad is not None and float(part.grad.abs().max()) > 0 for part in (head.start_points, head.query_embedding)
    )
    # One-to-many queries are the sketch's alone.
    assert drawn(head, ground, "many")[0].point.shape[1] == 9


def test_position_encoding_resolves_a_hundredth_of_the_tile():
    x, y = torch.meshgrid(torch.linspace(0, 1, 101), torch.linspace(0, 1, 51), indexing="ij")
    code = encode_position(torch.stack((x, y), -1)).flatten(0, 1)
    assert code.shape == (5151, 32)
    some = torch.arange(0, 5151, 37)
    away = torch.cdist(code[some], code)
    away[torch.arange(len(some)), some] = torch.inf
    assert float(away.min()) > 0.5


def at_three_places(monkeypatch, head, shift):
    """The head's answers when its queries begin at three places of the tile, one of them moved."""
    start = (THREE[None, :, None] / torch.tensor([20.0, 10.0])).expand(1, 3, 5, 2).clone()
    start[0, 2, :, 0] += shift
    begin = (start, torch.full((1, 3, 3), -4.0), torch.zeros(1, 3, dtype=torch.int64))
    monkeypatch.setattr(head, "init_queries", lambda line_field, group: begin)
    # Nothing is seen anywhere, so only the place itself can change the answer.
    ground = torch.zeros(1, 16, 10, 20)
    return drawn(head, ground)[0], start


def with_random_branches(head):
    """The same head with random branches."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for branch in (*head.point_branches, *head.class_branches):
            branch[-1].weight.normal_(generator=generator)
    return head.eval().requires_grad_(False)


def test_layer_depends_on_point_positions(monkeypatch):
    head = with_random_branches(MapHead(TINY))
    before, after = (at_three_places(monkeypatch, head, shift)[0].logit for shift in (0.0, 0.05))
    assert not torch.allclose(before[0, 2], after[0, 2], atol=1e-6)


def test_point_branch_depends_on_point_position(monkeypatch):
    head = with_random_branches(MapHead(TINY))
    for layer in head.layers:
        for norm in layer.get_submodule("norms").children():  # layers with zero output: x is 0
            for part in norm.parameters():
                part.zero_()
    (first, here), (second, there) = (at_three_places(monkeypatch, head, shift) for shift in (0.0, 0.05))
    moved, again = first.point - here, second.point - there
    assert float((moved[0, 2] - again[0, 2]).abs().max()) > 1e-3
    assert torch.equal(moved[0, 0], again[0, 0])


def test_low_scores_give_an_empty_map():
    raw = RawMap(torch.full((2, 6, 3), -9.0), torch.rand(2, 6, 5, 2))
    assert [len(found) for found in decode_elements(raw, TILE, TINY)] == [0, 0]


@pytest.mark.parametrize(
    "fields",
    [{"channels": 10}, {"num_points": 1}, {"kinds": ("divider", "kerb")}, {"kinds": ()}, {"num_learned_queries": 50}],
)
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ConfigError, match="MapHeadConfig"):
        MapHeadConfig(**{"heads": 8, **fields})
