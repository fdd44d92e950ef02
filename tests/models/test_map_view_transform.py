# SPDX-License-Identifier: Apache-2.0
"""Lifting pictures to the ground: hand-worked cells, a loop over every cell and camera, and gradients."""

import math

import pytest
import torch

from manyeyes.datatypes import BevGrid, ShapeError, Transform
from manyeyes.datatypes.camera import Camera
from manyeyes.models.maps.view_transform import AgentCameras, DepthBins, lift_depth, lift_ground

GRID = BevGrid(0.0, -6.0, -1.0, 16.0, 6.0, 3.0, pillar=1.0, stride=2)
STRIDE, SIZE = 8, (6, 8)
BINS = DepthBins(2.0, 14.0, 7)


def camera(yaw=0.0, height=2.0, pitch=0.15, x=0.0):
    """Looks ahead along the agent's x, tilted down; 64 by 48 pixels, ninety degrees wide."""
    ahead = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    turned = Transform.from_rpy(torch.tensor([x, 0.0, height], dtype=torch.float64), zero, zero + pitch, zero + yaw)
    pose = turned @ Transform(ahead, torch.zeros(3, dtype=torch.float64))
    k = torch.tensor([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]], dtype=torch.float64)
    return Camera(k, pose, 64, 48)


def bilinear(picture, column, row):
    """Of (C, h, w) at fractional indices, the border going on."""
    h, w = picture.shape[-2:]
    column, row = min(max(column, 0.0), w - 1.0), min(max(row, 0.0), h - 1.0)
    c, r = min(math.floor(column), w - 2), min(math.floor(row), h - 2)
    u, v = column - c, row - r
    top = picture[:, r, c] * (1 - u) + picture[:, r, c + 1] * u
    return top * (1 - v) + (picture[:, r + 1, c] * (1 - u) + picture[:, r + 1, c + 1] * u) * v


def slowly(features, depth, cameras, heights):
    """The mean over cameras that see the cell of sums over heights; without depth the ground alone."""
    rows, columns = GRID.shape
    out, seen = features.new_zeros(features.shape[1], rows, columns), torch.zeros(rows, columns, dtype=torch.bool)
    for r in range(rows):
        for c in range(columns):
            x, y = GRID.centers(torch.tensor([[r, c]]))[0].tolist()
            found = []
            for v, cam in enumerate(cameras):
                total, any_height = features.new_zeros(features.shape[1]), False
                for z in heights:
                    pixel, away = cam.project(torch.tensor([[x, y, z]], dtype=torch.float64))
                    (px, py), d = pixel[0].tolist(), float(away)
                    if d <= 0.5 or not (0 <= px <= cam.width and 0 <= py <= cam.height):
                        continue
                    value = bilinear(features[v], (px - 0.5) / STRIDE, (py - 0.5) / STRIDE)
                    if depth is not None:
                        if not BINS.near_m <= d <= BINS.far_m:
                            continue
                        at = (d - BINS.near_m) / (BINS.far_m - BINS.near_m) * (BINS.num_bins - 1)
                        low = min(math.floor(at), BINS.num_bins - 2)
                        mixed = depth[v, low] * (1 - (at - low)) + depth[v, low + 1] * (at - low)
                        value = value * bilinear(mixed[None], (px - 0.5) / STRIDE, (py - 0.5) / STRIDE)
                    total, any_height = total + value, True
                if any_height:
                    found.append(total)
            if found:
                out[:, r, c], seen[r, c] = torch.stack(found).mean(0), True
    return out, seen


@pytest.mark.parametrize("way", ["ground", "depth"])
def test_values_and_gradients_are_those_of_the_loop(way):
    generator = torch.Generator().manual_seed(5)
    cameras = [camera(), camera(yaw=0.7, height=1.6), camera(yaw=-0.5, x=1.0)]
    features = torch.randn(3, 2, *SIZE, generator=generator, requires_grad=True)
    depth = torch.rand(3, BINS.num_bins, *SIZE, generator=generator).softmax(1).requires_grad_()
    owner, heights = torch.zeros(3, dtype=torch.int64), (-0.3, 0.0, 0.8)
    if way == "ground":
        fast, seen = lift_ground(features, AgentCameras(cameras, owner, 1), GRID, STRIDE)
        slow, expected = slowly(features, None, cameras, (0.0,))
        inputs = (features,)
    else:
        fast, seen = lift_depth(features, depth, AgentCameras(cameras, owner, 1), GRID, STRIDE, BINS, heights)
        slow, expected = slowly(features, depth, cameras, heights)
        inputs = (features, depth)
    assert torch.equal(seen[0], expected) and 8 < int(expected.sum()) < expected.numel()
    assert torch.allclose(fast[0], slow, atol=1e-4)
    aim = torch.randn(slow.shape, generator=generator)
    for mine, theirs in zip(
        torch.autograd.grad((fast[0] * aim).sum(), inputs), torch.autograd.grad((slow * aim).sum(), inputs), strict=True
    ):
        assert float(theirs.abs().max()) > 1e-3
        assert torch.allclose(mine, theirs, atol=1e-3)


