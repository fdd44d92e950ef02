# SPDX-License-Identifier: Apache-2.0
"""The matcher against a plain loop; permutation, motion, padding, and an assignment by hand."""

import math
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from manyeyes.datatypes import Boxes, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FEAKM, FORMAT, FeakmConfig, FeakmNet, load
from manyeyes.models.pose.matcher import (
    Assignment,
    AssignmentHead,
    KeypointBatch,
    Matcher,
    MatcherConfig,
    SelfAttentionBlock,
    find_mutual_matches,
)
from manyeyes.models.pose.neighbour_geometry import NeighbourGeometryConfig, NeighbourGeometryEncoder

SMALL = MatcherConfig(8, 16, 2, 2, position_unit_m=10.0)


def keypoints(n: int, seed: int = 0) -> Keypoints:
    rng = torch.Generator().manual_seed(seed)
    boxes = Boxes.of(
        (torch.rand(n, 3, generator=rng) - 0.5) * 60,
        1 + torch.rand(n, 3, generator=rng),
        6 * torch.rand(n, generator=rng),
    )
    return Keypoints(boxes, functional.normalize(torch.randn(n, 8, generator=rng)))


def matcher(config: MatcherConfig = SMALL) -> Matcher:
    torch.manual_seed(1)
    return Matcher(config).eval()


def last(net: Matcher, a: Keypoints, b: Keypoints) -> torch.Tensor:
    with torch.no_grad():
        return net(KeypointBatch.of([a]), KeypointBatch.of([b]))[-1].log_p[0]


def test_the_number_of_weights_is_that_of_the_published_matcher():
    # Parameters of the published code, less the 8 * 257 of the heads that its settings switch off.
    assert sum(p.numel() for p in Matcher(MatcherConfig()).parameters()) == 11_851_601 - 8 * 257


def test_the_shipped_net_is_small():
    assert sum(p.numel() for p in FeakmNet(FEAKM["feakm-small"]).parameters()) <= 2_000_000


