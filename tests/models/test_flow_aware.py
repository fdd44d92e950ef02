# SPDX-License-Identifier: Apache-2.0
"""FAST: encoding of time and sender, attention to the ego's past, and their invariances."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.flow_aware import FastFusion, PastAttention
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding, temporal_encoding
from manyeyes.models.fusion.self_attention import SelfAttentionFusion
from manyeyes.models.fusion.token_merge import DRIFT_MPS, assign_cells
from manyeyes.models.fusion.transform_tokens import MAX_SPEED_MPS, AgentTokens, Tokens, to_ego_frame
from manyeyes.ops.window_attention import sincos_encoding, window_ids, window_offsets

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
CONFIG = AttentionConfig(heads=2)
EDGE, ORIGIN = 8 * GRID.cell_size_m, (GRID.x_min, GRID.y_min)


def random_tokens(seed: int, n: int = 60) -> SparseBev:
    random = torch.Generator().manual_seed(seed)
    key = torch.randperm(GRID.shape[0] * GRID.shape[1], generator=random)[:n]
    rows = torch.randn(n, CHANNELS + PROPOSAL_DIM, generator=random)
    rows[:, CHANNELS:][:, BOX_LAYOUT.velocity] = 0.0
    return SparseBev.from_cells(rows, torch.stack((key // GRID.shape[1], key % GRID.shape[1]), 1), GRID)


def own(seed: int = 0, n: int = 60) -> Tokens:
    some = random_tokens(seed, n)
    return to_ego_frame([AgentTokens(0, some.features, some.sites.xy)], GRID, 1)


def past(seed: int = 7, n: int = 60, x: float = -0.8, age_s: float = 0.1) -> Tokens:
    """The ego's tokens of an earlier instant, moved by its ego-motion."""
    some = random_tokens(seed, n)
    return to_ego_frame([AgentTokens(0, some.features, some.sites.xy, Transform.from_xyz_yaw(x, 0.0), age_s)], GRID, 1)


def attention() -> PastAttention:
    torch.manual_seed(0)
    model = PastAttention(CHANNELS, CONFIG)
    for p in (model.out.weight, model.ffn[2].weight, model.ffn[2].bias):
        torch.nn.init.normal_(p, std=0.5)
    return model.eval()


# Eq. 9: when.


def test_encoding_of_zero_age_is_zero():
    assert not temporal_encoding(torch.zeros(3), 16).any()


