# SPDX-License-Identifier: Apache-2.0
"""Velocity estimation: the fit is that of least squares, and insignificant velocities are 0."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from manyeyes.agents.velocity import PastDetections, VelocityConfig, estimate_velocities
from manyeyes.datatypes import Boxes, PointCloud, Transform

CONFIG = VelocityConfig()
EXACT = VelocityConfig(sigma_position_m=1e-3)
"""Positions with a standard deviation of millimetres: the detector's velocity has no weight."""


def cars(xy: list[tuple[float, float]] | Tensor, yaw: float = 0.0, velocity: Tensor | None = None) -> Boxes:
    """Cars at the places given, all headed alike."""
    place = torch.as_tensor(xy, dtype=torch.float32).reshape(-1, 2)
    n = len(place)
    center = torch.cat((place, torch.full((n, 1), 0.8)), 1)
    return Boxes.of(center, torch.tensor([4.5, 1.9, 1.6]).repeat(n, 1), torch.full((n,), yaw), velocity=velocity)


def with_sigma(boxes: Boxes, sigma_m: float) -> Boxes:
    """The same boxes with a position standard deviation."""
    return replace(boxes, sigma_xy=torch.full((len(boxes),), sigma_m))


def drive(
    velocity: tuple[float, float], instants: int, start: tuple[float, float] = (0.0, 0.0)
) -> list[PastDetections]:
    """One car's last so many instants, a tenth of a second apart, newest first; it is at ``start`` now."""
    times = [0.1 * (k + 1) for k in range(instants)]
    return [PastDetections(cars([(start[0] - velocity[0] * t, start[1] - velocity[1] * t)]), t) for t in times]


def test_constant_velocity_is_recovered() -> None:
    assert estimate_velocities(cars([(0, 0)]), drive((8, 0), 5), EXACT)[0].tolist() == pytest.approx([8, 0], abs=1e-3)


def test_two_places_by_hand() -> None:
    """1 m in 0.1 s, sigma of a place s = 0.25: slope 10 with variance 2 s^2 / 0.01 = 12.5; stated 2 with variance 16."""
    now = cars([(0, 0)], velocity=torch.tensor([[2.0, 0.0]]))
    want = (10 / 12.5 + 2 / 16) / (1 / 12.5 + 1 / 16)
    config = VelocityConfig(sigma_position_m=0.25, sigma_detected_velocity_mps=4.0, min_z_score=0.0)
    assert estimate_velocities(now, drive((10, 0), 1), config)[0].tolist() == pytest.approx([want, 0], abs=1e-4)


def plain_line(
    now: Boxes, known: list[tuple[Tensor, int, float]], config: VelocityConfig
) -> tuple[Callable[[float], Tensor], Tensor]:
    """Slow twin for one box: one line by least squares, a row for everything known; its place at a time, and its velocity.

    known: place, sweeps ago, standard deviation of the box; the current one first.
    """
    ahead = torch.stack((now.yaw.cos(), now.yaw.sin()), 1)[0].double()
    aside = torch.stack((-ahead[1], ahead[0]))
    rows, goals = [], []
    for place, k, box_sigma in known:
        sigma = math.hypot(config.sigma_position_m, box_sigma)
        for axis in range(2):
            row = torch.zeros(4).double()
            row[axis], row[2 + axis] = 1, -0.1 * k
            rows.append(row / sigma)
            goals.append(place[axis].double() / sigma)
    stated = now.velocity[0].double() @ ahead
    for direction, goal, sigma in (
        (ahead, stated, config.sigma_detected_velocity_mps),
        (aside, 0.0, config.sigma_lateral_velocity_mps),
    ):
        rows.append(torch.cat((torch.zeros(2).double(), direction)) / sigma)
        goals.append(torch.as_tensor(goal / sigma).double())
    line = torch.linalg.lstsq(torch.stack(rows), torch.stack(goals)[:, None]).solution[:, 0]
    return lambda t: line[:2] + line[2:] * t, line[2:]


