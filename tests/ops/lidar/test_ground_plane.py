# SPDX-License-Identifier: Apache-2.0
"""The fitted plane is the road: on tilted sensors and slopes, beside vehicles and walls; without visible ground it is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import ShapeError, Transform
from manyeyes.ops.lidar import _ground_plane_kernels as kernels
from manyeyes.ops.lidar.ground_plane import GroundFit, GroundPlane, GroundStatus, fit_ground_plane

DATA = Path(__file__).parents[4] / "shared" / "data"
TOLERANCE = kernels.Tolerance(0.15, 0.006)


def road(
    slope: tuple[float, float] = (0.0, 0.0), seed: int = 0, count: int = 20_000, sector: float = math.pi
) -> Tensor:
    """Rings of returns from flat ground, 2 cm noise: evenly spread over ranges of 4 to 50 m, as density falls with the range."""
    rng = np.random.default_rng(seed)
    radius, angle = rng.uniform(4, 50, count), rng.uniform(-sector, sector, count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = slope[0] * x + slope[1] * y + 0.02 * rng.standard_normal(count)
    return torch.from_numpy(np.stack((x, y, z), 1)).float()


def block(corner: tuple[float, float], size: tuple[float, float, float], seed: int = 1, count: int = 4000) -> Tensor:
    """Returns from the sides and the top of a box that stands on z = 0.3 (a chassis)."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(0, 1, (count, 3))
    local[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    return torch.from_numpy(local * size + [*corner, 0.3]).float()


def road_between_walls() -> Tensor:
    """Return ground that is seen in a strip of 3 m: its slope along y is unknown."""
    xyz = road((0.0, 0.05), count=60_000)
    return xyz[xyz[:, 1].abs() < 1.5]


def hidden_behind(points: Tensor, x: float, y_range: tuple[float, float]) -> Tensor:
    """Return the points that a screen at x, between two y, does not hide from the origin."""
    y = points[:, 1] / points[:, 0].clamp_min(1e-6) * x
    return points[~((points[:, 0] > x) & (y > y_range[0]) & (y < y_range[1]))]


def max_error_m(fit: GroundFit, truth: tuple[float, float, float], range_m: float = 50.0) -> float:
    """Return the largest height error of a fit on a circle."""
    assert fit.plane is not None
    angle = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)
    xy = range_m * torch.stack((angle.cos(), angle.sin()), 1)
    return float((fit.plane.height_at(xy) - (xy[:, 0] * truth[0] + xy[:, 1] * truth[1] + truth[2])).abs().max())


@pytest.mark.parametrize("roll_deg, pitch_deg", [(3.0, 0.0), (0.0, -3.0), (1.0, 0.78), (-2.0, 2.0)])
def test_the_road_of_a_tilted_sensor_is_level_at_50_m(roll_deg: float, pitch_deg: float) -> None:
    upright = torch.cat((road(), block((6.0, -8.0), (10.0, 2.5, 3.5)), block((-20.0, 4.0), (4.5, 1.9, 1.2), 2)))
    zero = torch.zeros((), dtype=torch.float64)
    tilt = Transform.from_rpy(
        torch.zeros(3).double(), zero + math.radians(roll_deg), zero + math.radians(pitch_deg), zero
    )
    fit = fit_ground_plane(tilt.apply(upright))
    assert fit.status is GroundStatus.FOUND and fit.plane is not None
    levelled = fit.plane.levelled_from_points() @ tilt
    angle = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)
    circle = 50.0 * torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), 1)
    assert float(levelled.apply(circle)[:, 2].abs().max()) < 0.1
    # Headings are kept: the smallest rotation.
    assert abs(float(levelled.yaw)) < math.radians(0.2)


def test_an_upright_sensor_on_a_slope_of_4_percent() -> None:
    fit = fit_ground_plane(torch.cat((road((0.04, 0.0)), block((6.0, -8.0), (10.0, 2.5, 3.5)))))
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.04, 0.0, 0.0)) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_level_road_is_level(seed: int) -> None:
    fit = fit_ground_plane(torch.cat((road(seed=seed), block((3.0, 2.0), (12.0, 2.5, 3.5)))))
    assert fit.status is GroundStatus.LEVEL and max_error_m(fit, (0.0, 0.0, 0.0)) < 0.05


