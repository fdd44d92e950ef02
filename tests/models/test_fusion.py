# SPDX-License-Identifier: Apache-2.0
"""Tokens of several agents in one frame: laws that hold whoever speaks first, wherever the world is."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Boxes, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import RAW, SPEED_UNIT, TYPICAL_SIZE, RawBoxes, RefineHead, axis_yaw, facing
from manyeyes.models.detector.proposal import PROPOSAL, proposed_velocity
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.flow_aware import FlowAwareFusion
from manyeyes.models.fusion.max_fusion import MaximumFusion
from manyeyes.models.fusion.positional_encoding import Placement
from manyeyes.models.fusion.self_attention import SelfAttentionFusion
from manyeyes.models.fusion.token_merge import VOTING_HEAT, settle
from manyeyes.models.fusion.transform_tokens import CUES, Part, Tokens, gather, rotate_vectors
from manyeyes.models.fusion.v2x_vit import V2xVitFusion

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
FUSIONS = ("maximum", "self_attention", "flow_aware", "v2x_vit")


def fusion(name: str, random_placement: bool = True) -> torch.nn.Module:
    torch.manual_seed(0)
    attention = AttentionConfig(heads=2)
    model = {
        "maximum": lambda: MaximumFusion(CHANNELS),
        "self_attention": lambda: SelfAttentionFusion(CHANNELS, attention),
        "flow_aware": lambda: FlowAwareFusion(CHANNELS, attention),
        "v2x_vit": lambda: V2xVitFusion(CHANNELS, attention),
    }[name]()
    if random_placement:
        torch.nn.init.normal_(model.placement.outer.weight, std=0.3)
        torch.nn.init.normal_(model.placement.temporal.weight, std=0.3)
    else:
        torch.nn.init.zeros_(model.settle.outer.weight)
    return model.eval().requires_grad_(False)


def told(seed: int, n: int = 60) -> SparseBev:
    """What an agent tells: features and, behind them, proposals."""
    random = torch.Generator().manual_seed(seed)
    rows, columns = GRID.shape
    key = torch.randperm(rows * columns, generator=random)[:n]
    yx = torch.stack((key // columns, key % columns), 1)
    return SparseBev.from_cells(torch.randn(n, CHANNELS + PROPOSAL, generator=random), yx, GRID)


def silent(x: SparseBev) -> SparseBev:
    """The same tokens, none of which believes in an object: they stay where they are."""
    features = x.features.clone()
    features[:, CHANNELS] = -9.0
    return x.with_features(features)


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
        parts.append(Part(ego, own.features, own.sites.xy, poses[0].inverse() @ at if i else None))
    return parts


def tokens_of(agents: list[int], world: Transform | None = None) -> Tokens:
    return gather(parts_of(agents, world), GRID, 1)


@pytest.mark.parametrize("name", FUSIONS)
def test_who_speaks_first_does_not_matter(name):
    model = fusion(name)
    a, b = model(tokens_of([0, 1, 2, 3])), model(tokens_of([0, 3, 1, 2]))
    assert torch.equal(a.bev.sites.key, b.bev.sites.key)
    assert torch.allclose(a.bev.features, b.bev.features, atol=1e-5)
    assert torch.allclose(a.given, b.given, atol=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
@pytest.mark.parametrize("agents", (1, 2, 3, 5))
def test_every_agent_adds_what_it_has(name, agents):
    tokens = tokens_of(list(range(agents)))
    out = fusion(name)(tokens)
    key, _ = settle(tokens)
    assert torch.equal(out.bev.sites.key, torch.unique(key)) and len(out.given) > 35 * agents**0.5
    assert bool(torch.isfinite(out.bev.features).all()) and bool(torch.isfinite(out.given).all())


@pytest.mark.parametrize("name", FUSIONS)
def test_an_agent_without_tokens_changes_nothing(name):
    model, none = fusion(name), told(9, n=0)
    own = told(0)
    alone = [Part(0, own.features, own.sites.xy)]
    with_silent = gather([*alone, Part(0, none.features, none.sites.xy, pose(3))], GRID, 1)
    assert torch.allclose(model(with_silent).bev.features, model(gather(alone, GRID, 1)).bev.features, atol=1e-6)
    assert len(model(gather([Part(0, none.features, none.sites.xy)], GRID, 1)).bev.sites) == 0


@pytest.mark.parametrize("name", FUSIONS)
def test_moving_the_whole_world_changes_nothing(name):
    model = fusion(name)
    world = Transform.from_xyz_yaw(4321.0, -987.0, 12.0, 2.5)
    here, there = model(tokens_of([0, 1, 2])), model(tokens_of([0, 1, 2], world))
    assert torch.equal(here.bev.sites.key, there.bev.sites.key)
    assert torch.allclose(here.bev.features, there.bev.features, atol=1e-4)
    assert torch.allclose(here.given, there.given, atol=1e-3)


def test_maximum_of_a_neighbour_shifted_by_whole_cells_is_the_dense_maximum():
    model, mine, theirs = fusion("maximum", random_placement=False), silent(told(0)), silent(told(1))
    shift = Transform.from_xyz_yaw(3 * GRID.cell, -2 * GRID.cell)
    parts = [Part(0, mine.features, mine.sites.xy), Part(0, theirs.features, theirs.sites.xy, shift)]
    out = model(gather(parts, GRID, 1)).bev

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
    parts = [Part(0, own.features, own.sites.xy), Part(0, own.features, own.sites.xy, far)]
    assert len(gather(parts, GRID, 1).features) == len(own.sites)


@pytest.mark.parametrize("name", FUSIONS)
def test_a_fresh_placement_says_nothing_and_a_trained_one_does(name):
    fresh, trained = fusion(name, random_placement=False), fusion(name)
    assert not fresh.placement.outer.weight.any()
    tokens = tokens_of([0, 1])
    blind = dataclasses.replace(tokens, cue=tokens.cue * 0)
    assert torch.equal(fresh(tokens).bev.features, fresh(blind).bev.features)
    assert not torch.allclose(trained(tokens).bev.features, trained(blind).bev.features, atol=1e-3)
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
    moved = gather([Part(0, features, own.sites.xy, ego_from_sender)], GRID, 1)
    there = ego_from_sender.apply(torch.tensor([[5.0, 3.0, 0.0]]).double())[0, :2].float()
    assert len(moved.features) > 30
    assert torch.allclose(moved.xy + moved.features[:, :2], there.expand(len(moved.xy), 2), atol=1e-4)


def test_cues_tell_height_turn_doubt_and_age_and_are_zero_for_the_ego():
    own, motion = silent(told(0)), Transform.from_xyz_yaw(0, 0, 1.5, 0.3)
    own.features[:, CHANNELS:][:, RAW.velocity] = 0.0
    theirs = Part(0, own.features, own.sites.xy, motion, age_s=0.25, doubt_xy_m=0.3, doubt_yaw_rad=0.01)
    tokens = gather([Part(0, own.features, own.sites.xy), theirs], GRID, 1)
    cue, n = tokens.cue, len(own.sites)
    assert cue.shape[1] == CUES and not cue[:n].any()
    wanted = torch.tensor([1.5, math.sin(0.3), math.cos(0.3) - 1]).expand(len(cue) - n, 3)
    assert torch.allclose(cue[n:, :3], wanted, atol=1e-6)
    assert torch.equal(tokens.age[n:], torch.full((len(cue) - n,), 2.5))
    # A claim's doubt in heading moves what is far from its sender more than what is near to it.
    reach = tokens.xy[n:].norm(dim=1)
    assert torch.allclose(tokens.doubt[n:], (0.3**2 + (0.01 * reach) ** 2).sqrt(), atol=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
def test_egos_of_a_batch_do_not_hear_each_other(name):
    model = fusion(name)
    together = model(gather([*parts_of([0, 1]), *parts_of([2, 3], ego=1)], GRID, 2))
    for b, alone in enumerate((model(tokens_of([0, 1])), model(tokens_of([2, 3])))):
        rows = together.bev.sites.batch == b
        assert torch.equal(together.bev.sites.yx[rows], alone.bev.sites.yx)
        assert torch.allclose(together.bev.features[rows], alone.bev.features, atol=1e-5)
        assert torch.allclose(together.given[rows], alone.given, atol=1e-5)


def boxes_of(proposal: Tensor, xy: Tensor) -> Boxes:
    size = proposal[:, RAW.log_size].exp() * torch.tensor(TYPICAL_SIZE)
    center = torch.cat((xy + proposal[:, RAW.offset] * GRID.cell, proposal[:, RAW.z]), 1)
    return Boxes.of(center, size, axis_yaw(proposal[:, RAW.axis]))


def test_a_proposed_box_moves_as_the_box_itself():
    own, motion = told(0), Transform.from_xyz_yaw(2.0, -1.0, 0.5, 2.1)
    moved = gather([Part(0, own.features, own.sites.xy, motion)], GRID, 1)
    before = boxes_of(own.features[:, CHANNELS:], own.sites.xy)
    at = motion.apply(torch.cat((own.sites.xy, torch.zeros(len(own.sites), 1)), 1).double())
    wanted = before[GRID.inside(at)].transform(motion)
    got = boxes_of(moved.proposal, moved.xy)
    assert len(got) == len(wanted) > 30
    assert torch.allclose(got.center, wanted.center, atol=1e-4) and torch.equal(got.size, wanted.size)
    assert torch.allclose((2 * (got.yaw - wanted.yaw)).cos(), torch.ones(len(got)), atol=1e-5)
    for same in (RAW.heat, RAW.kind, RAW.overlap):
        assert torch.equal(moved.proposal[:, same], own.features[GRID.inside(at)][:, CHANNELS:][:, same])
    velocity = SPEED_UNIT * own.features[GRID.inside(at)][:, CHANNELS:][:, RAW.velocity]
    turned = dataclasses.replace(wanted, velocity=velocity).transform(Transform.from_xyz_yaw(0, 0, 0, 2.1)).velocity
    assert torch.allclose(proposed_velocity(moved.proposal), turned, atol=1e-4)


def test_which_way_a_proposal_faces_turns_with_it():
    proposal, xy = torch.zeros(1, CHANNELS + PROPOSAL), torch.zeros(1, 2)
    box = proposal[:, CHANNELS:]
    box[:, RAW.axis] = torch.tensor([[math.cos(2 * 1.2), math.sin(2 * 1.2)]])
    box[:, RAW.direction] = 5 * torch.tensor([[math.cos(1.2), math.sin(1.2)]])
    for turn in (0.3, 1.0, 2.5, -2.0):
        moved = gather([Part(0, proposal, xy, Transform.from_xyz_yaw(0.0, 0.0, 0.0, turn))], GRID, 1)
        raw = RawBoxes.of(moved.proposal, Sites(torch.tensor([0]), GRID, 1))
        yaw = float(axis_yaw(raw.axis)) + math.pi * (float(facing(raw)) < 0)
        assert math.cos(yaw - 1.2 - turn) == pytest.approx(1.0, abs=1e-5)


def one_object(*said: tuple[float, float, float, float]) -> Tokens:
    """Tokens at (x, y) of as many agents, each saying with a heat that there is a box at (centre, y)."""
    parts = []
    for x, y, centre, heat in said:
        row = torch.zeros(1, CHANNELS + PROPOSAL)
        box = row[:, CHANNELS:]
        box[:, RAW.heat] = heat
        box[:, RAW.offset] = torch.tensor([[centre - x, 0.0]]) / GRID.cell
        box[:, RAW.axis] = torch.tensor([[1.0, 0.0]])
        parts.append(Part(0, row, torch.tensor([[x, y]]), None))
    return gather(parts, GRID, 1)


@pytest.mark.parametrize("name", FUSIONS)
def test_tokens_of_one_object_meet_on_its_centre_and_the_surer_counts_more(name):
    # Cells are 1.6 m wide with centres at 0.2 + 1.6 k: the tokens lie in two cells, both mean the cell of x = 0.2.
    tokens = one_object((0.2, 0.2, 0.5, 2.0), (1.8, 0.2, 0.8, 0.0))
    out = fusion(name, random_placement=False)(tokens)
    assert len(out.bev.sites) == 1
    assert out.bev.sites.xy[0].tolist() == pytest.approx([0.2, 0.2], abs=1e-5)
    share = math.exp(2.0) / (math.exp(2.0) + 1.0)
    box = boxes_of(out.given, out.bev.sites.xy)
    assert float(box.center[0, 0]) == pytest.approx(0.5 * share + 0.8 * (1 - share), abs=1e-5)
    assert float(out.given[0, 0]) == pytest.approx(2.0 * share, abs=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
def test_a_token_that_does_not_believe_stays_where_it_is(name):
    tokens = one_object((0.2, 0.2, 0.5, 2.0), (1.8, 0.2, 0.8, VOTING_HEAT - 0.1))
    assert len(fusion(name)(tokens).bev.sites) == 2


@pytest.mark.parametrize("name", FUSIONS)
def test_an_untrained_second_look_changes_nothing_and_a_trained_one_does(name):
    fused = fusion(name)(tokens_of([0, 1, 2]))
    torch.manual_seed(1)
    head = RefineHead(CHANNELS, 8).eval().requires_grad_(False)
    assert torch.equal(head(fused.bev, fused.given).columns(), fused.given)
    torch.nn.init.normal_(head.out.weight)
    assert not torch.allclose(head(fused.bev, fused.given).columns(), fused.given, atol=1e-2)