def test_eq_4_and_5_in_a_plain_loop():
    """One head, no feed-forward: softmax over j of q_i . k_j, positions turned in by hand, then the sum of values."""
    torch.manual_seed(0)
    block, n, d = SelfAttentionBlock(8, 1), 5, 8
    x, angle = torch.randn(1, n, d), torch.randn(1, 1, n, d // 2)
    q, k, v = block.qkv(x)[0].chunk(3, -1)

    def turn(row, i):
        pairs = torch.view_as_complex(row.reshape(-1, 2).contiguous())
        return torch.view_as_real(pairs * torch.polar(torch.ones(d // 2), angle[0, 0, i])).flatten()

    attended = []
    for i in range(n):
        logits = torch.stack([turn(q[i], i) @ turn(k[j], j) / math.sqrt(d) for j in range(n)])
        attended.append(logits.softmax(0) @ v)
    message = block.out(torch.stack(attended))
    wanted = x[0] + block.ffn(torch.cat((x[0], message), 1))
    found = block(x, (angle.cos(), angle.sin()), torch.ones(1, n, dtype=torch.bool))[0]
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


def test_the_assignment_by_hand():
    """log P_ij = log softmax by row + by column + log sigmoid of both matchabilities."""
    torch.manual_seed(0)
    head = AssignmentHead(4)
    x, y = torch.randn(1, 2, 4), torch.randn(1, 3, 4)
    full = [torch.ones(1, n, dtype=torch.bool) for n in (2, 3)]
    found = head(x, y, *full)
    s = head.project(x[0]) @ head.project(y[0]).T / 2
    z, w = torch.sigmoid(head.matchable(x[0])), torch.sigmoid(head.matchable(y[0]))
    wanted = s.exp() / s.exp().sum(1, keepdim=True) * (s.exp() / s.exp().sum(0)) * z * w.T
    torch.testing.assert_close(found.log_p[0].exp(), wanted)
    torch.testing.assert_close(found.log_unmatched_a[0].exp(), 1 - z[:, 0])


def test_only_mutual_and_likely_pairs_match():
    p = torch.tensor([[0.6, 0.1, 0.0], [0.5, 0.3, 0.0], [0.0, 0.05, 0.08]])
    assignment = Assignment(p.clamp_min(1e-9).log()[None], torch.zeros(1, 3), torch.zeros(1, 3))
    pairs, probability = find_mutual_matches(assignment, 0.1)[0]
    # Row 1 prefers column 0, which prefers row 0; row 2 and column 2 agree but are unlikely.
    assert pairs.tolist() == [[0, 0]] and probability.tolist() == pytest.approx([0.6])
    assert find_mutual_matches(assignment, 0.05)[0][0].tolist() == [[0, 0], [2, 2]]


@pytest.mark.parametrize("around", [None, NeighbourGeometryConfig(30.0, 16)])
def test_order_of_points_does_not_matter(around):
    a, b, net = keypoints(6), keypoints(4, 1), matcher(replace(SMALL, neighbour_geometry=around))
    order = torch.tensor([3, 1, 0, 5, 2, 4])
    torch.testing.assert_close(last(net, a[order], b), last(net, a, b)[order], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(last(net, b, a), last(net, a, b).T, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("around", [None, NeighbourGeometryConfig(30.0, 16)])
def test_padding_changes_nothing(around):
    a, b, c, net = keypoints(3), keypoints(7, 1), keypoints(5, 2), matcher(replace(SMALL, neighbour_geometry=around))
    with torch.no_grad():
        both = net(KeypointBatch.of([a, b]), KeypointBatch.of([c, a]))[-1]
    torch.testing.assert_close(both.log_p[0, :3], last(net, a, c), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(both.log_p[1, :, :3], last(net, b, a), atol=1e-4, rtol=1e-4)
    assert float(both.log_p[0, 3:].max()) < -1000 and float(both.log_p[1, :, 3:].max()) < -1000


def test_rotary_encoding_is_invariant_to_shifts_and_neighbour_geometry_also_to_rotation():
    a, b, net = keypoints(6), keypoints(4, 1), matcher()
    shift, turn = Transform.from_xyz_yaw(30.0, -12.0), Transform.from_xyz_yaw(0.0, 0.0, 0.0, 1.0)
    torch.testing.assert_close(last(net, a.transform(shift), b), last(net, a, b), atol=1e-4, rtol=1e-4)
    assert float((last(net, a.transform(turn), b) - last(net, a, b)).abs().max()) > 3e-3
    torch.manual_seed(0)
    around = NeighbourGeometryEncoder(16, NeighbourGeometryConfig(30.0, 16))
    half_turned = replace(a.boxes, yaw=a.boxes.yaw + math.pi)
    seen = [
        around(p.xy, p.yaw, p.size, p.mask)
        for p in (
            KeypointBatch.of([a]),
            KeypointBatch.of([a.transform(shift @ turn)]),
            KeypointBatch.of([Keypoints(half_turned, a.descriptor)]),
        )
    ]
    torch.testing.assert_close(seen[1], seen[0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(seen[2], seen[0], atol=1e-4, rtol=1e-4)
    assert float((seen[0][0, 0] - seen[0][0, 1]).norm()) > 1e-3


def test_nothing_to_match_is_no_match_and_gives_finite_gradients():
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(8, 8, 16), SMALL))
    assert net.match(KeypointBatch.of([keypoints(0)]), KeypointBatch.of([keypoints(3)])).pairs.shape == (0, 2)
    out = net.matcher(KeypointBatch.of([keypoints(0), keypoints(3)]), KeypointBatch.of([keypoints(4), keypoints(0)]))[
        -1
    ]
    (out.log_p.sum() + out.log_unmatched_a.sum()).backward()
    assert all(p.grad is None or bool(p.grad.isfinite().all()) for p in net.parameters())


def test_weights_are_saved_with_their_settings_and_loaded_strictly(tmp_path):
    path = tmp_path / "f.safetensors"
    config = FeakmConfig(
        BoxKeypointConfig(8, 8, 16), replace(SMALL, neighbour_geometry=NeighbourGeometryConfig(30.0, 16))
    )
    net = FeakmNet(config).eval()
    checkpoint.save(net, path, {"seed": 1}, format=FORMAT)
    loaded = load(path)
    assert loaded.config == config and checkpoint.read_card(path, FORMAT) == {"seed": 1}
    a, b = keypoints(6), keypoints(4, 1)
    assert torch.equal(last(loaded.matcher, a, b), last(net.matcher, a, b))
    with pytest.raises(checkpoint.CheckpointError, match="format is 'manyeyes-feakm-1', not 'manyeyes-detector-1'"):
        checkpoint.load(path)


def test_the_shipped_net_has_a_name_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "files", lambda package: tmp_path)
    with pytest.raises(checkpoint.CheckpointError, match="No weights are named 'feakm-small'; known are none"):
        pretrained.load_feakm()
    checkpoint.save(
        FeakmNet(FeakmConfig(BoxKeypointConfig(8, 8, 16), SMALL)),
        tmp_path / "weights/feakm-small.safetensors",
        {},
        format=FORMAT,
    )
    assert pretrained.load_feakm("feakm-small").config.matcher == SMALL and pretrained.list_detectors() == ()
    with pytest.raises(checkpoint.CheckpointError, match="No weights are named 'feakm-small'"):
        pretrained.load("feakm-small")


def test_shipped_matcher_belongs_to_the_shipped_detector():
    """A retrained detector requires a retrained matcher."""
    net = pretrained.load_feakm()
    net.check_views(pretrained.load().fingerprint)
    assert not net.training and sum(p.numel() for p in net.parameters()) <= 2_000_000
