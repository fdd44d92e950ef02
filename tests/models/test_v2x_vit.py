# SPDX-License-Identifier: Apache-2.0
"""V2X-ViT's two attentions against loops over tokens, where its kinds and places make a difference, and its start."""

import math
from dataclasses import replace

import pytest
import torch
from tests.models.fusion_cases import agent, at, draw_agent, rows_of
from torch.nn import functional

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import gather_by_cell
from manyeyes.models.fusion.token_merge import TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import POSE_CONTEXT_DIM, Tokens
from manyeyes.models.fusion.v2x_vit import AgentAttention, MultiScaleWindows, V2xVitFusion, V2xVitLayer, V2xVitRule
from manyeyes.ops.window_attention import sincos_encoding, window_attention

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS, HEADS = 16, 2
CONFIG = AttentionConfig(window=4, blocks=2, heads=HEADS)


def tokens(n: int = 60, batch: int = 2, seed: int = 0, reach_m: float = 12.0) -> Tokens:
    """Tokens that stay where they are, several on one cell; of every ego's, half are its own."""
    rng = torch.Generator().manual_seed(seed)
    proposal = torch.randn(n, PROPOSAL_DIM, generator=rng)
    proposal[:, BOX_LAYOUT.heatmap_logit] = -9.0
    xy = (torch.rand(n, 2, generator=rng) - 0.5) * 2 * reach_m
    ego, cue = torch.randint(0, batch, (n,), generator=rng), torch.randn(n, POSE_CONTEXT_DIM, generator=rng)
    cue[torch.rand(n, generator=rng) < 0.5] = 0
    cue[:, 3:] = cue[:, 3:].abs()
    features, sender = torch.randn(n, CHANNELS, generator=rng), cue.any(1) * torch.randint(1, 4, (n,), generator=rng)
    roadside = sender == 3
    return Tokens(features, xy, ego, cue, proposal, torch.ones(n), sender, roadside, xy, GRID, batch)


def speaking(model: torch.nn.Module) -> torch.nn.Module:
    """With what is zero at the start drawn."""
    torch.manual_seed(1)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return model.eval().requires_grad_(False)


def test_agents_at_one_place_attend_by_kind_and_edge():
    """A loop over tokens with the paper's sums: softmax over j of q_i W_att k_j / sqrt(d), of the messages v_j W_msg."""
    model, some = speaking(AgentAttention(CHANNELS, HEADS)), tokens()
    key, kind, d = assign_cells(some)[0], (some.sender > 1).long(), CHANNELS // HEADS
    assert len(key.unique()) < len(key) and 10 < int(kind.sum()) < 50
    found = model(some.features, key, kind)
    for i in range(len(key)):
        mates, ki = (key == key[i]).nonzero()[:, 0].tolist(), int(kind[i])
        query = model.query.maps[ki](some.features[i]).view(HEADS, d)
        heads = []
        for h in range(HEADS):
            logits, messages = [], []
            for j in mates:
                kj = int(kind[j])
                known = model.key.maps[kj](some.features[j]).view(HEADS, d)[h] @ model.attention_matrix[ki, kj, h]
                messages.append(
                    model.value.maps[kj](some.features[j]).view(HEADS, d)[h] @ model.message_matrix[ki, kj, h]
                )
                logits.append(query[h] @ known / math.sqrt(d))
            heads.append(torch.stack(logits).softmax(0) @ torch.stack(messages))
        torch.testing.assert_close(found[i], model.out.maps[ki](torch.cat(heads)), atol=1e-4, rtol=1e-4)


def test_windows_of_three_sizes_are_weighed_by_split_attention():
    model, some = speaking(MultiScaleWindows(CHANNELS, CONFIG)), tokens()
    agent = some.ego * 2 + (some.sender > 0)
    found = model(some.features, some.xy, agent, 4, GRID)
    assert [(s.heads, s.window) for s in model.scales] == [(4, 2), (2, 4), (1, 8)]
    branches = []
    for scale in model.scales:
        edge, out = scale.window * GRID.cell_size_m, torch.zeros(len(agent), CHANNELS)
        at = ((some.xy.double() + 25.6) / edge).floor()
        place = ((some.xy.double() + 25.6) / edge - at - 0.5).float() * scale.window
        q, k, _ = scale.qkv(some.features + sincos_encoding(place, CHANNELS)).chunk(3, 1)
        v = scale.qkv(some.features).chunk(3, 1)[2]
        for i in range(len(agent)):
            mates = ((at == at[i]).all(1) & (agent == agent[i])).nonzero()[:, 0]
            split = [x.view(len(x), scale.heads, -1).transpose(0, 1) for x in (q[i : i + 1], k[mates], v[mates])]
            out[i] = functional.scaled_dot_product_attention(*split).transpose(0, 1).flatten()
        branches.append(scale.out(out))
    for i in range(len(agent)):
        mean = sum(b[agent == agent[i]].mean(0) for b in branches)
        share = model.outer(torch.relu(model.norm(model.inner(mean)))).view(3, CHANNELS).softmax(0)
        torch.testing.assert_close(found[i], sum(s * b[i] for s, b in zip(share, branches)), atol=1e-4, rtol=1e-4)