@pytest.mark.parametrize("seed", range(5))
def test_the_line_fit_is_least_squares(seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    velocity = torch.tensor([12.0, -4.0])
    places = [-velocity * 0.1 * (k + 1) + 0.2 * torch.randn(2, generator=rng) for k in range(4)]
    now = cars([(0, 0)], yaw=float(torch.randn(1, generator=rng)), velocity=torch.randn(1, 2, generator=rng) * 5 + 8)
    sigmas = torch.rand(5, generator=rng).tolist()
    config = VelocityConfig(gate_m=9.0, min_speed_mps=0.0, min_z_score=0.0)
    then = [PastDetections(with_sigma(cars(p[None]), sigmas[k + 1]), 0.1 * (k + 1)) for k, p in enumerate(places)]
    got = estimate_velocities(with_sigma(now, sigmas[0]), then, config)[0]
    known = [(place, k, sigmas[k]) for k, place in enumerate([now.center[0, :2], *places])]
    assert torch.allclose(got.double(), plain_line(now, known, config)[1], atol=1e-3)


def plain_partners(expected: Tensor, places: Tensor, gate_m: float) -> list[int | None]:
    """Slow twin of the association: mutual nearest neighbours within the gate."""
    apart = (expected[:, None].double() - places[None].double()).norm(dim=2)
    nearest = apart.argmin(1).tolist()
    return [
        j if int(apart[:, j].argmin()) == i and float(apart[i, j]) <= gate_m else None for i, j in enumerate(nearest)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_velocities_of_many_boxes_are_those_of_the_slow_twin(seed: int) -> None:
    """Earlier boxes are in their own frames; one in four is missing, the first box's always, and false ones lie between."""
    rng = torch.Generator().manual_seed(seed)
    config = VelocityConfig(min_speed_mps=0.0, min_z_score=0.0)
    count, drive = 24, torch.tensor([9.0, 2.0])
    spots = torch.cat((torch.tensor([[60.0, 60.0]]), torch.rand(count - 1, 2, generator=rng) * 60 - 30))
    now = cars(spots, 0.4, drive + torch.randn(count, 2, generator=rng))
    now = replace(now, sigma_xy=0.3 * torch.rand(count, generator=rng))
    past, known = [], [[(now.center[i, :2], 0, float(now.sigma_xy[i]))] for i in range(count)]
    velocity = [plain_line(now[i : i + 1], known[i], config)[1] for i in range(count)]
    for k in range(1, 6):
        kept = (torch.rand(count, generator=rng) > 0.25) & (torch.arange(count) > 0)
        places = now.center[kept, :2] - 0.1 * k * drive + 0.1 * torch.randn(int(kept.sum()), 2, generator=rng)
        places = torch.cat((places, torch.rand(8, 2, generator=rng) * 60 - 30))
        then = replace(cars(places), sigma_xy=0.3 * torch.rand(len(places), generator=rng))
        motion = Transform.from_xyz_yaw(0.8 * k, -0.1 * k, 0.0, 0.03 * k)
        there = then.to(torch.float64).transform(motion.inverse()).to(torch.float32)
        past.append(PastDetections(there, 0.1 * k, now_from_then=motion))
        expected = torch.stack([plain_line(now[i : i + 1], known[i], config)[0](-0.1 * k) for i in range(count)])
        for i, j in enumerate(plain_partners(expected, places, config.gate_m)):
            if j is not None:
                known[i].append((places[j], k, float(then.sigma_xy[j])))
                velocity[i] = plain_line(now[i : i + 1], known[i], config)[1]
    assert min(map(len, known)) == 1 and max(map(len, known)) == 6
    got = estimate_velocities(now, past, config)
    for i, rows in enumerate(known):
        want = velocity[i] if len(rows) > 1 else now.velocity[i].double()
        assert torch.allclose(got[i].double(), want, atol=1e-3), (i, got[i], want)


def test_velocities_turn_with_the_frame() -> None:
    rng = torch.Generator().manual_seed(1)
    now = cars(torch.rand(6, 2, generator=rng) * 60, 0.3, torch.randn(6, 2, generator=rng) * 6)
    then = [
        PastDetections(cars(now.center[:, :2] - now.velocity * t + 0.1 * torch.randn(6, 2, generator=rng), 0.3), t)
        for t in (0.1, 0.2, 0.3)
    ]
    turn = Transform.from_xyz_yaw(20.0, -7.0, 0.0, 2.1)
    moved = [PastDetections(e.boxes.to(torch.float64).transform(turn).to(torch.float32), e.age_s) for e in then]
    elsewhere = now.to(torch.float64).transform(turn).to(torch.float32)
    a, b = estimate_velocities(now, then, CONFIG), estimate_velocities(elsewhere, moved, CONFIG)
    c, s = math.cos(2.1), math.sin(2.1)
    assert torch.allclose(a @ torch.tensor([[c, s], [-s, c]]), b, atol=1e-3) and a.norm(dim=1).max() > 3


def test_a_stationary_car_has_velocity_zero() -> None:
    """Positions jitter by 5 cm and the detector gives 1.5 m/s: insignificant over half a second, undecided in one sweep."""
    rng = torch.Generator().manual_seed(2)
    now = cars([(5, 5)], velocity=torch.tensor([[1.5, 0.0]]))
    then = [
        PastDetections(cars(torch.tensor([[5.0, 5.0]]) + 0.05 * torch.randn(1, 2, generator=rng)), 0.1 * k)
        for k in range(1, 6)
    ]
    assert estimate_velocities(now, then, CONFIG).tolist() == [[0, 0]]


def test_without_history_the_predicted_velocity_is_kept() -> None:
    now = cars([(0, 0), (9, 9)], velocity=torch.tensor([[6.0, 1.0], [0.1, 0.0]]))
    for nothing in ([], [PastDetections(Boxes.empty(), 0.1)]):
        assert torch.equal(estimate_velocities(now, nothing, CONFIG), now.velocity)
    assert estimate_velocities(Boxes.empty(), drive((8, 0), 3), CONFIG).shape == (0, 2)


def test_a_place_out_of_reach_is_another_car() -> None:
    """Only the car that could have come from there is drawn; a lone box 3 m aside is not its past."""
    now = cars([(0, 0)], velocity=torch.tensor([[6.0, 0.0]]))
    far = [PastDetections(cars([(0, 3)]), 0.1), PastDetections(cars([(0, 3)]), 0.2)]
    assert estimate_velocities(now, far, CONFIG)[0].tolist() == pytest.approx([6, 0], abs=1e-4)


def test_neighbours_keep_their_own_past_and_a_gap_is_bridged() -> None:
    """Two cars abreast, one overtakes; one sweep shows neither."""
    first, second = drive((12, 0), 5, (0, 0)), drive((4, 0), 5, (0, 3.2))
    both = [PastDetections(Boxes.cat([b.boxes, a.boxes]), a.age_s) for a, b in zip(first, second)]
    del both[1]
    stated = torch.tensor([[9.0, 0.0], [6.0, 0.0]])
    got = estimate_velocities(cars([(0, 0), (0, 3.2)], velocity=stated), both, VelocityConfig(sigma_position_m=0.05))
    assert got[:, 0].tolist() == pytest.approx([12, 4], abs=0.1)
    assert got[:, 1].abs().max() < 0.05


def body(middle: float) -> Tensor:
    """(60, 3): what a LiDAR meets of a car's side and of its back, its middle at (middle, 0)."""
    side = torch.stack((torch.linspace(-2.25, 2.25, 40), torch.full((40,), -0.95), torch.full((40,), 1.0)), 1)
    behind = torch.stack((torch.full((20,), -2.25), torch.linspace(-0.95, 0.95, 20), torch.full((20,), 1.0)), 1)
    return torch.cat((side, behind)) + torch.tensor([middle, 0.0, 0.0])


@pytest.mark.parametrize("speed", (6.0, 11.0))
def test_points_correct_a_wrong_longitudinal_speed(speed: float) -> None:
    """Boxes creep ahead by 15 cm a sweep, which is 1.5 m/s; points do not."""
    now, earlier = cars([(0.0, 0.0)]), []
    for t in (0.1, 0.2, 0.3, 0.4, 0.5):
        earlier.append(PastDetections(cars([(-(speed + 1.5) * t, 0.0)]), t, PointCloud.of(body(-speed * t))))
    by_boxes = float(estimate_velocities(now, earlier, CONFIG)[0, 0])
    by_points = float(estimate_velocities(now, earlier, CONFIG, body(0.0))[0, 0])
    assert by_boxes > speed + 0.8
    assert by_points == pytest.approx(speed, abs=0.5)


def test_without_points_velocities_follow_from_boxes() -> None:
    now, earlier = cars([(0, 0)]), [replace(e, points=PointCloud.of(torch.zeros(0, 3))) for e in drive((8, 0), 5)]
    assert torch.equal(
        estimate_velocities(now, earlier, CONFIG, torch.zeros(0, 3)), estimate_velocities(now, earlier, CONFIG)
    )
