# SPDX-License-Identifier: Apache-2.0
"""ERMVP's layers: local windows against a loop, global queries by hand, and the mean over agents."""

import math

import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, agent, at, built, draw_agent, rows_of

from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.ermvp import WINDOW_CELLS, Attention, Ermvp, ErmvpLayer
from manyeyes.ops.window_attention import sincos_encoding


def attend(model: Attention, query, x, place):
    """One group of rows (M, C), one query (C,)."""
    d = CHANNELS // CONFIG.heads
    q, k, v = (t.view(-1, CONFIG.heads, d) for t in (model.query(query), model.key(x + place), model.value(x)))
    share = ((q * k).sum(2) / math.sqrt(d)).softmax(0)
    return model.out((share[:, :, None] * v).sum(0).flatten())


def test_a_layer_is_that_of_a_loop_over_windows() -> None:
    """Rows of all agents in a window attend to each other; the global query is that of the row's position in its window."""
    torch.manual_seed(0)
    layer = ErmvpLayer(CHANNELS, CONFIG).requires_grad_(False)
    rows = rows_of(draw_agent(0, False), draw_agent(1, True))
    x, yx = rows.features, rows.sites.yx[rows.cell]
    coarse, inside = yx // WINDOW_CELLS, yx % WINDOW_CELLS
    encode = lambda p: sincos_encoding(p - (WINDOW_CELLS - 1) / 2, CHANNELS)  # noqa: E731
    place = encode(inside.float())
    mates = (coarse[:, None] == coarse).all(2)

    def by_window(model, query, normed):
        return torch.stack([attend(model, query[i], normed[m], place[m]) for i, m in enumerate(mates)])

    normed = layer.norms[0](x)
    y = x + by_window(layer.local, normed + place, normed)
    y = y + layer.ffns[0](layer.norms[1](y))
    normed = layer.norms[2](y)
    windows = coarse.unique(dim=0)
    pooled = torch.stack([normed[(coarse == w).all(1)].mean(0) for w in windows])
    spot = windows % WINDOW_CELLS
    where = encode(spot.float())
    attended = torch.stack([attend(layer.pooled, q, pooled, where) for q in pooled + where])
    query = torch.zeros(len(x), CHANNELS)
    for i, p in enumerate(inside):
        same = (spot == p).all(1)
        query[i] = attended[same].mean(0) if same.any() else 0.0
    y = y + by_window(layer.from_global, query + place, normed)
    y = y + layer.ffns[1](layer.norms[3](y))
    assert torch.allclose(layer(x, rows), y, atol=1e-4)


def test_agents_are_averaged_with_absent_ones_or_without() -> None:
    g = torch.Generator().manual_seed(0)
    x = torch.randn(2, CHANNELS, generator=g)
    rows = rows_of(agent(x[:1], at(0), False), agent(x[1:], at(0), True), agent(x[1:], at(1), True))
    masked, zero = built(Ermvp), built(Ermvp, "zero")
    for model in (masked, zero):
        model.layers = torch.nn.ModuleList()
        model.norm = torch.nn.Identity()
    assert torch.allclose(masked(rows)[0], masked.out(x.mean(0)), atol=1e-6)
    assert torch.allclose(zero(rows)[0], zero.out(x.sum(0) / 3), atol=1e-6)


def test_channels_that_heads_do_not_divide_are_refused() -> None:
    with pytest.raises(ConfigError, match="divisible by heads"):
        Ermvp(CHANNELS, AttentionConfig(heads=3), "zero")