def test_the_height_has_no_bias_by_the_lowest_return() -> None:
    fit = fit_ground_plane(road(count=40_000))
    assert fit.plane is not None and abs(fit.plane.height_m) < 0.003


def test_a_wrong_sensor_height_is_found() -> None:
    fit = fit_ground_plane(road() + torch.tensor([0.0, 0.0, -0.3]))
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.0, 0.0, -0.3)) < 0.05


def test_a_truck_beside_the_sensor_hides_one_side() -> None:
    seen = hidden_behind(road((0.0, 0.03)), 2.5, (-6.0, 6.0))
    fit = fit_ground_plane(torch.cat((seen, block((2.5, -6.0), (2.6, 12.0, 3.6)))))
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.0, 0.03, 0.0)) < 0.1


def test_a_facade_on_one_side_and_a_raised_yard_behind_it() -> None:
    xyz = road((0.02, -0.02))
    xyz[xyz[:, 1] > 8, 2] += 0.8
    facade = block((-40.0, 8.0), (80.0, 0.2, 8.0), count=8000)
    fit = fit_ground_plane(torch.cat((xyz, facade)))
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.02, -0.02, 0.0)) < 0.1


def test_a_pole_at_6_m_that_looks_one_way() -> None:
    xyz = road((0.02, 0.01), sector=math.radians(50))
    fit = fit_ground_plane(xyz[xyz[:, 0] > 8])
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.02, 0.01, 0.0)) < 0.1


def test_single_returns_below_the_road_do_not_matter() -> None:
    xyz = road((0.03, 0.0))
    xyz[::200, 2] -= 1.0
    fit = fit_ground_plane(xyz)
    assert fit.status is GroundStatus.FOUND and max_error_m(fit, (0.03, 0.0, 0.0)) < 0.1


@pytest.mark.parametrize(
    "points, status",
    [
        (torch.zeros(0, 3), GroundStatus.FEW_POINTS),
        (torch.full((5000, 3), math.nan), GroundStatus.FEW_POINTS),
        (road(count=30), GroundStatus.FEW_POINTS),
        (road_between_walls(), GroundStatus.ILL_CONDITIONED),
        (road((0.12, 0.0)), GroundStatus.STEEP),
    ],
)
def test_ground_that_is_not_seen_is_not_levelled(points: Tensor, status: GroundStatus) -> None:
    assert fit_ground_plane(points).status is status


def test_roofs_without_any_ground_are_not_a_road() -> None:
    rng = np.random.default_rng(4)
    roofs = [block((float(x), float(y)), (4.5, 1.9, 1.2), 7, 80) for x, y in rng.uniform(-40, 40, (120, 2))]
    lifted = [cloud + torch.tensor([0.0, 0.0, float(z)]) for cloud, z in zip(roofs, rng.uniform(0, 3, 120))]
    assert fit_ground_plane(torch.cat(lifted)).status is not GroundStatus.FOUND


def test_a_crest_under_the_sensor_is_uneven() -> None:
    xyz = road()
    radius = xyz[:, :2].norm(dim=1)
    xyz[:, 2] -= 0.001 * (radius - 8.0).clamp_min(0.0) ** 2 + 0.02 * xyz[:, 0] * (radius > 8)
    assert fit_ground_plane(xyz).status in (GroundStatus.UNEVEN, GroundStatus.FEW_POINTS)


def test_a_fit_is_deterministic_and_does_not_change_its_input() -> None:
    xyz = road((0.02, 0.0))
    before, first, again = xyz.clone(), fit_ground_plane(xyz), fit_ground_plane(xyz)
    assert torch.equal(xyz, before) and first.plane is not None and again.plane is not None
    assert (first.plane.slope_x, first.plane.height_m) == (again.plane.slope_x, again.plane.height_m)


def test_a_levelled_sweep_is_level() -> None:
    xyz = road((0.03, -0.02))
    fit = fit_ground_plane(xyz)
    assert fit.plane is not None
    assert fit_ground_plane(fit.plane.levelled_from_points().apply(xyz)).status is GroundStatus.LEVEL


def test_points_need_three_columns() -> None:
    with pytest.raises(ShapeError, match=r"points \(N, 3\); got \(4, 2\)"):
        fit_ground_plane(torch.zeros(4, 2))


