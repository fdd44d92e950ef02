# SPDX-License-Identifier: Apache-2.0
"""V2VNet by hand: closed gates, one GRU step of a single agent, the mean message, and a loop over pairs of dense maps."""

import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, agent, at, built, draw_agent, rows_of
from torch.nn import functional

from manyeyes.datatypes import SparseBev
from manyeyes.models.fusion.v2vnet import V2VNet

X = torch.randn(3, CHANNELS, generator=torch.Generator().manual_seed(0))


def pass_through(model: V2VNet) -> V2VNet:
    """With an identity as the last layer."""
    model.out.weight.copy_(torch.eye(CHANNELS))
    model.out.bias.zero_()
    return model


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_a_closed_update_gate_keeps_the_node(iterations: int) -> None:
    model = pass_through(V2VNet(CHANNELS, CONFIG, "masked", iterations).eval().requires_grad_(False))
    model.gru.gates.bias[:CHANNELS] = -100.0
    rows = rows_of(draw_agent(0, False), draw_agent(1, True))
    assert torch.equal(model(rows), rows.own_features())


def test_one_agent_takes_a_gru_step_on_its_own_message() -> None:
    model = pass_through(V2VNet(CHANNELS, CONFIG, "masked", 1).eval().requires_grad_(False))
    rows = rows_of(draw_agent(0, False))
    own = SparseBev(rows.features, rows.sites)
    message = model.from_sender(own) + model.from_receiver(own)
    assert torch.allclose(model(rows), model.gru(message, own), atol=1e-6)


@pytest.mark.parametrize(("absent", "share"), [("masked", (1 / 3, 1 / 2)), ("zero", (1 / 3, 1 / 3))])
def test_messages_that_pick_the_sender_are_averaged(absent, share) -> None:
    """Column 0 holds three agents, column 1 the ego and one; the candidate is that mean, with the gates open."""
    model = pass_through(V2VNet(CHANNELS, CONFIG, absent, 1).eval().requires_grad_(False))
    for conv in (model.from_sender, model.from_receiver, model.gru.gates, model.gru.candidate):
        conv.weight.zero_()
    model.from_sender.weight[:, :, 1, 1] = torch.eye(CHANNELS)
    model.gru.candidate.weight[:, :CHANNELS, 1, 1] = torch.eye(CHANNELS)
    model.gru.gates.bias[:] = 100.0
    x = 0.1 * X
    rows = rows_of(agent(x[[0, 0]], at(0, 1), False), agent(x[[1, 1]], at(0, 1), True), agent(x[2:], at(0), True))
    wanted = torch.stack((x.sum(0) * share[0], (x[0] + x[1]) * share[1]))
    assert torch.allclose(model(rows), torch.tanh(wanted), atol=1e-6)


def test_nodes_of_all_agents_are_updated_as_on_dense_maps() -> None:
    """Two agents on one block of cells: a loop over pairs with dense convolutions of the concatenated maps."""
    block = torch.stack(torch.meshgrid(torch.arange(5), torch.arange(5), indexing="ij"), -1).flatten(0, 1) + 10
    g = torch.Generator().manual_seed(1)
    x = [0.5 * torch.randn(25, CHANNELS, generator=g) for _ in range(2)]
    model = built(V2VNet)
    got = model(rows_of(agent(x[0], block, False), agent(x[1], block, True)))

    def conv(layer, *maps):
        weight = layer.weight if isinstance(layer, torch.nn.Module) else layer
        return functional.conv2d(torch.cat(maps)[None], weight, getattr(layer, "bias", None), padding=1)[0]

    h = [a.T.reshape(CHANNELS, 5, 5) for a in x]
    both = torch.cat((model.from_sender.weight, model.from_receiver.weight), 1)
    for _ in range(2):
        means = [
            sum(conv(both, h[j], h[i]) for j in range(2)) / 2 + model.from_receiver.bias[:, None, None]
            for i in range(2)
        ]
        after = []
        for a, node in zip(means, h):
            z, r = torch.sigmoid(conv(model.gru.gates, a, node)).chunk(2)
            after.append((1 - z) * node + z * torch.tanh(conv(model.gru.candidate, a, r * node)))
        h = after
    assert torch.allclose(got, model.out(h[0].flatten(1).T), atol=1e-5)
