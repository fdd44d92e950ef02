# SPDX-License-Identifier: Apache-2.0
"""One row a sender and cell: maxima, unions, absent senders, and the ego's dense map."""

import torch
from tests.models.fusion_cases import CHANNELS, GRID, agent, at, draw_agent, rows_of, tokens_of

from manyeyes.datatypes import SparseBev
from manyeyes.models.fusion.by_cell import gather_by_cell, standing_cells


def constant(value: float, *columns: int, sender: bool = True) -> object:
    return agent(torch.full((len(columns), CHANNELS), value), at(*columns), sender)


def test_tokens_of_one_sender_on_a_cell_become_their_maximum() -> None:
    x = torch.randn(3, CHANNELS, generator=torch.Generator().manual_seed(0))
    rows = rows_of(agent(x[:1], at(0), False), agent(x[[1, 2]], at(0, 0), True))
    assert len(rows.sites) == 1 and rows.agent.tolist() == [0, 1] and rows.is_own.tolist() == [True, False]
    assert torch.equal(rows.features, torch.stack((x[0], torch.maximum(x[1], x[2]))))


def test_cells_are_the_union_and_absent_senders_are_counted() -> None:
    """column   0  1  2
    ego          1  1  .
    first        .  2  2
    second       .  .  3
    """
    rows = rows_of(constant(1, 0, 1, sender=False), constant(2, 1, 2), constant(3, 2))
    assert rows.sites.yx[:, 1].tolist() == [4, 7, 10] and rows.count.tolist() == [3]
    assert rows.num_rows.tolist() == [1, 2, 2] and rows.num_absent.tolist() == [2, 1, 1]
    assert rows.own_features()[:, 0].tolist() == [1, 1, 0]
    assert rows.sum(rows.features)[:, 0].tolist() == [1, 3, 5]


def test_the_maximum_counts_absent_senders_as_zero_or_not_at_all() -> None:
    rows = rows_of(constant(-1, 0, 1, sender=False), constant(-2, 1))
    assert rows.max("masked")[:, 0].tolist() == [-1, -1]
    assert rows.max("zero")[:, 0].tolist() == [0, -1]
    alone = rows_of(constant(-1, 0, 1, sender=False))
    assert torch.equal(alone.max("zero"), alone.features)


def test_the_softmax_over_senders_is_that_of_a_dense_stack() -> None:
    rows = rows_of(draw_agent(0, False), draw_agent(1, True), draw_agent(2, True))
    logit = torch.randn(len(rows.cell), 2, generator=torch.Generator().manual_seed(3)) * 3
    absent = torch.randn(len(rows.sites), 2, generator=torch.Generator().manual_seed(4))
    masked, zero = rows.softmax(logit), rows.softmax(logit, absent)
    for u in range(len(rows.sites)):
        mates = (rows.cell == u).nonzero()[:, 0]
        assert torch.allclose(masked[mates], logit[mates].softmax(0), atol=1e-6)
        full = torch.cat((logit[mates], absent[u].expand(3 - len(mates), 2)))
        assert torch.allclose(zero[mates], full.softmax(0)[: len(mates)], atol=1e-6)


def test_maps_of_senders() -> None:
    rows = rows_of(draw_agent(0, False), draw_agent(1, True), draw_agent(2, True))
    maps = rows.to_maps()
    assert maps.sites.batch_size == 3 and maps.is_own.tolist() == (maps.sites.batch == 0).tolist()
    assert torch.equal(maps.features[maps.is_own], rows.features[rows.is_own])
    assert torch.equal(rows.sites.yx[maps.cell], maps.sites.yx)
    assert torch.equal(maps.to_rows(maps.features), rows.features)
    second = SparseBev(maps.features, maps.sites).dense()[1]
    mine = (rows.agent == 1).nonzero()[:, 0]
    y, x = rows.sites.yx[rows.cell[mine]].unbind(1)
    assert torch.equal(second[:, y, x].T, rows.features[mine]) and int((second != 0).any(0).sum()) == len(mine)


def test_the_dense_map_of_the_ego_has_zeros_where_it_has_no_row() -> None:
    rows = rows_of(draw_agent(0, False, roadside=True), draw_agent(1, True))
    full = rows.with_own_everywhere()
    assert int(full.is_own.sum()) == len(rows.sites) > int(rows.is_own.sum())
    assert torch.equal(full.own_features(), rows.own_features())
    assert torch.equal(full.sum(full.features), rows.sum(rows.features))
    assert bool(full.infrastructure[full.is_own].all()) and not bool(full.infrastructure[~full.is_own].any())
    assert bool((full.cell[1:] >= full.cell[:-1]).all())
    assert full.with_own_everywhere() is full


def test_a_token_stands_on_its_own_cell_whatever_it_proposes() -> None:
    some = draw_agent(0, False)
    some.tokens[:, CHANNELS] = 5.0
    some.tokens[:, CHANNELS + 1 :] = 1.0
    tokens = tokens_of(some)
    rows, row_of_token = gather_by_cell(tokens.features, tokens, standing_cells(tokens))
    assert torch.equal(rows.sites.yx[rows.cell[row_of_token]], GRID.cells(some.xy))
    assert torch.allclose(rows.confidence, torch.sigmoid(torch.tensor(5.0)).expand(40))
    assert torch.allclose(rows.xy[row_of_token], some.xy) and torch.allclose(rows.sender_xy, rows.xy)


def test_no_tokens_have_no_cells() -> None:
    empty = tokens_of(draw_agent(0, False, n=0), batch_size=2)
    rows, _ = gather_by_cell(empty.features, empty, standing_cells(empty))
    assert len(rows.sites) == 0 and rows.count.tolist() == [1, 1] and rows.with_own_everywhere() is rows
