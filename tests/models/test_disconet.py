# SPDX-License-Identifier: Apache-2.0
"""DiscoNet's weights: equal ones give a mean, absent senders count as rows of zeros, and a stack of dense agents."""

import torch
from tests.models.fusion_cases import CHANNELS, agent, at, built, draw_agent, rows_of

from manyeyes.models.fusion.disconet import DiscoNet

X = torch.randn(3, CHANNELS, generator=torch.Generator().manual_seed(0))


def test_equal_weights_give_the_mean_of_those_present() -> None:
    rows = rows_of(agent(X[:1], at(0), False), agent(X[1:2], at(0), True), agent(X[2:], at(1), True))
    for absent, counts in (("masked", (2, 1)), ("zero", (3, 3))):
        model = built(DiscoNet, absent)
        model.weigh[-2].weight.zero_()
        wanted = torch.stack((X[:2].sum(0) / counts[0], X[2] / counts[1]))
        assert torch.allclose(model(rows), wanted, atol=1e-6)


def test_weights_are_those_of_a_softmax_over_agents() -> None:
    rows = rows_of(draw_agent(0, False), draw_agent(1, True), draw_agent(2, True))
    own, models = rows.own_features(), {a: built(DiscoNet, a) for a in ("masked", "zero")}
    for absent, model in models.items():
        fused = model(rows)
        for u in range(len(rows.sites)):
            x = rows.features[rows.cell == u]
            if absent == "zero":
                x = torch.cat((x, torch.zeros(3 - len(x), CHANNELS)))
            weight = model.weigh(torch.cat((x, own[u].expand(len(x), -1)), 1)).softmax(0)
            assert torch.allclose(fused[u], (weight * x).sum(0), atol=1e-5)


def test_one_agent_is_returned_as_it_is() -> None:
    rows = rows_of(draw_agent(0, False))
    assert torch.allclose(built(DiscoNet)(rows), rows.features, atol=1e-6)