def test_levelling_puts_points_of_the_plane_at_zero_by_a_rotation() -> None:
    plane = GroundPlane(0.05, -0.02, 0.4, np.eye(3))
    motion = plane.levelled_from_points()
    xy = torch.rand(50, 2, dtype=torch.float64) * 80 - 40
    moved = motion.apply(torch.cat((xy, plane.height_at(xy)[:, None]), 1))
    assert float(moved[:, 2].abs().max()) < 1e-12
    assert torch.allclose(motion.rotation @ motion.rotation.mT, torch.eye(3).double(), atol=1e-14)
    assert torch.allclose(motion.apply(torch.zeros(1, 3).double())[:, :2], torch.zeros(1, 2).double())


def test_lowest_returns_are_those_of_a_loop_over_cells() -> None:
    xyz = torch.cat((road((0.03, 0.0), count=3000), block((4.0, 4.0), (9.0, 3.0, 3.0)), road()[:500] * 3)).numpy()
    lowest, cell_of_point = kernels.lowest_of_cells(xyz, 2.0, 50.0, 1.0, 0.105)
    by_cell: dict[tuple[int, int], list[int]] = {}
    for p, (x, y, z) in enumerate(xyz.astype(np.float64)):
        if math.hypot(x, y) < 50 and abs(z) <= 1.0 + 0.105 * math.hypot(x, y):
            by_cell.setdefault((int((y + 50) / 2), int((x + 50) / 2)), []).append(p)
    expected = [min(rows, key=lambda p: (xyz[p, 2], p)) for _, rows in sorted(by_cell.items())]
    assert np.array_equal(lowest, xyz[expected].astype(np.float64))
    assert all((cell_of_point[rows] == r * 50 + c).all() for (r, c), rows in by_cell.items())
    assert (cell_of_point >= 0).sum() == sum(map(len, by_cell.values()))


def test_consensus_is_the_best_of_all_planes_by_definition() -> None:
    rng = np.random.default_rng(3)
    places = np.column_stack((rng.uniform(-30, 30, (80, 2)), rng.uniform(-1, 2, 80)))
    places[:50, 2] = 0.03 * places[:50, 0] + 0.02 * rng.standard_normal(50)
    weight, draws, ranges = rng.uniform(0.2, 1, 80), rng.random((60, 3)), np.hypot(*places[:, :2].T)
    scores, planes = [], []
    for draw in [None, *draws]:
        plane = np.zeros(3)
        if draw is not None:
            a, b, c = places[(draw * 79).astype(int)]
            edges = np.stack((b - a, c - a))[:, :2]
            if abs(np.linalg.det(edges)) < 0.2 * max((edges**2).sum(1)):
                continue
            plane[:2] = np.linalg.solve(edges, [b[2] - a[2], c[2] - a[2]])
            plane[2] = a[2] - plane[:2] @ a[:2]
            if np.hypot(*plane[:2]) > 0.1:
                continue
        above = (places[:, 2] - places[:, :2] @ plane[:2] - plane[2]) / (0.15 + 0.006 * ranges)
        scores.append((weight * np.where(above < -1, -0.5, np.clip(1 - above**2, 0, None))).sum())
        planes.append(plane)
    found = kernels.find_consensus(places, weight, ranges, TOLERANCE, draws, 0.1, 0.5)
    assert np.allclose(found, planes[int(np.argmax(scores))], atol=1e-9)


def test_refinement_is_weighted_least_squares_by_the_normal_equations() -> None:
    rng = np.random.default_rng(5)
    places = np.column_stack((rng.uniform(-30, 30, (200, 2)), np.zeros(200)))
    places[:, 2] = 0.02 * places[:, 0] - 0.01 * places[:, 1] + 0.1 + 0.1 * rng.standard_normal(200)
    weight, ranges, plane = rng.uniform(0.2, 1, 200), np.hypot(*places[:, :2].T), np.zeros(3)
    terms, weights = np.column_stack((places[:, :2], np.ones(200))), weight
    for _ in range(4):
        u = (places[:, 2] - terms @ plane) / (0.15 + 0.006 * ranges)
        weights = weight * np.clip(1 - u**2, 0, None) ** 2
        plane = np.linalg.solve(terms.T @ (weights[:, None] * terms), terms.T @ (weights * places[:, 2]))
    found, last = kernels.refine(places, weight, ranges, TOLERANCE, np.zeros(3), 4)
    assert np.allclose(found, plane, atol=1e-10) and np.allclose(last, weights, atol=1e-10)


