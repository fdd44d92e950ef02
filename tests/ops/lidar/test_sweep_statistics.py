# SPDX-License-Identifier: Apache-2.0
"""Statistics of sweeps of known sensors, and deviations from bounds."""

import math

import pytest
import torch

from manyeyes.datatypes import PointCloud
from manyeyes.ops.lidar.sweep_statistics import SensorDomain, SweepStatistics, count_beams, measure_sweep


def sweep(num_beams: int, height_m: float = 1.9, lower_deg: float = -25.0, upper_deg: float = 5.0) -> PointCloud:
    """Rays of evenly spread beams to a road and to a wall 30 m away, with 2 cm of range noise."""
    elevation = torch.deg2rad(torch.linspace(lower_deg, upper_deg, num_beams))
    azimuth = torch.linspace(-math.pi, math.pi, 300)
    ray = torch.stack(
        (
            elevation.cos()[:, None] * azimuth.cos(),
            elevation.cos()[:, None] * azimuth.sin(),
            elevation.sin()[:, None].expand(-1, 300),
        ),
        -1,
    ).reshape(-1, 3)
    to_road = torch.where(ray[:, 2] < -1e-3, -height_m / ray[:, 2], 1e9)
    to_wall = 30.0 / ray[:, :2].norm(dim=1)
    noise = 0.02 * torch.randn(len(ray), generator=torch.Generator().manual_seed(0))
    xyz = ray * (torch.minimum(to_road, to_wall) + noise)[:, None] + torch.tensor([0.0, 0.0, height_m])
    return PointCloud.of(xyz, torch.linspace(0, 1, len(ray)))


@pytest.mark.parametrize("num_beams", [16, 32, 64, 128])
def test_beams_are_counted(num_beams):
    assert count_beams(sweep(num_beams), 1.9) == pytest.approx(num_beams, rel=0.15)


def test_a_wrong_height_of_the_sensor_changes_the_count_little():
    assert count_beams(sweep(32), 2.1) == pytest.approx(32, rel=0.4)


def test_statistics_of_a_known_sweep():
    found = measure_sweep(sweep(16), 1.9)
    assert found.num_points == 16 * 300 and found.num_intensity_levels == 16 * 300
    assert found.intensity_median == pytest.approx(0.5, abs=0.01)
    assert found.intensity_spread == pytest.approx(0.8, abs=0.01) and found.sensor_height_m == 1.9


def test_an_empty_sweep_has_statistics():
    assert measure_sweep(PointCloud.of(torch.zeros(0, 3)), 1.9) == SweepStatistics(0, 0, 0.0, 0.0, 0, 1.9)
    assert count_beams(PointCloud.of(torch.zeros(1, 3)), 1.9) == 0


def statistics(beams: int = 32, intensity: float = 0.2, height_m: float = 1.9) -> SweepStatistics:
    return SweepStatistics(20_000, beams, intensity, 0.1, 200, height_m)


DOMAIN = SensorDomain.of([statistics(16, 0.1), statistics(64, 0.3, 2.2)], [0.1, 0.05], any_intensity=False)


def test_bounds_are_those_of_the_sweeps():
    assert SensorDomain((16.0, 64.0), (0.1, 0.3), (1.9, 2.2), (0.05, 0.1)) == DOMAIN
    mixed = SensorDomain.of([statistics()], [0.1], any_intensity=True)
    assert mixed is not None and mixed.intensity_median == (0.0, 1.0)
    assert SensorDomain.of([], [0.1], False) is None and SensorDomain.of([statistics()], [], False) is None


@pytest.mark.parametrize(
    ("sweep", "period_s", "word"),
    [
        (statistics(beams=8), 0.1, "8 beams"),
        (statistics(beams=128), 0.1, "128 beams"),
        (statistics(intensity=0.8), 0.1, "intensity 0.80"),
        (statistics(height_m=6.0), 0.1, "6.0 m"),
        (statistics(), 0.5, "0.50 s"),
    ],
)
def test_each_deviation_is_named_alone(sweep, period_s, word):
    assert DOMAIN is not None
    found = DOMAIN.find_deviations(sweep, period_s)
    assert len(found) == 1 and word in found[0] and "trained on" in found[0]


def test_what_lies_within_the_bounds_is_not_named():
    assert DOMAIN is not None
    assert DOMAIN.find_deviations(statistics(), 0.1) == [] == DOMAIN.find_deviations(statistics(), None)
