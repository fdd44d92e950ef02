# SPDX-License-Identifier: Apache-2.0
"""What one sweep shows of its sensor: number of beams, returns, intensity; and whether a detector was trained on such sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from manyeyes.datatypes import PointCloud

_ELEVATION_BIN_RAD = math.radians(0.05)
_MIN_RANGE_M = 4.0
"""Nearer returns do not tell beams apart, since an error of the sensor's height changes their elevations."""
_MIN_PEAK_FRACTION = 0.15
"""Minimum height of a peak of the histogram of elevations, relative to the median of its peaks."""


@dataclass(frozen=True)
class SweepStatistics:
    """What one sweep shows of its sensor.

    Attributes:
        num_points: number of returns.
        num_beams: number of beams that returned something, estimated from elevations; 0 without distant returns.
        intensity_median: in [0, 1].
        intensity_spread: difference of the 90th and 10th percentiles.
        num_intensity_levels: number of different intensities.
        sensor_height_m: of the sensor above the road.
    """

    num_points: int
    num_beams: int
    intensity_median: float
    intensity_spread: float
    num_intensity_levels: int
    sensor_height_m: float


def measure_sweep(points: PointCloud, sensor_height_m: float) -> SweepStatistics:
    """Measure a sweep in the agent's frame, whose sensor is sensor_height_m above the origin."""
    if not len(points):
        return SweepStatistics(0, 0, 0.0, 0.0, 0, sensor_height_m)
    low, median, high = torch.quantile(_thin(points.intensity), points.intensity.new_tensor([0.1, 0.5, 0.9])).tolist()
    return SweepStatistics(
        len(points),
        count_beams(points, sensor_height_m),
        median,
        high - low,
        int(points.intensity.unique().numel()),
        sensor_height_m,
    )


def _thin(values: torch.Tensor, max_count: int = 1 << 20) -> torch.Tensor:
    """Return every n-th value; torch refuses quantiles of more than 16 million."""
    return values[:: max(1, math.ceil(len(values) / max_count))]


def count_beams(points: PointCloud, sensor_height_m: float) -> int:
    """Estimate the number of beams: the peaks of the histogram of elevations, seen from the sensor."""
    xyz = points.xyz.numpy().astype(np.float64)
    ground_range = np.hypot(xyz[:, 0], xyz[:, 1])
    far = ground_range > _MIN_RANGE_M
    elevation = np.arctan2(xyz[far, 2] - sensor_height_m, ground_range[far])
    if not len(elevation):
        return 0
    count = np.bincount(((elevation + math.pi / 2) / _ELEVATION_BIN_RAD).astype(np.int64))
    smooth = np.convolve(count, (0.5, 1.0, 0.5), mode="full")
    inner = smooth[1:-1]
    peaks = inner[(inner > smooth[:-2]) & (inner >= smooth[2:])]
    if not len(peaks):
        return 0
    return int((peaks >= _MIN_PEAK_FRACTION * np.median(peaks)).sum())


Bounds = tuple[float, float]


@dataclass(frozen=True)
class SensorDomain:
    """Bounds of the sensors that a detector was trained on.

    Attributes:
        num_beams: minimum and maximum.
        intensity_median: minimum and maximum, over the sweeps as they were presented in training.
        sensor_height_m: minimum and maximum.
        period_s: minimum and maximum time between two sweeps.
    """

    num_beams: Bounds
    intensity_median: Bounds
    sensor_height_m: Bounds
    period_s: Bounds

    @classmethod
    def of(
        cls, sweeps: Sequence[SweepStatistics], periods_s: Sequence[float], any_intensity: bool
    ) -> SensorDomain | None:
        """Return the bounds of some sweeps; None without sweeps or periods. any_intensity: intensity laws were drawn."""
        if not sweeps or not periods_s:
            return None
        medians = [0.0, 1.0] if any_intensity else [sweep.intensity_median for sweep in sweeps]
        beams, heights = [float(s.num_beams) for s in sweeps], [s.sensor_height_m for s in sweeps]
        return cls(*((min(values), max(values)) for values in (beams, medians, heights, periods_s)))

    def find_deviations(self, sweep: SweepStatistics, period_s: float | None = None) -> list[str]:
        """Describe in what a sweep lies outside of the bounds, with a tolerance.

        Args:
            sweep: of a sensor.
            period_s: time between two of its sweeps; None where it has one.
        """
        found = []
        low, high = self.num_beams
        if not low / 1.5 <= sweep.num_beams <= high * 1.5:
            found.append(f"{sweep.num_beams} beams (trained on {low:.0f} to {high:.0f})")
        low, high = self.intensity_median
        if not low - 0.1 <= sweep.intensity_median <= high + 0.1:
            found.append(f"median intensity {sweep.intensity_median:.2f} (trained on {low:.2f} to {high:.2f})")
        low, high = self.sensor_height_m
        if not low - 0.5 <= sweep.sensor_height_m <= high + 0.5:
            found.append(f"sensor at {sweep.sensor_height_m:.1f} m (trained on {low:.1f} to {high:.1f} m)")
        low, high = self.period_s
        if period_s is not None and not low / 1.5 <= period_s <= high * 1.5:
            found.append(f"a sweep every {period_s:.2f} s (trained on {low:.2f} to {high:.2f} s)")
        return found