def test_temporal_encoding_by_its_formula():
    # Channels come in pairs of one frequency: the exponent is floor(k / 2), not k, so that half of them are no constants.
    age = torch.tensor([1.0, 2.5], dtype=torch.float64)
    wanted = [
        [f(a * 10000.0 ** (-2 * (k // 2) / 16)) - (k % 2) for k in range(16) for f in ((math.sin, math.cos)[k % 2],)]
        for a in age.tolist()
    ]
    assert torch.allclose(temporal_encoding(age, 16), torch.tensor(wanted).double(), atol=1e-12)
    assert 10000.0 ** (-2 * 7 / 16) > 1e-4


def test_every_tenth_of_a_second_has_distinct_encoding():
    """A9: in units of 100 ms; in seconds the same steps would hardly differ."""
    codes = temporal_encoding(torch.arange(5.0), 64)
    apart = torch.cdist(codes, codes) + 9 * torch.eye(5)
    assert float(apart.min()) > 1.0
    assert float(torch.pdist(temporal_encoding(torch.arange(5.0) / 10, 64)).min()) < 0.3


def test_untrained_encoding_is_zero():
    """The untrained encoding of frame, sigma, age and proposal is zero."""
    tokens = past(age_s=0.3)
    tokens = dataclasses.replace(tokens, pose_context=torch.randn_like(tokens.pose_context))
    placed = SpatioTemporalEncoding(CHANNELS)(tokens.features, tokens, torch.rand(len(tokens.xy), 2))
    assert torch.equal(placed, tokens.features)


def test_trained_encoding_separates_ages():
    placement, tokens = SpatioTemporalEncoding(CHANNELS), past(age_s=0.1)
    torch.nn.init.normal_(placement.temporal.weight)
    older = dataclasses.replace(tokens, pose_context=tokens.pose_context.index_fill(1, torch.tensor([4]), 3.0))
    place = torch.zeros(len(tokens.xy), 2)
    one, other = (placement(t.features, t, place) for t in (tokens, older))
    wanted = placement.temporal(temporal_encoding(torch.tensor([3.0, 1.0]), CHANNELS))
    assert torch.allclose(other - one, (wanted[0] - wanted[1]).expand_as(one), atol=1e-5)


# The past.


def slow(model: PastAttention, features: Tensor, tokens: Tokens, remembered: Tensor, before: Tokens) -> Tensor:
    """A loop over tokens: attention to the past of the same window, and where there is none, nothing."""
    ids = [window_ids(t.xy, t.ego, ORIGIN, EDGE) for t in (tokens, before)]
    here, there = (
        sincos_encoding(window_offsets(t.xy, ORIGIN, EDGE, GRID.cell_size_m), CHANNELS) for t in (tokens, before)
    )
    query = model.query(model.norm(features) + here)
    known = model.norm_past(remembered)
    key, value, out = model.key(known + there), model.value(known), features.clone()
    for i in range(len(features)):
        near = ids[1] == ids[0][i]
        if not near.any():
            continue
        heads = []
        for h in range(model.heads):
            part = slice(h * CHANNELS // model.heads, (h + 1) * CHANNELS // model.heads)
            weight = (key[near][:, part] @ query[i, part] / math.sqrt(CHANNELS // model.heads)).softmax(0)
            heads.append(weight @ value[near][:, part])
        some = features[i] + model.out(torch.cat(heads))
        out[i] = some + model.ffn(model.norm_ffn(some))
    return out


def test_past_attention_equals_a_loop_over_tokens_in_values_and_gradients():
    model, tokens, before = attention(), own(), past(n=30)
    results = []
    for way in (model, lambda *a: slow(model, *a)):
        x, y = (t.features.clone().requires_grad_() for t in (tokens, before))
        out = way(x, tokens, y, before)
        (out * torch.linspace(-1, 1, CHANNELS)).sum().backward()
        results.append((out.detach(), x.grad, y.grad))
    for a, b in zip(*results):
        assert torch.allclose(a, b, atol=1e-5) and bool(torch.isfinite(a).all())
    assert not torch.allclose(results[0][0], tokens.features, atol=1e-2)


@pytest.mark.parametrize("gradients", (False, True))
def test_an_empty_past_and_windows_without_one_are_exactly_the_identity(gradients):
    """A8."""
    model, tokens = attention(), own()
    ids = window_ids(tokens.xy, tokens.ego, ORIGIN, EDGE)
    before = past(n=200)
    here = torch.isin(window_ids(before.xy, before.ego, ORIGIN, EDGE), ids.unique()[:5])
    some = dataclasses.replace(
        before,
        **{
            f: getattr(before, f)[here] for f in ("features", "xy", "ego", "pose_context", "proposal", "selection_mask")
        },
    )
    met = torch.isin(ids, ids.unique()[:5])
    with torch.set_grad_enabled(gradients):
        out = model(tokens.features, tokens, some.features, some)
        none = past(n=0)
        assert torch.equal(model(tokens.features, tokens, none.features, none), tokens.features)
        assert torch.equal(model(tokens.features[:0], own(n=0), some.features, some), tokens.features[:0])
    assert torch.equal(out[~met], tokens.features[~met]) and 0 < int(met.sum()) < len(met)
    assert bool(((out - tokens.features)[met].abs().amax(1) > 1e-3).all())


def test_windows_with_more_history_than_cells_use_all_of_it():
    """A6: 64 cells, 100 remembered tokens on them and as many asked: each still matters."""
    model, random = attention(), torch.Generator().manual_seed(0)

    def crowd(n: int) -> Tokens:
        xy = torch.rand(n, 2, generator=random) * EDGE + GRID.x_min
        rows = torch.randn(n, CHANNELS + PROPOSAL_DIM, generator=random)
        return to_ego_frame([AgentTokens(0, rows, xy)], GRID, 1)

    tokens, before = crowd(100), crowd(100)
    with torch.no_grad():
        out = model(tokens.features, tokens, before.features, before)
        assert torch.allclose(out, slow(model, tokens.features, tokens, before.features, before), atol=1e-5)
        loud = before.features.clone()
        loud[99] *= -3
        assert bool(((model(tokens.features, tokens, loud, before) - out).abs().amax(1) > 1e-6).all())


def test_past_of_one_ego_does_not_affect_another():
    model, a, b = attention(), random_tokens(0), random_tokens(7)
    tokens = to_ego_frame([AgentTokens(0, a.features, a.sites.xy), AgentTokens(1, a.features, a.sites.xy)], GRID, 2)
    before = to_ego_frame([AgentTokens(1, b.features, b.sites.xy, Transform.identity(), 0.1)], GRID, 2)
    with torch.no_grad():
        out = model(tokens.features, tokens, before.features, before)
    first, second = tokens.ego == 0, tokens.ego == 1
    assert torch.equal(out[first], tokens.features[first]) and not torch.equal(out[second], tokens.features[second])


def test_untrained_fusion_with_a_past_equals_self_attention():
    """T = I, one agent, whatever it remembers: before it has learned, FAST is DAST in its place."""
    torch.manual_seed(0)
    flow = FastFusion(CHANNELS, CONFIG).eval()
    plain = SelfAttentionFusion(CHANNELS, CONFIG).eval()
    plain.load_state_dict({k: v for k, v in flow.state_dict().items() if not k.startswith("past_attention.")})
    with torch.no_grad():
        a, b, c = flow(own(), past()), flow(own()), plain(own(), past())
    for other in (b, c):
        assert torch.equal(a.bev.features, other.bev.features) and torch.equal(
            a.merged_proposals, other.merged_proposals
        )
    torch.nn.init.normal_(flow.past_attention.out.weight)
    with torch.no_grad():
        assert not torch.allclose(flow(own(), past()).bev.features, a.bev.features, atol=1e-3)
        assert torch.equal(flow(own(), past(n=0)).bev.features, a.bev.features)


def test_the_past_adds_no_sites_of_its_own():
    fusion = FastFusion(CHANNELS, CONFIG).eval()
    tokens = own()
    with torch.no_grad():
        assert torch.equal(fusion(tokens, past(n=300)).bev.sites.key, assign_cells(tokens)[0].unique())


# Where, by now.


def moving(x: float, y: float, vx: float, vy: float, age_s: float = 0.4, yaw: float = 0.0, **sigmas: float) -> Tokens:
    """One late token of a thing that drives so fast, in its sender's axes; the sender stands at the ego's, turned."""
    row = torch.zeros(1, CHANNELS + PROPOSAL_DIM)
    row[:, CHANNELS:][:, BOX_LAYOUT.velocity] = torch.tensor([[vx, vy]]) / SPEED_UNIT
    row[:, CHANNELS:][:, BOX_LAYOUT.heatmap_logit] = 3.0
    sender = Transform.from_xyz_yaw(0.0, 0.0, 0.0, yaw)
    return to_ego_frame([AgentTokens(0, row, torch.tensor([[x, y]]), sender, age_s, **sigmas)], GRID, 1)


def test_delayed_token_is_motion_compensated():
    assert moving(2.0, 1.0, 10.0, -5.0).xy[0].tolist() == pytest.approx([6.0, -1.0], abs=1e-5)
    turned = moving(2.0, 1.0, 10.0, -5.0, yaw=math.pi / 2)
    assert turned.xy[0].tolist() == pytest.approx([1.0, 6.0], abs=1e-5)
    assert moving(2.0, 1.0, 10.0, -5.0, age_s=0.0).xy[0].tolist() == pytest.approx([2.0, 1.0], abs=1e-6)


def test_implausible_speed_is_ignored():
    assert moving(2.0, 1.0, MAX_SPEED_MPS + 1, 0.0).xy[0].tolist() == pytest.approx([2.0, 1.0], abs=1e-6)
    assert float(moving(-9.0, 1.0, MAX_SPEED_MPS - 1, 0.0).xy[0, 0]) == pytest.approx(
        -9 + 0.4 * (MAX_SPEED_MPS - 1), abs=1e-5
    )


def test_motion_compensated_token_out_of_range_is_dropped():
    assert len(moving(24.0, 0.0, 10.0, 0.0).xy) == 0 and len(moving(24.0, 0.0, 0.0, 0.0).xy) == 1


def test_transform_and_inverse_restore_positions():
    """A10: a rigid motion and its inverse give the places back."""
    motion = Transform.from_xyz_yaw(3.0, -2.0, 0.4, 1.1)
    xy = torch.rand(50, 2).double() * 10
    there = motion.apply(torch.cat((xy, torch.zeros(50, 1).double()), 1))
    assert torch.allclose(motion.inverse().apply(there)[:, :2], xy, atol=1e-9)


def merged_x(x: float, **prior: float) -> float:
    """The x of the merged box of two tokens on one cell: a certain one at 0.2 and one at x with this prior."""
    rows = torch.zeros(2, CHANNELS + PROPOSAL_DIM)
    box = rows[:, CHANNELS:]
    box[:, BOX_LAYOUT.heatmap_logit], box[:, BOX_LAYOUT.log_sigma_xy] = 2.0, math.log(0.2)
    box[:, BOX_LAYOUT.axis] = torch.tensor([1.0, 0.0])
    box[1, BOX_LAYOUT.offset] = torch.tensor([(x - 0.2) / GRID.cell_size_m, 0.0])
    at = torch.tensor([[0.2, 0.2]])
    parts = [AgentTokens(0, rows[:1], at), AgentTokens(0, rows[1:], at, Transform.identity(), **prior)]
    fusion = FastFusion(CHANNELS, CONFIG).eval()
    tokens = to_ego_frame(parts, GRID, 1)
    with torch.no_grad():
        fused = fusion.merge(tokens.features, tokens, *assign_cells(tokens))
    assert len(fused.bev.sites) == 1
    return 0.2 + float(fused.merged_proposals[0, BOX_LAYOUT.offset][0]) * GRID.cell_size_m


def test_pose_sigma_and_age_lower_the_merge_weight():
    # The merge starts as a softmax of -log sigma: weights are inverse to the standard deviations.
    assert merged_x(0.8) == pytest.approx(0.5, abs=1e-5)
    for prior, moved in (({"sigma_xy_m": 0.6}, 0.6), ({"age_s": 0.4}, 0.4 * DRIFT_MPS)):
        sigma = math.hypot(0.2, moved)
        share = (1 / sigma) / (1 / sigma + 1 / 0.2)
        assert merged_x(0.8, **prior) == pytest.approx(0.2 + 0.6 * share, abs=1e-4)
    assert merged_x(0.8, sigma_xy_m=0.6, age_s=0.4) < merged_x(0.8, sigma_xy_m=0.6) < merged_x(0.8, age_s=0.4) < 0.5


def test_heading_sigma_grows_with_distance_from_sender():
    near, far = (moving(x, 0.0, 0.0, 0.0, sigma_yaw_rad=0.02, sigma_xy_m=0.3).sigma_m for x in (1.0, 20.0))
    assert float(near) == pytest.approx(math.hypot(0.3, 0.02), abs=1e-6)
    assert float(far) == pytest.approx(math.hypot(0.3, 0.4), abs=1e-6)
