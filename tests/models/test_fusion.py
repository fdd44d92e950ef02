# SPDX-License-Identifier: Apache-2.0
"""Tokens of several agents in one frame: laws that hold whoever speaks first, wherever the world is."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Boxes, SparseBev, Transform
from manyeyes.models.box_head import TYPICAL_SIZE, axis_yaw
from manyeyes.models.fusion.gather import CUES, Tokens, gather, own_tokens, rotate_vectors, to_lattice
from manyeyes.models.fusion.maximum import MaximumFusion, Placement
from manyeyes.models.fusion.self_attention import SelfAttentionFusion
from manyeyes.models.proposal import PROPOSAL
from manyeyes.models.transformer import AttentionConfig

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
FUSIONS = ("maximum", "self_attention")
Part = tuple[int, Tensor, Tensor, Transform | None]


def fusion(name: str, random_placement: bool = True) -> torch.nn.Module:
    torch.manual_seed(0)
    model = MaximumFusion(CHANNELS) if name == "maximum" else SelfAttentionFusion(CHANNELS, AttentionConfig(heads=2))
    if random_placement:
        torch.nn.init.normal_(model.placement.outer.weight, std=0.3)
    return model.eval().requires_grad_(False)


def told(seed: int, n: int = 60) -> SparseBev:
    """What an agent tells: features and, behind them, proposals."""
    random = torch.Generator().manual_seed(seed)
    rows, columns = GRID.shape
    key = torch.randperm(rows * columns, generator=random)[:n]
    yx = torch.stack((key // columns, key % columns), 1)
    return SparseBev.from_cells(torch.randn(n, CHANNELS + PROPOSAL, generator=random), yx, GRID)


def pose(seed: int) -> Transform:
    x, y, z, yaw = (torch.rand(4, generator=torch.Generator().manual_seed(seed)) * 2 - 1).tolist()
    return Transform.from_xyz_yaw(12 * x, 12 * y, z, math.pi * yaw)


def parts_of(agents: list[int], world: Transform | None = None, ego: int = 0) -> list[Part]:
    """The ego is the first; each agent has a map and a pose of its own."""
    world = world or Transform.identity()
    poses = [world @ pose(100 + a) for a in agents]
    parts: list[Part] = []
    for i, (agent, at) in enumerate(zip(agents, poses)):
        own = told(agent)
        parts.append((ego, own.features, own.sites.xy, poses[0].inverse() @ at if i else None))
    return parts


def tokens_of(agents: list[int], world: Transform | None = None) -> Tokens:
    return gather(parts_of(agents, world), GRID, 1)


@pytest.mark.parametrize("name", FUSIONS)
def test_who_speaks_first_does_not_matter(name):
    model = fusion(name)
    a, b = model(tokens_of([0, 1, 2, 3])), model(tokens_of([0, 3, 1, 2]))
    assert torch.equal(a.sites.key, b.sites.key)
    assert torch.allclose(a.features, b.features, atol=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
@pytest.mark.parametrize("agents", (1, 2, 3, 5))
def test_every_agent_adds_what_it_has(name, agents):
    tokens = tokens_of(list(range(agents)))
    out = fusion(name)(tokens)
    cells = GRID.cells(tokens.xy)
    assert len(out.sites) == len(torch.unique(cells, dim=0)) > 40 * agents**0.5
    assert bool(torch.isfinite(out.features).all())


@pytest.mark.parametrize("name", FUSIONS)
def test_an_agent_without_tokens_changes_nothing(name):
    model, none = fusion(name), told(9, n=0)
    own = told(0)
    alone = [(0, own.features, own.sites.xy, None)]
    with_silent = gather([*alone, (0, none.features, none.sites.xy, pose(3))], GRID, 1)
    assert torch.allclose(model(with_silent).features, model(gather(alone, GRID, 1)).features, atol=1e-6)
    assert len(model(gather([(0, none.features, none.sites.xy, None)], GRID, 1)).sites) == 0


@pytest.mark.parametrize("name", FUSIONS)
def test_moving_the_whole_world_changes_nothing(name):
    model = fusion(name)
    world = Transform.from_xyz_yaw(4321.0, -987.0, 12.0, 2.5)
    here, there = model(tokens_of([0, 1, 2])), model(tokens_of([0, 1, 2], world))
    assert torch.equal(here.sites.key, there.sites.key)
    assert torch.allclose(here.features, there.features, atol=1e-4)


def test_maximum_of_a_neighbour_shifted_by_whole_cells_is_the_dense_maximum():
    model, mine, theirs = fusion("maximum", random_placement=False), told(0), told(1)
    shift = Transform.from_xyz_yaw(3 * GRID.cell, -2 * GRID.cell)
    parts = [(0, mine.features, mine.sites.xy, None), (0, theirs.features, theirs.sites.xy, shift)]
    out = model(gather(parts, GRID, 1))

    def dense(x: SparseBev) -> Tensor:
        image = torch.full((CHANNELS, *GRID.shape), -torch.inf)
        image[:, x.sites.yx[:, 0], x.sites.yx[:, 1]] = x.features[:, :CHANNELS].T
        return image

    moved = torch.full((CHANNELS, *GRID.shape), -torch.inf)
    moved[:, :-2, 3:] = dense(theirs)[:, 2:, :-3]
    assert torch.equal(dense(out), torch.maximum(dense(mine), moved))


def test_a_neighbour_beyond_the_range_is_not_heard():
    own = told(0)
    far = Transform.from_xyz_yaw(200.0, 0.0)
    parts = [(0, own.features, own.sites.xy, None), (0, own.features, own.sites.xy, far)]
    assert len(gather(parts, GRID, 1).features) == len(own.sites)


@pytest.mark.parametrize("name", FUSIONS)
def test_zero_placement_is_the_literal_paper_and_starts_so(name):
    fresh, trained = fusion(name, random_placement=False), fusion(name)
    assert not fresh.placement.outer.weight.any()
    tokens = tokens_of([0, 1])
    assert torch.equal(fresh(tokens).features, fresh(dataclasses.replace(tokens, cue=tokens.cue * 0)).features)
    for field in ("cue", "proposal"):
        blind = dataclasses.replace(tokens, **{field: torch.zeros_like(getattr(tokens, field))})
        assert torch.equal(fresh(tokens).features, fresh(blind).features)
        assert not torch.allclose(trained(tokens).features, trained(blind).features, atol=1e-3)
    zeros = torch.zeros(len(tokens.xy), 2)
    assert torch.equal(Placement(CHANNELS)(tokens.features, tokens, zeros), tokens.features)


def test_turning_and_turning_back_is_nothing():
    features = torch.randn(20, CHANNELS, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    yaw = torch.tensor(0.7, dtype=torch.float64)
    turned = rotate_vectors(features, yaw)
    assert torch.allclose(rotate_vectors(turned, -yaw), features, atol=1e-12)
    assert torch.equal(turned[:, CHANNELS // 2 :], features[:, CHANNELS // 2 :])
    assert not torch.allclose(turned[:, : CHANNELS // 2], features[:, : CHANNELS // 2])
    norms = [f[:, : CHANNELS // 2].view(20, -1, 2).norm(dim=-1) for f in (features, turned)]
    assert torch.allclose(*norms, atol=1e-12)


def test_a_direction_in_a_token_turns_as_the_thing_itself():
    # Each token carries, as its first vector, the way to a landmark; after the move it must still point there.
    own, landmark = told(0), torch.tensor([5.0, 3.0])
    features = own.features.clone()
    features[:, :2] = landmark - own.sites.xy
    ego_from_sender = Transform.from_xyz_yaw(2.0, -1.0, 0.5, 2.1)
    moved = gather([(0, features, own.sites.xy, ego_from_sender)], GRID, 1)
    there = ego_from_sender.apply(torch.tensor([[5.0, 3.0, 0.0]]).double())[0, :2].float()
    assert len(moved.features) > 30
    assert torch.allclose(moved.xy + moved.features[:, :2], there.expand(len(moved.xy), 2), atol=1e-4)


def test_cues_tell_height_and_turn_and_are_zero_for_the_ego():
    own = told(0)
    parts = [
        (0, own.features, own.sites.xy, None),
        (0, own.features, own.sites.xy, Transform.from_xyz_yaw(0, 0, 1.5, 0.3)),
    ]
    cue = gather(parts, GRID, 1).cue
    assert cue.shape[1] == CUES and not cue[: len(own.sites)].any()
    wanted = torch.tensor([1.5, math.sin(0.3), math.cos(0.3) - 1])
    assert torch.allclose(cue[len(own.sites) :], wanted.expand(len(cue) - len(own.sites), 3), atol=1e-6)


@pytest.mark.parametrize("name", FUSIONS)
def test_egos_of_a_batch_do_not_hear_each_other(name):
    model = fusion(name)
    together = model(gather([*parts_of([0, 1]), *parts_of([2, 3], ego=1)], GRID, 2))
    for b, alone in enumerate((model(tokens_of([0, 1])), model(tokens_of([2, 3])))):
        rows = together.sites.batch == b
        assert torch.equal(together.sites.yx[rows], alone.sites.yx)
        assert torch.allclose(together.features[rows], alone.features, atol=1e-5)


def test_own_tokens_are_the_grids_of_a_batch_and_propose_nothing():
    own = told(0)
    seen = own.with_features(own.features[:, :CHANNELS])
    tokens = own_tokens(seen)
    assert tokens.batch_size == 1 and not tokens.cue.any() and not tokens.proposal.any()
    assert torch.equal(to_lattice(tokens.features, own.sites.key, tokens, "mean").features, seen.features)


def test_a_proposed_box_moves_as_the_box_itself():
    own, motion = told(0), Transform.from_xyz_yaw(2.0, -1.0, 0.5, 2.1)

    def boxes(proposal: Tensor, xy: Tensor) -> Boxes:
        size = torch.cat((proposal[:, 4:6], torch.zeros(len(xy), 1)), 1).exp() * torch.tensor(TYPICAL_SIZE)
        center = torch.cat((xy + proposal[:, 1:3] * GRID.cell, proposal[:, 3:4]), 1)
        return Boxes.of(center, size, axis_yaw(proposal[:, 6:8]))

    moved = gather([(0, own.features, own.sites.xy, motion)], GRID, 1)
    before = boxes(own.features[:, CHANNELS:], own.sites.xy)
    at = motion.apply(torch.cat((own.sites.xy, torch.zeros(len(own.sites), 1)), 1).double())
    wanted = before[GRID.inside(at)].transform(motion)
    got = boxes(moved.proposal, moved.xy)
    assert len(got) == len(wanted) > 30
    assert torch.allclose(got.center, wanted.center, atol=1e-4) and torch.equal(got.size, wanted.size)
    assert torch.allclose((2 * (got.yaw - wanted.yaw)).cos(), torch.ones(len(got)), atol=1e-5)
    assert torch.equal(moved.proposal[:, 0], own.features[GRID.inside(at), CHANNELS])