def test_means_of_cells_are_those_of_a_loop_over_points() -> None:
    xyz = road((0.03, 0.0), count=2000).numpy()
    _, cell_of_point = kernels.lowest_of_cells(xyz, 2.0, 50.0, 1.0, 0.105)
    plane, tolerance = np.array([0.03, 0.0, 0.01]), kernels.Tolerance(0.01, 0.0005)
    rows: dict[int, list[int]] = {}
    for p, (x, y, z) in enumerate(xyz.astype(np.float64)):
        if cell_of_point[p] >= 0 and abs(z - plane @ (x, y, 1)) <= 0.01 + 0.0005 * math.hypot(x, y):
            rows.setdefault(int(cell_of_point[p]), []).append(p)
    expected = np.stack([xyz[p].astype(np.float64).mean(0) for _, p in sorted(rows.items())])
    assert np.allclose(kernels.mean_of_cells(xyz, cell_of_point, 2500, plane, tolerance), expected, atol=1e-12)


def test_a_fitted_covariance_covers_the_error_of_repeated_fits() -> None:
    fits = [fit_ground_plane(road((0.03, 0.0), seed, 4000)).plane for seed in range(12)]
    errors = np.array([(p.slope_x - 0.03, p.slope_y, p.height_m) for p in fits if p is not None])
    sigma = np.sqrt(np.mean([np.diag(p.covariance) for p in fits if p is not None], 0))
    assert len(errors) == 12 and (np.abs(errors) < 3 * sigma).all()


@pytest.mark.skipif(not (DATA / "lidar_pair").is_dir(), reason="needs ../shared/data/lidar_pair")
def test_two_real_scans_of_one_place_have_one_ground() -> None:
    def read(name: str) -> Tensor:
        raw = (DATA / "lidar_pair" / f"{name}.ply").read_bytes()
        head, body = raw.split(b"end_header\n", 1)
        width = 4 * head.count(b"property float")
        return torch.from_numpy(np.frombuffer(body, np.float32).reshape(-1, width // 4)[:, :3].copy())

    values = np.loadtxt(DATA / "lidar_pair" / "T_target_source.txt")
    target_from_source = Transform.from_matrix(values.reshape(4, 4))
    source, target = read("source"), read("target")
    lift = torch.tensor([0.0, 0.0, -float(np.percentile(source[:, 2].numpy(), 5))])
    fits = [fit_ground_plane(cloud + lift) for cloud in (source, target_from_source.apply(source), target)]
    assert all(fit.plane is not None for fit in fits)
    there, moved = fits[2].plane, fits[1].plane
    assert there is not None and moved is not None
    assert math.hypot(there.slope_x - moved.slope_x, there.slope_y - moved.slope_y) < math.radians(0.5)


def test_weighted_moments_are_those_of_matrices() -> None:
    rng = np.random.default_rng(7)
    places, weight = rng.normal(0, 20, (60, 3)), rng.random(60)
    plane = np.array([0.02, -0.01, 0.3])
    once, twice, mean_square = kernels.weighted_moments(places, weight, plane)
    terms = np.column_stack((places[:, :2], np.ones(60)))
    np.testing.assert_allclose(once, terms.T @ np.diag(weight) @ terms, rtol=1e-9)
    np.testing.assert_allclose(twice, terms.T @ np.diag(weight) ** 2 @ terms, rtol=1e-9)
    assert mean_square == pytest.approx(np.average((places[:, 2] - terms @ plane) ** 2, weights=weight))
    ranges, falling = kernels.ring_weights(places, 5.0)
    np.testing.assert_allclose(ranges, np.hypot(places[:, 0], places[:, 1]))
    np.testing.assert_allclose(falling, np.where(ranges > 5.0, 5.0 / ranges, 1.0))


def test_the_height_sigma_is_that_of_the_worst_direction() -> None:
    root = np.random.default_rng(8).normal(size=(3, 3)) * (1e-3, 2e-3, 0.02)
    covariance = root.T @ root
    plane = GroundPlane(0.0, 0.0, 0.0, covariance)
    slope_sigma = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    assert plane.height_sigma_m(30.0) == pytest.approx(math.sqrt(covariance[2, 2]) + 30.0 * slope_sigma)
