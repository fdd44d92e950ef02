# SPDX-License-Identifier: Apache-2.0
"""FeaKM's keypoints: the published ones with their defects, the mended ones without."""

import math
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, ShapeError, SparseBev, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.transform_tokens import rotate_vectors
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig, BoxKeypointNet
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig, DenseKeypointNet, DetectorView, local_maxima
from manyeyes.models.pose.peak_descriptors import PeakKeypointConfig, PeakKeypointNet

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0, stride=2)
CHANNELS = 8


def view(cells, confidence, boxes=None, grid=GRID, seed=0) -> DetectorView:
    """Tokens of random features at cells (row, column)."""
    yx = torch.tensor(cells)
    features = torch.rand(len(yx), CHANNELS, generator=torch.Generator().manual_seed(seed))
    both = SparseBev.from_cells(torch.cat((features, torch.tensor(confidence)[:, None]), 1), yx, grid)
    return DetectorView(both.with_features(both.features[:, :-1]), both.features[:, -1], boxes or Boxes.empty())


def dense(**more) -> DenseKeypointNet:
    torch.manual_seed(0)
    return DenseKeypointNet(DenseKeypointConfig(CHANNELS, (8, 8, 8), 16, **more)).eval().requires_grad_(False)


def boxed(**more) -> BoxKeypointNet:
    torch.manual_seed(0)
    return BoxKeypointNet(BoxKeypointConfig(CHANNELS, 16, 32, **more)).eval().requires_grad_(False)


def peaked(**more) -> PeakKeypointNet:
    torch.manual_seed(0)
    return PeakKeypointNet(PeakKeypointConfig(CHANNELS, 16, 32, **more)).eval().requires_grad_(False)


def test_the_number_of_weights_is_that_of_the_published_extractor():
    net = DenseKeypointNet(DenseKeypointConfig(in_channels=128))
    assert sum(p.numel() for p in net.parameters()) == 3_312_640  # parameters of the published code


def test_greedy_suppression_by_hand():
    """Along a line 9 suppresses 8; 7, two cells farther, then stands free: a single round would have lost it to 8."""
    line = torch.tensor([[[0.0, 9.0, 0.0, 8.0, 7.0, 0.0, 0.0, 3.0]]])
    assert local_maxima(line, 2)[0, 0].nonzero()[:, 0].tolist() == [1, 4, 7]
    assert local_maxima(line, 2, rounds=1)[0, 0].nonzero()[:, 0].tolist() == [1, 7]
    assert not local_maxima(torch.zeros(1, 4, 4), 1).any()


def test_published_keypoints_are_peaks_at_cell_corners_and_padding():
    cells = [(20, 30), (20, 31), (40, 12), (50, 50), (1, 30)]
    made = view(cells, [0.9, 0.8, 0.5, 0.1, 0.99])
    (points,) = dense(num_keypoints=6)([made])
    # (20, 31) is suppressed, (50, 50) is unsure, (1, 30) lies at the edge.
    corner = [-25.6 + 0.4 / 2 - 0.4, -25.6 + 0.4 / 2 - 0.4]
    expected = torch.tensor([[c * 0.8 + corner[0], r * 0.8 + corner[1]] for r, c in [(20, 30), (40, 12)]])
    torch.testing.assert_close(points.xy[:2], expected)
    torch.testing.assert_close(points.boxes.score, torch.tensor([0.9, 0.5, 0, 0, 0, 0]))
    assert (points.xy[2:] == points.xy[2]).all() and (points.descriptor[2:] == points.descriptor[2]).all()
    torch.testing.assert_close(points.descriptor.norm(dim=1), torch.ones(6))
    assert points.boxes.sigma_yaw.isinf().all()


def test_without_a_confidence_map_peaks_of_the_features_are_taken():
    made = view([(20, 30), (40, 12)], [0.0, 0.0])
    (points,) = dense(num_keypoints=4, saliency="feature")([made])
    assert int((points.boxes.score > 0).sum()) == 2
    assert int((dense(num_keypoints=4)([made])[0].boxes.score > 0).sum()) == 0


