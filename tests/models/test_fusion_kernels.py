# SPDX-License-Identifier: Apache-2.0
"""Compiled fusion gives what its layers give: transform, cells, encoding, past attention, merge, and all of them together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, Transform
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.transformer import AttentionConfig, WindowBlock
from manyeyes.models.fusion.flow_aware import FastFusion, PastAttention
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.token_merge import TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import (
    MAX_SPEED_MPS,
    TOKEN_COLUMNS,
    AgentTokens,
    Tokens,
    are_last_rows,
    split_last,
    to_ego_frame,
)

GRID = BevGrid(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0, stride=4)
CHANNELS = 32
CONFIG = AttentionConfig(window=4, heads=2)


def part(seed: int, n: int, ego: int = 0, age_s: float = 0.0, motion: Transform | None = None) -> AgentTokens:
    """Random tokens, some of them too fast to be propagated and some beyond the range."""
    g = torch.Generator().manual_seed(seed)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * torch.tensor([60.0, 30.0])
    rows = torch.randn(n, CHANNELS + PROPOSAL_DIM, generator=g)
    rows[:, -2:] *= MAX_SPEED_MPS / 10
    return AgentTokens(ego, rows, xy, motion, age_s, 0.3 if motion else 0.0, 0.02 if motion else 0.0)


def parts() -> list[AgentTokens]:
    pose, earlier = Transform.from_xyz_yaw(4.0, -3.0, 0.7, 2.4), Transform.from_xyz_yaw(-1.5, 0.2, 0.1, 0.05)
    inside = part(0, 70)
    inside = replace(inside, xy=inside.xy * 0.8)
    return [inside, part(1, 90, 0, 0.2, pose), part(2, 0, 0, 0.1, pose), part(3, 60, 1, 0.1, earlier)]


def own_past() -> list[AgentTokens]:
    return [part(k, 20, 0, 0.1 * k, Transform.from_xyz_yaw(-1.0 * k, 0.0)) for k in (1, 2)]


def by_tensors(some: list[AgentTokens]) -> Tokens:
    """The same tokens by tensor operations, which those that need a gradient go through."""
    masked = [replace(p, selection_mask=torch.ones(len(p.tokens))) for p in some]
    return to_ego_frame(masked, GRID, 2)


def draw_weights(layer: nn.Module) -> None:
    g = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for weight in layer.parameters():
            weight.copy_(torch.randn(weight.shape, generator=g) * 0.2)


def test_tokens_move_as_by_tensors() -> None:
    got, want = to_ego_frame(parts(), GRID, 2), by_tensors(parts())
    assert 100 < len(got.xy) < 220 and torch.equal(got.ego, want.ego)
    for name in ("features", "xy", "pose_context", "proposal", "selection_mask", "sender_xy"):
        assert torch.allclose(getattr(got, name), getattr(want, name), atol=2e-5), name
    assert torch.equal(got.sender, want.sender) and torch.equal(got.infrastructure, want.infrastructure)


@pytest.mark.parametrize("transform", [lambda some: to_ego_frame(some, GRID, 2), by_tensors], ids=["loops", "tensors"])
def test_a_token_names_its_sender_its_type_and_its_place_in_the_senders_frame(transform) -> None:
    some = parts()
    some[1] = replace(some[1], is_infrastructure=True)
    tokens = transform(some)
    assert sorted({*zip(tokens.ego.tolist(), tokens.sender.tolist())}) == [(0, 0), (0, 1), (1, 1)]
    assert torch.equal(tokens.infrastructure, (tokens.ego == 0) & (tokens.sender == 1))
    from_second = tokens.sender_xy[tokens.infrastructure]
    assert 10 < len(from_second) < 90
    assert (from_second[:, None] == some[1].xy).all(2).any(1).all()
    # Messages in another order have other numbers, and no other difference.
    turned = transform([some[0], some[2], some[1], some[3]])
    assert torch.equal(turned.sender[turned.infrastructure].unique(), torch.tensor([2]))
    assert torch.equal(turned.features, tokens.features)


@pytest.mark.parametrize("masked", [False, True])
def test_the_last_parts_are_those_parts_alone(masked: bool) -> None:
    first, last = parts()[:3], [replace(p, ego=0) for p in (part(4, 50, 0, 0.1), parts()[3])]
    last[0] = replace(last[0], ego_from_sender=Transform.from_xyz_yaw(1.0, 0.0, 0.0, 0.1))
    if masked:
        first, last = ([replace(p, selection_mask=torch.ones(len(p.tokens))) for p in some] for some in (first, last))
    got, want = split_last(to_ego_frame([*first, *last], GRID, 1), 3), to_ego_frame(last, GRID, 1)
    assert len(want.xy) > 50 and want.sender.unique().tolist() == [1, 2]
    for name in TOKEN_COLUMNS:
        assert torch.equal(getattr(got, name), getattr(want, name)), name


def test_tokens_are_assigned_to_cells_as_by_tensors() -> None:
    tokens = to_ego_frame(parts(), GRID, 2)
    with_gradient = replace(tokens, proposal=tokens.proposal.clone().requires_grad_())
    got, want = assign_cells(tokens), assign_cells(with_gradient)
    assert torch.equal(got[0], want[0])
    assert torch.allclose(got[1], want[1], atol=1e-5)
    stays = torch.cat([assign_cells(replace(tokens, proposal=torch.zeros_like(tokens.proposal)))[0]])
    assert not torch.equal(got[0], stays)


@pytest.mark.parametrize("which", ["encoding", "merge", "past", "fusion", "fusion without past"])
def test_compiled_layers_give_what_their_tensors_give(which: str) -> None:
    tokens, past = to_ego_frame(parts(), GRID, 2), to_ego_frame(own_past(), GRID, 2)
    key, offset = assign_cells(tokens)
    layers: dict[str, nn.Module] = {
        "encoding": SpatioTemporalEncoding(CHANNELS),
        "merge": TokenMerge(CHANNELS, "softmax"),
        "past": PastAttention(CHANNELS, CONFIG),
    }
    layer = layers.get(which) or FastFusion(CHANNELS, CONFIG)
    draw_weights(layer)

    def run() -> list[Tensor]:
        with torch.inference_mode():
            if which == "encoding":
                return [layer(tokens.features, tokens, offset)]
            if which == "past":
                return [layer(tokens.features, tokens, past.features, past)]
            fused = layer(tokens.features, tokens, key, offset) if which == "merge" else layer(tokens, some_past)
            return [fused.bev.features, fused.merged_proposals, fused.bev.sites.key]

    some_past = None if which == "fusion without past" else past
    want = run()
    for module in layer.modules():
        if isinstance(module, SpatioTemporalEncoding | TokenMerge | PastAttention | WindowBlock):
            module.fold()
            assert module.folded is not None
    for a, b in zip(run(), want):
        assert torch.allclose(a, b, atol=1e-4, rtol=1e-4)


def test_tokens_without_past_in_their_window_stay() -> None:
    layer = PastAttention(CHANNELS, CONFIG)
    draw_weights(layer)
    layer.fold()
    tokens = to_ego_frame([replace(part(0, 40), xy=torch.rand(40, 2))], GRID, 2)
    far = to_ego_frame([replace(part(1, 10), xy=torch.rand(10, 2) + 10.0)], GRID, 2)
    near = to_ego_frame([replace(part(1, 10), xy=torch.rand(10, 2))], GRID, 2)
    with torch.inference_mode():
        assert torch.equal(layer(tokens.features, tokens, far.features, far), tokens.features)
        assert not torch.equal(layer(tokens.features, tokens, near.features, near), tokens.features)


def test_the_past_among_the_tokens_is_encoded_once_and_alike() -> None:
    tokens = to_ego_frame([*parts()[:3], *own_past()], GRID, 1)
    past = split_last(tokens, 3)
    copied = replace(past, **{name: getattr(past, name).clone() for name in TOKEN_COLUMNS})
    assert len(past.xy) > 20 and are_last_rows(past, tokens) and not are_last_rows(copied, tokens)
    layer, counts = FastFusion(CHANNELS, CONFIG), list[int]()
    draw_weights(layer)
    layer.encoding.register_forward_hook(lambda module, given, out: counts.append(len(out)))
    with torch.inference_mode():
        got, want = layer(tokens, past), layer(tokens, copied)
    assert counts == [len(tokens.xy), len(tokens.xy), len(past.xy)]
    assert torch.allclose(got.bev.features, want.bev.features, atol=1e-5)
    assert torch.allclose(got.merged_proposals, want.merged_proposals, atol=1e-5)