def test_pixel_is_lifted_to_its_position_on_the_road():
    # Two metres up, looking straight ahead at 90 degrees: the road 8 m ahead is 2 / 8 * 32 = 8 rows below the middle.
    cam = camera(pitch=0.0)
    row, column = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    picture = torch.stack((row + 0.5, column + 0.5))[None]
    grid = BevGrid(7.5, -2.5, -1.0, 8.5, 2.5, 1.0, pillar=1.0)
    bev, seen = lift_ground(picture, AgentCameras([cam], torch.zeros(1, dtype=torch.int64), 1), grid, 1)
    assert bool(seen.all())
    assert bev[0, 0, :, 0].tolist() == pytest.approx([32.0] * 5, abs=1e-3)
    # y is to the left, columns count to the right: 1 m is 4 columns at 8 m.
    assert bev[0, 1, :, 0].tolist() == pytest.approx([40.0, 36.0, 32.0, 28.0, 24.0], abs=1e-3)


def test_ground_beyond_the_maximum_pixel_footprint_is_not_observed():
    # Two metres up, 32 pixels a unit of slope: a pixel d metres ahead covers (d^2 + 4) / 64 m of a level road.
    cam, owner = camera(pitch=0.0), torch.zeros(1, dtype=torch.int64)
    grid = BevGrid(0.0, -0.5, -1.0, 16.0, 0.5, 1.0, pillar=1.0)
    _, all_seen = lift_ground(torch.ones(1, 1, *SIZE), AgentCameras([cam], owner, 1), grid, STRIDE)
    bev, seen = lift_ground(
        torch.ones(1, 1, *SIZE), AgentCameras([cam], owner, 1), grid, STRIDE, max_pixel_footprint_m=1.0
    )
    # 2 m of height at 45 degrees down at most: nothing nearer than 8 / 3 m; cells are centred on halves.
    assert all_seen[0, 0].nonzero()[:, 0].tolist() == list(range(3, 16))
    assert seen[0, 0].nonzero()[:, 0].tolist() == [3, 4, 5, 6, 7]  # 7.5 m: .94 m; 8.5 m: 1.19 m
    assert bev[0, 0, 0].tolist() == [0.0] * 3 + [1.0] * 5 + [0.0] * 8


def test_a_certain_depth_puts_the_feature_there_and_nowhere_else():
    features, depth = torch.ones(1, 1, *SIZE), torch.zeros(1, BINS.num_bins, *SIZE)
    depth[:, 3] = 1.0
    bev, seen = lift_depth(
        features,
        depth,
        AgentCameras([camera(pitch=0.0)], torch.zeros(1, dtype=torch.int64), 1),
        GRID,
        STRIDE,
        BINS,
        (0.0,),
    )
    ahead = bev[0, 0, 3]
    # Bin 3 of 2, 4, …, 14 m is 8 m; cells lie at 0.5, 2.5, 4.5, … m: 6.5 and 8.5 m are 0.75 of a bin and a quarter of one away.
    assert ahead.tolist() == pytest.approx([0, 0, 0, 0.25, 0.75, 0, 0, 0], abs=1e-5)
    assert bool(seen[0, 3, 4:7].all()) and not bool(seen[0, 3, 0])


def test_cameras_observe_for_their_agent_only():
    features = torch.stack((torch.full((1, *SIZE), 2.0), torch.full((1, *SIZE), -3.0)))
    bev, seen = lift_ground(features, AgentCameras([camera(), camera()], torch.tensor([2, 0]), 3), GRID, STRIDE)
    assert torch.equal(seen[0], seen[2]) and not bool(seen[1].any())
    assert torch.allclose(bev[2, 0][seen[2]], torch.tensor(2.0)) and torch.allclose(
        bev[0, 0][seen[0]], torch.tensor(-3.0)
    )
    assert float(bev[1].abs().max()) == 0


def test_missing_camera_is_refused():
    with pytest.raises(ShapeError, match="for 1 cameras"):
        lift_ground(
            torch.zeros(2, 1, *SIZE), AgentCameras([camera()], torch.zeros(1, dtype=torch.int64), 1), GRID, STRIDE
        )
