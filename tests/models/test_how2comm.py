# SPDX-License-Identifier: Apache-2.0
"""How2comm: shares of confidence, straight-through gates, reach, and an attention by hand."""

import math
from dataclasses import replace

import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, agent, at, built, draw_agent, rows_of

from manyeyes.models.fusion.how2comm import How2comm, NearestAttention, split_confidence

X = torch.randn(3, CHANNELS, generator=torch.Generator().manual_seed(0))


def some_rows():
    return rows_of(draw_agent(0, False), draw_agent(1, True), draw_agent(2, True))


def test_exclusive_and_common_shares_add_up_to_the_confidence() -> None:
    rows = some_rows()
    exclusive, common = split_confidence(rows)
    assert torch.allclose(exclusive + common, rows.confidence)
    unseen = (rows.own_features().abs().sum(1) == 0)[rows.cell]
    assert bool(unseen.any()) and torch.equal(exclusive[unseen], rows.confidence[unseen])


def test_an_ego_that_is_sure_everywhere_uses_common_features_alone() -> None:
    """The exclusive branch has other weights, and no say."""
    rows = rows_of(agent(X[:2], at(0, 1), False), agent(X[1:], at(0, 1), True))
    rows = replace(rows, confidence=torch.where(rows.is_own, 1.0, rows.confidence))
    rows = replace(rows, confidence=torch.where(rows.is_own, rows.confidence, 0.8))
    first, second = built(How2comm), built(How2comm)
    torch.nn.init.normal_(second.exclusive.value.weight)
    assert torch.equal(first(rows), second(rows))
    torch.nn.init.normal_(second.common.value.weight)
    assert not torch.allclose(first(rows), second(rows))


def test_the_loss_reaches_the_weights_of_the_gate_and_an_open_gate_changes_nothing() -> None:
    """In training; outside of it senders have cut what arrives."""
    model, rows = built(How2comm).requires_grad_(True).train(), some_rows()
    model(rows).square().sum().backward()
    assert all(bool(p.grad.abs().sum() > 0) for p in model.spatial.parameters())
    with torch.no_grad():
        fused = model(rows)
        model.spatial.combine.bias.fill_(50.0)
        assert torch.allclose(model(rows), fused, atol=1e-6)
        model.spatial.combine.bias.fill_(-50.0)
        assert torch.equal(model(rows), rows.own_features())
        assert torch.allclose(model.eval()(rows), fused, atol=1e-6)


def test_one_agent_is_returned_as_it_is() -> None:
    rows = rows_of(draw_agent(0, False))
    assert torch.equal(built(How2comm)(rows), rows.features)


def test_attention_is_over_the_nearest_rows_in_reach() -> None:
    """Two rows on the ego's cell, and one three cells away, out of reach."""
    torch.manual_seed(0)
    model = NearestAttention(CHANNELS, CONFIG.heads, 3).requires_grad_(False)
    rows = rows_of(agent(X[:1], at(0), False), agent(X[[0, 2]], at(0, 1), True), agent(X[1:2], at(0), True))
    kept = (~rows.is_own).nonzero()[:, 0]
    got = model(rows.own_features(), rows, rows.features[kept], kept)
    near = rows.features[kept][rows.cell[kept] == 0]
    q, k, v = (
        f(x).view(-1, CONFIG.heads, CHANNELS // 2)
        for f, x in ((model.query, X[:1]), (model.key, near), (model.value, near))
    )
    share = ((q * k).sum(2) / math.sqrt(CHANNELS // 2)).softmax(0)
    assert torch.allclose(got[0], model.out((share[:, :, None] * v).sum(0).flatten()), atol=1e-5)
    other = model(rows.own_features(), rows, rows.features[kept[:0]], kept[:0])
    assert not bool(other.any())
