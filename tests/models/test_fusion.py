# SPDX-License-Identifier: Apache-2.0
"""Fusion in one frame: invariance to the order of agents and to the world's frame."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, Sites, SparseBev, Transform
from manyeyes.models.detector.box_head import (
    BOX_LAYOUT,
    SPEED_UNIT,
    TYPICAL_SIZE,
    RawBoxes,
    RefineHead,
    axis_yaw,
    heading_logit,
)
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_velocity
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import get_fusion, list_fusion_modules, register_fusion
from manyeyes.models.fusion.token_merge import MIN_VOTE_LOGIT, assign_cells
from manyeyes.models.fusion.transform_tokens import POSE_CONTEXT_DIM, AgentTokens, Tokens, rotate_vectors, to_ego_frame

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
FUSIONS = ("max", "self-attention", "fast", "v2x-vit")


def fusion(name: str, random_placement: bool = True) -> torch.nn.Module:
    torch.manual_seed(0)
    model = get_fusion(name)(CHANNELS, AttentionConfig(heads=2))
    if random_placement:
        torch.nn.init.normal_(model.encoding.outer.weight, std=0.3)
        torch.nn.init.normal_(model.encoding.temporal.weight, std=0.3)
    else:
        torch.nn.init.zeros_(model.merge.outer.weight)
    return model.eval().requires_grad_(False)


def random_tokens(seed: int, n: int = 60) -> SparseBev:
    """Shared tokens of an agent: features and proposals."""
    random = torch.Generator().manual_seed(seed)
    rows, columns = GRID.shape
    key = torch.randperm(rows * columns, generator=random)[:n]
    yx = torch.stack((key // columns, key % columns), 1)
    return SparseBev.from_cells(torch.randn(n, CHANNELS + PROPOSAL_DIM, generator=random), yx, GRID)


def silent(x: SparseBev) -> SparseBev:
    """The same tokens with low heatmap logits, so that they stay in their cells."""
    features = x.features.clone()
    features[:, CHANNELS] = -9.0
    return x.with_features(features)


def pose(seed: int) -> Transform:
    x, y, z, yaw = (torch.rand(4, generator=torch.Generator().manual_seed(seed)) * 2 - 1).tolist()
    return Transform.from_xyz_yaw(12 * x, 12 * y, z, math.pi * yaw)


def parts_of(agents: list[int], world: Transform | None = None, ego: int = 0) -> list[AgentTokens]:
    """The ego is the first; each agent has a map and a pose of its own."""
    world = world or Transform.identity()
    poses = [world @ pose(100 + a) for a in agents]
    parts: list[AgentTokens] = []
    for i, (agent, at) in enumerate(zip(agents, poses)):
        own = random_tokens(agent)
        parts.append(AgentTokens(ego, own.features, own.sites.xy, poses[0].inverse() @ at if i else None))
    return parts


def tokens_of(agents: list[int], world: Transform | None = None) -> Tokens:
    return to_ego_frame(parts_of(agents, world), GRID, 1)


@pytest.mark.parametrize("name", FUSIONS)
def test_fusion_is_invariant_to_agent_order(name):
    model = fusion(name)
    a, b = model(tokens_of([0, 1, 2, 3])), model(tokens_of([0, 3, 1, 2]))
    assert torch.equal(a.bev.sites.key, b.bev.sites.key)
    assert torch.allclose(a.bev.features, b.bev.features, atol=1e-5)
    assert torch.allclose(a.merged_proposals, b.merged_proposals, atol=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
@pytest.mark.parametrize("agents", (1, 2, 3, 5))
def test_every_agent_contributes_its_tokens(name, agents):
    tokens = tokens_of(list(range(agents)))
    out = fusion(name)(tokens)
    key, _ = assign_cells(tokens)
    assert torch.equal(out.bev.sites.key, torch.unique(key)) and len(out.merged_proposals) > 35 * agents**0.5
    assert bool(torch.isfinite(out.bev.features).all()) and bool(torch.isfinite(out.merged_proposals).all())


@pytest.mark.parametrize("name", FUSIONS)
def test_an_agent_without_tokens_changes_nothing(name):
    model, none = fusion(name), random_tokens(9, n=0)
    own = random_tokens(0)
    alone = [AgentTokens(0, own.features, own.sites.xy)]
    with_silent = to_ego_frame([*alone, AgentTokens(0, none.features, none.sites.xy, pose(3))], GRID, 1)
    assert torch.allclose(model(with_silent).bev.features, model(to_ego_frame(alone, GRID, 1)).bev.features, atol=1e-6)
    assert len(model(to_ego_frame([AgentTokens(0, none.features, none.sites.xy)], GRID, 1)).bev.sites) == 0


@pytest.mark.parametrize("name", FUSIONS)
def test_fusion_is_invariant_to_world_motion(name):
    model = fusion(name)
    world = Transform.from_xyz_yaw(4321.0, -987.0, 12.0, 2.5)
    here, there = model(tokens_of([0, 1, 2])), model(tokens_of([0, 1, 2], world))
    assert torch.equal(here.bev.sites.key, there.bev.sites.key)
    assert torch.allclose(here.bev.features, there.bev.features, atol=1e-4)
    assert torch.allclose(here.merged_proposals, there.merged_proposals, atol=1e-3)


def test_maximum_of_a_neighbour_shifted_by_whole_cells_is_the_dense_maximum():
    model, mine, theirs = fusion("max", random_placement=False), silent(random_tokens(0)), silent(random_tokens(1))
    shift = Transform.from_xyz_yaw(3 * GRID.cell_size_m, -2 * GRID.cell_size_m)
    parts = [AgentTokens(0, mine.features, mine.sites.xy), AgentTokens(0, theirs.features, theirs.sites.xy, shift)]
    out = model(to_ego_frame(parts, GRID, 1)).bev

    def dense(x: SparseBev) -> Tensor:
        image = torch.full((CHANNELS, *GRID.shape), -torch.inf)
        image[:, x.sites.yx[:, 0], x.sites.yx[:, 1]] = x.features[:, :CHANNELS].T
        return image

    moved = torch.full((CHANNELS, *GRID.shape), -torch.inf)
    moved[:, :-2, 3:] = dense(theirs)[:, 2:, :-3]
    assert torch.equal(dense(out), torch.maximum(dense(mine), moved))


def test_tokens_beyond_the_range_are_dropped():
    own = random_tokens(0)
    far = Transform.from_xyz_yaw(200.0, 0.0)
    parts = [AgentTokens(0, own.features, own.sites.xy), AgentTokens(0, own.features, own.sites.xy, far)]
    assert len(to_ego_frame(parts, GRID, 1).features) == len(own.sites)


@pytest.mark.parametrize("name", FUSIONS)
def test_untrained_encoding_is_identity_and_trained_one_is_not(name):
    fresh, trained = fusion(name, random_placement=False), fusion(name)
    assert not fresh.encoding.outer.weight.any()
    tokens = tokens_of([0, 1])
    blind = dataclasses.replace(tokens, pose_context=tokens.pose_context * 0)
    assert torch.equal(fresh(tokens).bev.features, fresh(blind).bev.features)
    assert not torch.allclose(trained(tokens).bev.features, trained(blind).bev.features, atol=1e-3)
    zeros = torch.zeros(len(tokens.xy), 2)
    assert torch.equal(SpatioTemporalEncoding(CHANNELS)(tokens.features, tokens, zeros), tokens.features)


def test_rotation_and_inverse_restore_features():
    features = torch.randn(20, CHANNELS, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    yaw = torch.tensor(0.7, dtype=torch.float64)
    turned = rotate_vectors(features, yaw)
    assert torch.allclose(rotate_vectors(turned, -yaw), features, atol=1e-12)
    assert torch.equal(turned[:, CHANNELS // 2 :], features[:, CHANNELS // 2 :])
    assert not torch.allclose(turned[:, : CHANNELS // 2], features[:, : CHANNELS // 2])
    norms = [f[:, : CHANNELS // 2].view(20, -1, 2).norm(dim=-1) for f in (features, turned)]
    assert torch.allclose(*norms, atol=1e-12)


def test_vector_channels_rotate_with_the_object():
    # Each token carries, as its first vector, the way to a landmark; after the move it must still point there.
    own, landmark = random_tokens(0), torch.tensor([5.0, 3.0])
    features = own.features.clone()
    features[:, :2] = landmark - own.sites.xy
    ego_from_sender = Transform.from_xyz_yaw(2.0, -1.0, 0.5, 2.1)
    moved = to_ego_frame([AgentTokens(0, features, own.sites.xy, ego_from_sender)], GRID, 1)
    there = ego_from_sender.apply(torch.tensor([[5.0, 3.0, 0.0]]).double())[0, :2].float()
    assert len(moved.features) > 30
    assert torch.allclose(moved.xy + moved.features[:, :2], there.expand(len(moved.xy), 2), atol=1e-4)


def test_pose_context_holds_height_yaw_sigma_and_age_and_is_zero_for_the_ego():
    own, motion = silent(random_tokens(0)), Transform.from_xyz_yaw(0, 0, 1.5, 0.3)
    own.features[:, CHANNELS:][:, BOX_LAYOUT.velocity] = 0.0
    theirs = AgentTokens(0, own.features, own.sites.xy, motion, age_s=0.25, sigma_xy_m=0.3, sigma_yaw_rad=0.01)
    tokens = to_ego_frame([AgentTokens(0, own.features, own.sites.xy), theirs], GRID, 1)
    pose_context, n = tokens.pose_context, len(own.sites)
    assert pose_context.shape[1] == POSE_CONTEXT_DIM and not pose_context[:n].any()
    wanted = torch.tensor([1.5, math.sin(0.3), math.cos(0.3) - 1]).expand(len(pose_context) - n, 3)
    assert torch.allclose(pose_context[n:, :3], wanted, atol=1e-6)
    assert torch.equal(tokens.age[n:], torch.full((len(pose_context) - n,), 2.5))
    # A heading error moves tokens far from their sender more than near ones.
    reach = tokens.xy[n:].norm(dim=1)
    assert torch.allclose(tokens.sigma_m[n:], (0.3**2 + (0.01 * reach) ** 2).sqrt(), atol=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
def test_egos_of_a_batch_are_independent(name):
    model = fusion(name)
    together = model(to_ego_frame([*parts_of([0, 1]), *parts_of([2, 3], ego=1)], GRID, 2))
    for b, alone in enumerate((model(tokens_of([0, 1])), model(tokens_of([2, 3])))):
        rows = together.bev.sites.batch == b
        assert torch.equal(together.bev.sites.yx[rows], alone.bev.sites.yx)
        assert torch.allclose(together.bev.features[rows], alone.bev.features, atol=1e-5)
        assert torch.allclose(together.merged_proposals[rows], alone.merged_proposals, atol=1e-5)


def boxes_of(proposal: Tensor, xy: Tensor) -> Boxes:
    size = proposal[:, BOX_LAYOUT.log_size].exp() * torch.tensor(TYPICAL_SIZE)
    center = torch.cat((xy + proposal[:, BOX_LAYOUT.offset] * GRID.cell_size_m, proposal[:, BOX_LAYOUT.z]), 1)
    return Boxes.of(center, size, axis_yaw(proposal[:, BOX_LAYOUT.axis]))


def test_a_proposed_box_moves_as_the_box_itself():
    own, motion = random_tokens(0), Transform.from_xyz_yaw(2.0, -1.0, 0.5, 2.1)
    moved = to_ego_frame([AgentTokens(0, own.features, own.sites.xy, motion)], GRID, 1)
    before = boxes_of(own.features[:, CHANNELS:], own.sites.xy)
    at = motion.apply(torch.cat((own.sites.xy, torch.zeros(len(own.sites), 1)), 1).double())
    wanted = before[GRID.contains(at)].transform(motion)
    got = boxes_of(moved.proposal, moved.xy)
    assert len(got) == len(wanted) > 30
    assert torch.allclose(got.center, wanted.center, atol=1e-4) and torch.equal(got.size, wanted.size)
    assert torch.allclose((2 * (got.yaw - wanted.yaw)).cos(), torch.ones(len(got)), atol=1e-5)
    for same in (BOX_LAYOUT.heatmap_logit, BOX_LAYOUT.class_logits, BOX_LAYOUT.iou_logit):
        assert torch.equal(moved.proposal[:, same], own.features[GRID.contains(at)][:, CHANNELS:][:, same])
    velocity = SPEED_UNIT * own.features[GRID.contains(at)][:, CHANNELS:][:, BOX_LAYOUT.velocity]
    turned = dataclasses.replace(wanted, velocity=velocity).transform(Transform.from_xyz_yaw(0, 0, 0, 2.1)).velocity
    assert torch.allclose(proposed_velocity(moved.proposal), turned, atol=1e-4)


def test_proposed_heading_rotates_with_the_frame():
    proposal, xy = torch.zeros(1, CHANNELS + PROPOSAL_DIM), torch.zeros(1, 2)
    box = proposal[:, CHANNELS:]
    box[:, BOX_LAYOUT.axis] = torch.tensor([[math.cos(2 * 1.2), math.sin(2 * 1.2)]])
    box[:, BOX_LAYOUT.direction] = 5 * torch.tensor([[math.cos(1.2), math.sin(1.2)]])
    for turn in (0.3, 1.0, 2.5, -2.0):
        moved = to_ego_frame([AgentTokens(0, proposal, xy, Transform.from_xyz_yaw(0.0, 0.0, 0.0, turn))], GRID, 1)
        raw = RawBoxes.of(moved.proposal, Sites(torch.tensor([0]), GRID, 1))
        yaw = float(axis_yaw(raw.axis)) + math.pi * (float(heading_logit(raw)) < 0)
        assert math.cos(yaw - 1.2 - turn) == pytest.approx(1.0, abs=1e-5)


def one_object(*observations: tuple[float, float, float, float]) -> Tokens:
    """Tokens at (x, y), one per agent, each proposing a box at (centre, y) with a heatmap logit."""
    parts = []
    for x, y, centre, heat in observations:
        row = torch.zeros(1, CHANNELS + PROPOSAL_DIM)
        box = row[:, CHANNELS:]
        box[:, BOX_LAYOUT.heatmap_logit] = heat
        box[:, BOX_LAYOUT.offset] = torch.tensor([[centre - x, 0.0]]) / GRID.cell_size_m
        box[:, BOX_LAYOUT.axis] = torch.tensor([[1.0, 0.0]])
        parts.append(AgentTokens(0, row, torch.tensor([[x, y]]), None))
    return to_ego_frame(parts, GRID, 1)


@pytest.mark.parametrize("name", FUSIONS)
def test_tokens_of_one_object_merge_at_its_centre_weighted_by_score(name):
    # Cells are 1.6 m wide with centres at 0.2 + 1.6 k: the tokens lie in two cells, both mean the cell of x = 0.2.
    tokens = one_object((0.2, 0.2, 0.5, 2.0), (1.8, 0.2, 0.8, 0.0))
    out = fusion(name, random_placement=False)(tokens)
    assert len(out.bev.sites) == 1
    assert out.bev.sites.xy[0].tolist() == pytest.approx([0.2, 0.2], abs=1e-5)
    share = math.exp(2.0) / (math.exp(2.0) + 1.0)
    box = boxes_of(out.merged_proposals, out.bev.sites.xy)
    assert float(box.center[0, 0]) == pytest.approx(0.5 * share + 0.8 * (1 - share), abs=1e-5)
    assert float(out.merged_proposals[0, 0]) == pytest.approx(2.0 * share, abs=1e-5)


@pytest.mark.parametrize("name", FUSIONS)
def test_token_below_vote_logit_stays_in_its_cell(name):
    tokens = one_object((0.2, 0.2, 0.5, 2.0), (1.8, 0.2, 0.8, MIN_VOTE_LOGIT - 0.1))
    assert len(fusion(name)(tokens).bev.sites) == 2


@pytest.mark.parametrize("name", FUSIONS)
def test_untrained_refinement_is_identity_and_trained_one_is_not(name):
    fused = fusion(name)(tokens_of([0, 1, 2]))
    torch.manual_seed(1)
    head = RefineHead(CHANNELS, 8).eval().requires_grad_(False)
    assert torch.equal(head(fused.bev, fused.merged_proposals).to_rows(), fused.merged_proposals)
    torch.nn.init.normal_(head.out.weight)
    assert not torch.allclose(head(fused.bev, fused.merged_proposals).to_rows(), fused.merged_proposals, atol=1e-2)


def test_fusion_modules_are_registered_each_in_its_own_file():
    assert {*FUSIONS, "multi-scale"} <= set(list_fusion_modules())


def test_a_registered_fusion_module_is_built_by_name():
    @register_fusion("own-mean")
    class OwnFusion(torch.nn.Module):
        def __init__(self, channels: int, attention: AttentionConfig) -> None:
            super().__init__()
            self.channels, self.attention = channels, attention

    detector = Detector(dataclasses.replace(COSTR_TINY, fusion="own-mean"))
    assert isinstance(detector.fusion, OwnFusion) and detector.fusion.attention == COSTR_TINY.fusion_attention


def test_an_unknown_fusion_module_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"No fusion module is called 'telepathy'; known: .*max, .*multi-scale"):
        Detector(dataclasses.replace(COSTR_TINY, fusion="telepathy"))