def test_published_descriptor_depends_on_the_other_agent_and_improved_one_does_not():
    boxes = Boxes.of(torch.tensor([[0.4, 1.2, 0.0]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.tensor([0.3]))
    one = view([(32, 32), (33, 33)], [0.9, 0.1], boxes)
    loud = view([(20, 20)], [0.9])
    loud = DetectorView(loud.tokens.with_features(loud.tokens.features * 50), loud.confidence, Boxes.empty())
    net = dense()
    for weight in net.trunk.parameters():
        weight.mul_(3)  # untrained convolutions hardly pass anything on
    assert float((net([one])[0].descriptor[0] - net([one, loud])[0].descriptor[0]).norm()) > 1e-2
    mended = boxed()
    assert torch.equal(mended([one])[0].descriptor, mended([one, loud])[0].descriptor)
    assert len(mended([loud])[0]) == 0


def quarter_turn(cells: int) -> tuple[DetectorView, DetectorView]:
    """One random view from before and after a quarter turn of its agent, which maps cells of a square lattice onto cells."""
    shift = 25.4  # centres lie at -25.4 + 0.8 k; a quarter turn about the middle of the lattice keeps them
    grid = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0, stride=1)
    assert shift == pytest.approx(-float(grid.centers(torch.tensor([[0, 0]]))[0, 0]))
    rng = torch.Generator().manual_seed(3)
    flat = torch.randperm(grid.shape[0] * grid.shape[1], generator=rng)[:cells]
    yx = torch.stack((flat // grid.shape[1], flat % grid.shape[1]), 1)
    features = torch.randn(len(yx), CHANNELS, generator=rng)
    boxes = Boxes.of(
        (torch.rand(5, 3, generator=rng) - 0.5) * 30, 1 + torch.rand(5, 3, generator=rng), torch.rand(5, generator=rng)
    )
    turned_yx = torch.stack((yx[:, 1], grid.shape[0] - 1 - yx[:, 0]), 1)
    tokens = SparseBev.from_cells(features, yx, grid)
    turned = SparseBev.from_cells(rotate_vectors(features, torch.tensor(math.pi / 2)), turned_yx, grid)
    move = Transform.from_xyz_yaw(0.0, 0.0, 0.0, math.pi / 2)
    return DetectorView(tokens, torch.ones(cells), boxes), DetectorView(
        turned, torch.ones(cells), boxes.transform(move)
    )


def test_improved_descriptor_is_invariant_to_agent_rotation():
    """Tokens, their vectors and boxes turn, descriptors stay."""
    before, after = quarter_turn(6000)
    (here,), (there,) = boxed()([before]), boxed()([after])
    torch.testing.assert_close(there.descriptor, here.descriptor, atol=1e-4, rtol=1e-4)
    (unturned,) = boxed()([replace(before, boxes=after.boxes)])
    assert float((unturned.descriptor - here.descriptor).norm(dim=1).min()) > 1e-2


def test_peaks_of_features_are_invariant_to_agent_rotation():
    """Peaks turn with the agent, their axes too, and descriptors stay; boxes and confidence have no effect."""
    before, after = quarter_turn(600)
    (here,), (there,) = peaked()([before]), peaked()([after])
    turned = here.transform(Transform.from_xyz_yaw(0.0, 0.0, 0.0, math.pi / 2))
    assert len(here) == 64
    torch.testing.assert_close(there.xy, turned.xy.float(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(there.descriptor, here.descriptor, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close((2 * there.boxes.yaw).cos(), (2 * turned.boxes.yaw).cos(), atol=1e-3, rtol=1e-3)
    (other,) = peaked()([DetectorView(before.tokens, torch.zeros(600), Boxes.empty())])
    assert torch.equal(other.descriptor, here.descriptor)


def test_peaks_are_the_largest_norms_and_their_axis_is_that_of_the_cells():
    """A wall along x with its highest norm in the middle, and a weaker cell apart."""
    cells = [(32, c) for c in range(28, 37)] + [(50, 50)]
    features = torch.zeros(len(cells), CHANNELS)
    features[:, 0] = torch.tensor([1.0, 1, 1, 1, 9, 1, 1, 1, 1, 5])
    tokens = SparseBev.from_cells(features, torch.tensor(cells), GRID)
    (points,) = peaked(nms_radius_m=8.0)([DetectorView(tokens, torch.zeros(len(cells)), Boxes.empty())])
    torch.testing.assert_close(points.xy, GRID.centers(torch.tensor([(32, 32), (50, 50)])).float())
    assert float(points.boxes.yaw[0]) == pytest.approx(0.0, abs=1e-5) and points.boxes.size.eq(0).all()
    nothing = SparseBev.from_cells(torch.zeros(0, CHANNELS), torch.zeros(0, 2, dtype=torch.int64), GRID)
    assert len(peaked()([DetectorView(nothing, torch.zeros(0), Boxes.empty())])[0]) == 0
    with pytest.raises(ConfigError, match="nms_radius_m"):
        PeakKeypointConfig(nms_radius_m=0.0)


def test_improved_keypoints_are_the_best_boxes():
    n = 5
    boxes = Boxes.of(torch.rand(n, 3) * 10, torch.ones(n, 3), torch.zeros(n), torch.tensor([0.9, 0.8, 0.5, 0.3, 0.1]))
    (points,) = boxed(max_keypoints=3)([view([(32, 32)], [0.5], boxes)])
    assert torch.equal(points.xy, boxes.center[:3, :2])
    assert len(boxed()([view([(32, 32)], [0.5], boxes)])[0]) == 4
    empty = DetectorView(
        SparseBev.from_cells(torch.zeros(0, CHANNELS), torch.zeros(0, 2, dtype=torch.int64), GRID),
        torch.zeros(0),
        boxes,
    )
    assert boxed()([empty])[0].descriptor.isfinite().all()


def test_view_from_shared_tokens():
    shared_tokens = SparseBev.from_cells(torch.zeros(2, CHANNELS + PROPOSAL_DIM), torch.tensor([[1, 1], [2, 2]]), GRID)
    shared_tokens.features[1, CHANNELS:][BOX_LAYOUT.heatmap_logit] = 3.0
    made = DetectorView.of(shared_tokens, Boxes.empty())
    assert made.tokens.features.shape == (2, CHANNELS)
    torch.testing.assert_close(made.confidence, torch.sigmoid(torch.tensor([0.0, 3.0])))
    with pytest.raises(ShapeError, match=r"needs confidence \(2,\)"):
        replace(made, confidence=torch.zeros(3))
