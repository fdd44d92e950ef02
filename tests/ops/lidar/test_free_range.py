# SPDX-License-Identifier: Apache-2.0
"""Free ranges about a LiDAR: loops equal the references, hand-made rays, and footprints within free ranges.

A ray to the ground at R passes the height of a car, 1.3 to 0.4 m, on the middle part of its way::

    1.9 LiDAR
         '- . _ 1.3
               ' - . _ 0.4
    -------------------'-._ R
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ShapeError
from manyeyes.datatypes.sight import MIN_FREE_M, NUM_SECTORS, Sight
from manyeyes.ops.lidar.free_range import (
    find_free,
    find_free_reference,
    measure_sight,
    measure_sight_reference,
)

HEIGHT_M = 1.9
ELEVATIONS = torch.linspace(-0.3, -0.01, 40).double()


def sweep(limit_m: float = 1e9, azimuths: torch.Tensor | None = None) -> torch.Tensor:
    """Returns of flat ground, nine rays a sector; where the ground is beyond a wall all around, the returns are on the wall."""
    if azimuths is None:
        azimuths = (torch.arange(9 * NUM_SECTORS).double() + 0.5) * (2 * math.pi / (9 * NUM_SECTORS))
    azimuth, elevation = torch.meshgrid(azimuths, ELEVATIONS, indexing="ij")
    length = (HEIGHT_M / elevation.tan().abs()).clamp_max(limit_m)
    return torch.stack(
        (length * azimuth.cos(), length * azimuth.sin(), HEIGHT_M + length * elevation.tan()), -1
    ).reshape(-1, 3)


def nearer(points: torch.Tensor, chosen: torch.Tensor, limit_m: float) -> torch.Tensor:
    """Some rays end at an upright surface at a distance, if the ground is beyond it."""
    origin = torch.tensor([0.0, 0.0, HEIGHT_M]).double()
    part = (limit_m / points[:, :2].norm(dim=1)).clamp_max(1.0)
    return torch.where(chosen[:, None], origin + (points - origin) * part[:, None], points)


def sector_of(points: torch.Tensor) -> torch.Tensor:
    return (torch.rad2deg(torch.atan2(points[:, 1], points[:, 0])) % 360 // 2).long()


@pytest.mark.parametrize("seed", range(3))
def test_loops_equal_the_references(seed):
    rng = torch.Generator().manual_seed(seed)
    ground = sweep(limit_m=60.0)
    some = torch.rand(len(ground), generator=rng) < 0.999
    walls = nearer(ground, torch.rand(NUM_SECTORS, generator=rng)[sector_of(ground)] < 0.3, 25.0)[some]
    clutter = torch.randn(100, 3, generator=rng).double() * torch.tensor([40.0, 40.0, 1.0])
    points = torch.cat((walls, clutter)).float()
    found, expected = measure_sight(points, HEIGHT_M), measure_sight_reference(points, HEIGHT_M)
    assert (found.steps == expected.steps).mean() > 0.99, "but for rounding at the edges of steps"
    assert np.abs(found.steps.astype(int) - expected.steps)[found.steps != expected.steps].max(initial=0) <= 1
    assert len(np.unique(found.steps)) > 8


def test_an_open_plane_is_free_as_far_as_rays_pass_low():
    free_m = measure_sight(sweep().float(), HEIGHT_M).free_m
    # The flattest ray is 0.4 m high at 150 m; codes end at 127.5 m.
    assert (free_m == 127.5).all()
    steep = measure_sight(sweep(azimuths=None)[sweep()[:, :2].norm(dim=1) < 40].float(), HEIGHT_M).free_m
    farthest = 40 * (HEIGHT_M - 0.4) / HEIGHT_M
    assert (steep <= farthest).all() and (steep >= 0.85 * farthest).all()


def test_a_wall_ends_the_range_half_a_metre_before_it():
    free_m = measure_sight(sweep(limit_m=20.3).float(), HEIGHT_M).free_m
    assert (free_m <= 19.8).all() and (free_m >= 19.0).all()


def test_one_ray_that_ends_in_an_object_ends_its_sector_and_no_other():
    points = torch.cat((sweep(), torch.tensor([[12.0, 0.2, 0.9]]).double()))
    steps = measure_sight(points.float(), HEIGHT_M).steps
    assert steps[0] == 23 and (steps[1:] == 255).all()


def test_rays_that_do_not_return_state_nothing():
    ground = sweep()
    lost = sector_of(ground) == 10
    steps = measure_sight(ground[~lost].float(), HEIGHT_M).steps
    assert steps[10] == 0 and (np.delete(steps, 10) == 255).all()
    # A third of a sector without rays is as good as all of it.
    part = lost & (torch.rad2deg(torch.atan2(ground[:, 1], ground[:, 0])) > 21.34)
    assert measure_sight(ground[~part].float(), HEIGHT_M).steps[10] == 0


def test_rays_above_vehicles_state_nothing():
    high = sweep()
    high[:, 2] = 1.5
    assert (measure_sight(high.float(), HEIGHT_M).steps == 0).all()
    bridge = torch.cat((sweep(), torch.tensor([[12.0, 0.2, 4.0]]).double()))
    assert (measure_sight(bridge.float(), HEIGHT_M).steps == 255).all()


def test_a_gap_in_the_distances_ends_the_range():
    ground = sweep()
    elevation = torch.atan2(HEIGHT_M - ground[:, 2], ground[:, :2].norm(dim=1))
    # Rays between those that are 0.4 m high at 12 m and 1.3 m high at 20 m.
    kept = (elevation.tan() > 1.5 / 12) | (elevation.tan() < 0.6 / 20)
    free_m = measure_sight(ground[kept].float(), HEIGHT_M).free_m
    assert (free_m <= 12.0).all() and (free_m > 10.0).all()


def test_an_obstacle_nearer_than_the_first_range_leaves_nothing():
    near = nearer(sweep(), sector_of(sweep()) == 7, 4.0)
    assert measure_sight(near.float(), HEIGHT_M).steps[7] == 0


def test_no_points_and_points_that_are_not_finite():
    assert (measure_sight(torch.zeros(0, 3), HEIGHT_M).steps == 0).all()
    assert (measure_sight(torch.full((3, 3), float("nan")), HEIGHT_M).steps == 0).all()
    assert (measure_sight(torch.tensor([[0.0, 0.0, 1.9]]), HEIGHT_M).steps == 0).all()


def test_a_sight_has_one_step_a_sector():
    with pytest.raises(ShapeError, match="180"):
        Sight(np.zeros(179, np.uint8))
    assert Sight(np.full(180, 3)).free_m.tolist() == [1.5] * 180


@pytest.mark.parametrize("seed", range(3))
def test_free_boxes_equal_the_reference(seed):
    draw = np.random.default_rng(seed)
    sight = Sight(np.repeat(draw.choice([0, 40, 80, 120, 255], 20, p=[0.1, 0.2, 0.2, 0.2, 0.3]), 9))
    angle, distance = draw.uniform(-np.pi, np.pi, 300), draw.uniform(0, 60, 300)
    xyz = np.stack((distance * np.cos(angle), distance * np.sin(angle), np.full(300, 0.8)), 1)
    size = np.stack((draw.uniform(0.5, 12, 300), draw.uniform(0.5, 3, 300), np.full(300, 1.6)), 1)
    boxes = np.concatenate((xyz, size, draw.uniform(-3.1, 3.1, (300, 1))), 1)
    margin = draw.uniform(0, 2, 300)
    found = find_free(sight, boxes, margin)
    sampled = find_free_reference(sight, torch.from_numpy(boxes), torch.from_numpy(margin)).numpy()
    assert not (found & ~sampled).any(), "samples are never stricter than the whole footprint"
    assert (found != sampled).mean() < 0.02 and 50 < found.sum() < 250


def box(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return np.array([[x, y, 0.8, 4.0, 2.0, 1.6, yaw]])


def is_free(sight: Sight, boxes: np.ndarray, margin_m: float = 0.0) -> bool:
    return bool(find_free(sight, boxes, np.array([margin_m]))[0])


def test_the_whole_enlarged_footprint_counts():
    """A car along x at (20, 0) ends at x = 22; its far corners are at hypot(22, 1) = 22.02 m."""
    sight = Sight(np.full(NUM_SECTORS, 45))
    assert is_free(sight, box(20, 0)) and is_free(sight, box(20, 0), 0.45)
    assert not is_free(sight, box(20, 0), 0.55)
    steps = np.full(NUM_SECTORS, 255)
    # Its near corners are at 3.2 degrees; a margin of 0.5 m takes them to 4.9 degrees.
    steps[2] = 0
    assert is_free(Sight(steps), box(20, 0)) and not is_free(Sight(steps), box(20, 0), 0.5)


@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi - 0.001, -math.pi, -0.01, 4.0])
def test_a_box_is_free_from_every_side(angle):
    place = box(20 * math.cos(angle), 20 * math.sin(angle), angle)
    assert is_free(Sight(np.full(NUM_SECTORS, 45)), place) and not is_free(Sight(np.full(NUM_SECTORS, 43)), place)


def test_nothing_is_free_near_the_lidar():
    everything = Sight(np.full(NUM_SECTORS, 255))
    assert not is_free(everything, box(0, 0)) and not is_free(everything, box(MIN_FREE_M + 1.9, 0))
    assert is_free(everything, box(MIN_FREE_M + 2.1, 0))
    assert not is_free(everything, box(math.nan, 0)) and not is_free(everything, box(130, 0))
