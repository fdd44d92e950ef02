# SPDX-License-Identifier: Apache-2.0
"""Where2comm's attention against a loop over agents of a cell; confidence raises the share of a collaborator."""

import math
from dataclasses import replace

import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, built, draw_agent, rows_of

from manyeyes.models.fusion.where2comm import Where2comm
from manyeyes.ops.window_attention import sincos_encoding


def rows():
    drawn = rows_of(draw_agent(0, False), draw_agent(1, True), draw_agent(2, True))
    return replace(drawn, confidence=torch.rand(len(drawn.cell), generator=torch.Generator().manual_seed(5)))


@pytest.mark.parametrize("absent", ["masked", "zero"])
def test_attention_is_that_of_a_loop_over_agents(absent) -> None:
    model, some = built(Where2comm, absent), rows()
    fused, own, d = model(some), some.own_features(), CHANNELS // CONFIG.heads
    place = sincos_encoding(some.sender_xy / some.sites.grid.cell_size_m, CHANNELS)
    for u in range(len(some.sites)):
        mine = (some.cell == u).nonzero()[:, 0]
        x, key, c = some.features[mine], some.features[mine] + place[mine], some.confidence[mine]
        if absent == "zero":
            empty = torch.zeros(3 - len(mine), CHANNELS)
            x, key, c = torch.cat((x, empty)), torch.cat((key, empty)), torch.cat((c, empty[:, 0]))
        heads = []
        for h in range(CONFIG.heads):
            span = slice(h * d, (h + 1) * d)
            q, k, v = model.query(own[u])[span], model.key(key)[:, span], model.value(x)[:, span]
            heads.append(((q @ k.T / math.sqrt(d)).softmax(0) * c) @ v)
        after = model.norm(own[u] + model.out(torch.cat(heads)))
        assert torch.allclose(fused[u], model.norm_ffn(after + model.ffn(after)), atol=1e-5)


def test_a_surer_collaborator_has_a_larger_share() -> None:
    """The norm of what a collaborator adds to the message grows with its confidence, from nothing at zero."""
    model, some = built(Where2comm), rows()
    model.norm, model.norm_ffn, model.ffn = torch.nn.Identity(), torch.nn.Identity(), torch.nn.Sequential()
    others = ~some.is_own

    def added(confidence: float) -> torch.Tensor:
        return model(replace(some, confidence=torch.where(others, confidence, some.confidence)))

    none = added(0.0)
    met = some.sum(others[:, None].float())[:, 0] > 0
    norms = [(added(c) - none)[met].norm(dim=1) for c in (0.2, 0.5, 1.0)]
    assert bool((norms[0] > 0).all()) and bool((norms[1] > norms[0]).all()) and bool((norms[2] > norms[1]).all())


def test_renormalised_weights_do_not_see_a_common_factor() -> None:
    torch.manual_seed(0)
    model, some = Where2comm(CHANNELS, CONFIG, "masked", renormalise=True).eval().requires_grad_(False), rows()
    half = replace(some, confidence=some.confidence / 2)
    assert torch.allclose(model(some), model(half), atol=1e-5)
    assert not torch.allclose(built(Where2comm)(some), built(Where2comm)(half), atol=1e-3)
