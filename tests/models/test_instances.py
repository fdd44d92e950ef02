# SPDX-License-Identifier: Apache-2.0
"""Groups of tokens by distance: borders of cells, shifts of the lattice, a slow reference, and singletons."""

from dataclasses import replace

import pytest
import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, GRID, draw_agent, tokens_of
from torch import Tensor

from manyeyes.datatypes import BevGrid
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.models.fusion.flow_aware import FastFusion
from manyeyes.models.fusion.instances import InstanceFusion, assign_group_cells, find_group_heads
from manyeyes.models.fusion.token_merge import MIN_VOTE_LOGIT, FusedBev, assign_cells
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens, to_ego_frame

HALF = GRID.cell_size_m / 2
SHIFTED = BevGrid(GRID.x_min + HALF, GRID.y_min + HALF, -3.0, GRID.x_max + HALF, GRID.y_max + HALF, 5.0).at(4)


def propose(*centres: tuple[float, float], heat: float = 2.0, sigma_m: float = 0.0) -> AgentTokens:
    """An agent with a token 0.3 m left of each centre that it proposes."""
    xy = torch.tensor(centres) - torch.tensor([0.3, 0.0])
    rows = torch.zeros(len(centres), CHANNELS + PROPOSAL_DIM)
    rows[:, CHANNELS] = heat
    rows[:, CHANNELS:][:, BOX_LAYOUT.offset] = torch.tensor([0.3, 0.0]) / GRID.cell_size_m
    return AgentTokens(0, rows, xy, sigma_xy_m=sigma_m)


def partition(key: Tensor) -> list[list[int]]:
    return sorted([(key == k).nonzero()[:, 0].tolist() for k in key.unique()])


def fused(model: type[FastFusion], tokens: Tokens) -> FusedBev:
    torch.manual_seed(0)
    return model(CHANNELS, CONFIG).eval().requires_grad_(False)(tokens)


def box_centres(found: FusedBev) -> Tensor:
    """Centres of merged boxes with heat, sorted."""
    offset = found.merged_proposals[:, BOX_LAYOUT.offset] * GRID.cell_size_m
    centres = (found.bev.sites.xy + offset)[found.merged_proposals[:, 0] > 0]
    return centres[centres[:, 0].argsort()]


def random_tokens(grid: BevGrid, seed: int = 0) -> Tokens:
    parts = [draw_agent(seed + k, k > 0, n=60, reach=6) for k in range(3)]
    for part in parts:
        part.tokens[:, CHANNELS + 1 :] = 0.3 * torch.randn(
            60, PROPOSAL_DIM - 1, generator=torch.Generator().manual_seed(seed)
        )
        part.tokens[:, CHANNELS] -= 1
    return to_ego_frame(parts, grid, 1)


BORDER_X = float(GRID.centers(torch.tensor([[16, 16]]))[0, 0]) + HALF
"""A border between two columns of cells."""


def test_proposals_on_either_side_of_a_border_merge_to_one_mean_box() -> None:
    """Two agents, 0.1 m apart: FAST keeps two boxes, the merge by distance one between them."""
    tokens = tokens_of(propose((BORDER_X - 0.05, 0.3)), propose((BORDER_X + 0.05, 0.3)))
    assert len(fused(FastFusion, tokens).bev.sites) == 2
    found = fused(InstanceFusion, tokens)
    assert len(found.bev.sites) == 1
    assert torch.allclose(box_centres(found), torch.tensor([[BORDER_X, 0.3]]), atol=1e-4)


def test_the_merge_does_not_depend_on_the_lattice() -> None:
    """Shifted by half a cell, FAST merges other tokens; groups by distance are the same."""
    here, there = random_tokens(GRID), random_tokens(SHIFTED)
    assert torch.equal(here.xy, there.xy) and int((proposed_heat(here.proposal) > MIN_VOTE_LOGIT).sum()) > 100
    assert partition(assign_cells(here)[0]) != partition(assign_cells(there)[0])
    assert torch.equal(find_group_heads(here), find_group_heads(there))
    assert len(find_group_heads(here).unique()) < 170


def test_boxes_do_not_depend_on_the_lattice() -> None:
    objects = [(BORDER_X - 0.05, 0.3), (BORDER_X + 7.0, -4.0)]
    agents = propose(*objects), propose(*((x + 0.1, y - 0.05) for x, y in objects))
    centres = [box_centres(fused(InstanceFusion, to_ego_frame(agents, grid, 1))) for grid in (GRID, SHIFTED)]
    assert centres[0].shape == (2, 2) and torch.allclose(*centres, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_groups_are_those_of_a_slow_loop(seed: int) -> None:
    tokens = random_tokens(GRID, 10 * seed)
    goal = tokens.xy + tokens.proposal[:, BOX_LAYOUT.offset] * GRID.cell_size_m
    heat, heads, wanted = proposed_heat(tokens.proposal), list[int](), list(range(len(tokens.xy)))
    for i in heat.argsort(descending=True, stable=True).tolist():
        if heat[i] <= MIN_VOTE_LOGIT or not GRID.contains(goal[i : i + 1]):
            continue
        near = [(float((goal[i] - goal[j]).norm()), j) for j in heads if float((goal[i] - goal[j]).norm()) < 1.0]
        wanted[i] = min(near)[1] if near else i
        heads += [] if near else [i]
    assert find_group_heads(tokens).tolist() == wanted


def test_a_position_sigma_widens_the_radius() -> None:
    places = (BORDER_X, 0.3), (BORDER_X + 1.2, 0.3)
    own = propose(places[0], heat=3.0)
    for sigma_m, count in ((0.0, 2), (0.5, 1)):
        tokens = tokens_of(own, propose(places[1]))
        context = tokens.pose_context.clone()
        context[:, 3] = sigma_m
        assert len(find_group_heads(replace(tokens, pose_context=context)).unique()) == count


def test_a_token_alone_keeps_its_box_and_one_without_an_object_its_cell() -> None:
    tokens = tokens_of(propose((3.0, 2.0), (9.0, 2.0)), propose((3.1, 8.0), heat=MIN_VOTE_LOGIT - 1))
    key, offset = assign_group_cells(tokens)
    assert torch.equal(key, assign_cells(tokens)[0]) and torch.allclose(offset, assign_cells(tokens)[1], atol=1e-5)
    here, there = fused(InstanceFusion, tokens), fused(FastFusion, tokens)
    assert torch.allclose(here.merged_proposals, there.merged_proposals, atol=1e-5)
    assert torch.allclose(here.bev.features, there.bev.features, atol=1e-4)
