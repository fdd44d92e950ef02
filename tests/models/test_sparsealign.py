# SPDX-License-Identifier: Apache-2.0
"""SparseAlign's eight nearest queries: copies of one, the ninth, and queries out of reach."""

import torch
from tests.models.fusion_cases import CHANNELS, GRID, agent, at, built, draw_agent, rows_of

from manyeyes.models.fusion.sparsealign import MAX_DISTANCE_CELLS, NUM_NEAREST, SparseAlign

X = torch.randn(1, CHANNELS, generator=torch.Generator().manual_seed(0))


def test_copies_of_one_query_give_twice_its_feature() -> None:
    """Maximum plus mean of eight equal values is twice the value, and so it is of one."""
    model = built(SparseAlign)
    one = model(rows_of(agent(X, at(0), False)))
    eight = model(rows_of(agent(X, at(0), False), *(agent(X, at(0), True) for _ in range(7))))
    mixed = model.mix(torch.cat((X, model.embed(torch.zeros(1, 2))), 1))
    assert torch.allclose(one, 2 * torch.nn.functional.leaky_relu(model.norm(mixed)), atol=1e-6)
    assert torch.allclose(eight, one, atol=1e-6)


def test_the_ninth_query_changes_nothing_and_the_eighth_does() -> None:
    """Nine agents on one row of cells; the last lies farther from the first cell than the others."""
    model, yx = built(SparseAlign), torch.tensor([[16, 8]])
    g = torch.Generator().manual_seed(1)
    near = [agent(torch.randn(1, CHANNELS, generator=g), yx, k > 0) for k in range(NUM_NEAREST)]
    far = [agent(torch.randn(1, CHANNELS, generator=g), yx + torch.tensor([[0, 2]]), True) for _ in range(2)]
    first, second = (model(rows_of(*near, part))[0] for part in far)
    assert torch.equal(first, second)
    fewer, other = (model(rows_of(*near[:-1], part))[0] for part in far)
    assert not torch.allclose(fewer, other, atol=1e-3)


def test_a_query_out_of_reach_is_left_out() -> None:
    model, yx = built(SparseAlign), torch.tensor([[16, 4]])
    far = agent(X, yx + torch.tensor([[0, int(MAX_DISTANCE_CELLS) + 1]]), True)
    own = agent(-X, yx, False)
    assert torch.allclose(model(rows_of(own, far))[0], model(rows_of(own))[0], atol=1e-6)


def test_offsets_are_those_of_the_query_from_the_cell_in_cells() -> None:
    """A query half a cell beside the middle of its cell."""
    model, own = built(SparseAlign), agent(X, at(0), False)
    own.xy[:, 0] += 0.4 * GRID.cell_size_m
    mixed = model.mix(torch.cat((X, model.embed(torch.tensor([[0.4, 0.0]]))), 1))
    wanted = 2 * torch.nn.functional.leaky_relu(model.norm(mixed))
    assert torch.allclose(model(rows_of(own)), wanted, atol=1e-5)
    assert model(rows_of(draw_agent(0, False, n=0))).shape == (0, CHANNELS)