def test_untrained_fusion_equals_softmax_merge():
    """Of tokens that are each alone of their sender on a cell, and of the maximum of several."""
    torch.manual_seed(0)
    some, model = tokens(), V2xVitFusion(CHANNELS, CONFIG).eval().requires_grad_(False)
    plain = TokenMerge(CHANNELS, "softmax")
    plain.load_state_dict(model.merge.state_dict())
    key, place = assign_cells(some)
    rows, row_of_token = gather_by_cell(some.features, some, key)
    assert len(rows.cell) < len(key)
    wanted = plain(rows.features[row_of_token], some, key, place).bev.features
    torch.testing.assert_close(model(some).bev.features, wanted)
    loud = speaking(V2xVitFusion(CHANNELS, CONFIG))
    assert len(loud.layers) == 2 and not torch.allclose(loud(some).bev.features, model(some).bev.features)


def test_equal_types_and_identity_edges_are_ordinary_attention():
    model, some = speaking(AgentAttention(CHANNELS, HEADS)), tokens()
    for each in (model.query, model.key, model.value, model.out):
        each.maps[1].load_state_dict(each.maps[0].state_dict())
    for edges in (model.attention_matrix, model.message_matrix):
        edges.copy_(torch.eye(CHANNELS // HEADS).expand_as(edges))
    key, kind = assign_cells(some)[0], some.infrastructure.long()
    split = [p.maps[0](some.features).view(-1, HEADS, CHANNELS // HEADS) for p in (model.query, model.key, model.value)]
    wanted = model.out.maps[0](window_attention(*split, key, key).flatten(1))
    torch.testing.assert_close(model(some.features, key, kind), wanted, atol=1e-5, rtol=1e-5)


def test_swapping_collaborators_of_one_type_changes_nothing_and_of_two_types_does():
    model = speaking(V2xVitRule(CHANNELS, CONFIG, "zero"))
    own, a, b = draw_agent(0, False), draw_agent(1, True), draw_agent(2, True)
    first, second = model(rows_of(own, a, b)), model(rows_of(own, b, a))
    torch.testing.assert_close(first, second, atol=1e-5, rtol=1e-4)
    roadside = [replace(x, is_infrastructure=True) for x in (a, b)]
    one, other = model(rows_of(own, roadside[0], b)), model(rows_of(own, a, roadside[1]))
    assert not torch.allclose(one, first, atol=1e-3) and not torch.allclose(one, other, atol=1e-3)


def test_agent_attention_of_a_single_agent_is_a_linear_map_of_its_own_row():
    model, some = speaking(AgentAttention(CHANNELS, HEADS)), tokens()
    kind = torch.zeros(len(some.xy), dtype=torch.int64)
    found = model(some.features, torch.arange(len(kind)), kind)
    value = model.value.maps[0](some.features).view(-1, HEADS, CHANNELS // HEADS)
    message = torch.einsum("nhd,hde->nhe", value, model.message_matrix[0, 0])
    torch.testing.assert_close(found, model.out.maps[0](message.flatten(1)), atol=1e-5, rtol=1e-5)


def test_windows_hold_one_agent_each():
    """A collaborator on a cell of its own, near the ego's: the ego's row does not change, whatever it sends."""
    model = speaking(V2xVitLayer(CHANNELS, CONFIG))
    own = agent(torch.randn(1, CHANNELS), at(0), False)
    near = [agent(torch.randn(1, CHANNELS), at(0) + 1, True) for _ in range(2)]
    first, second = (model(rows_of(own, part)).features for part in near)
    torch.testing.assert_close(first[0], second[0])
    assert not torch.allclose(first[1], second[1])


def test_egos_are_independent_and_gradients_reach_every_layer():
    some, model = tokens(), speaking(V2xVitFusion(CHANNELS, CONFIG))
    first = model(some.select((some.ego == 0).nonzero()[:, 0]))
    together = model(some)
    wanted = together.bev.features[together.bev.sites.batch == 0]
    torch.testing.assert_close(first.bev.features, wanted, atol=1e-4, rtol=1e-4)
    model.requires_grad_(True)(some).bev.features.square().sum().backward()
    assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in model.layers.parameters())
    none = some.select(torch.zeros(0, dtype=torch.int64))
    assert model(none).bev.features.shape == (0, CHANNELS)


def test_shapes_that_cannot_be_halved_are_refused():
    with pytest.raises(ConfigError, match="even heads"):
        V2xVitFusion(CHANNELS, replace(CONFIG, heads=1))
