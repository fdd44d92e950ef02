# SPDX-License-Identifier: Apache-2.0
"""The drift test against a slow reference, its false alarms, and the smallest drift that it detects against the oracle's."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.pose.drift_test import CORRELATIONS, DriftTest, find_drift
from manyeyes.pose.pose_monitor import PoseMonitorConfig


def make_noise(runs: int, frames: int, autocorrelation: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal((runs, frames, 3))
    noise = steps.copy()
    for t in range(1, frames):
        noise[:, t] = autocorrelation * noise[:, t - 1] + np.sqrt(1 - autocorrelation**2) * steps[:, t]
    return noise


def find_slowly(
    residuals: np.ndarray, time_s: np.ndarray, stated: np.ndarray, min_frames: int
) -> tuple[float, np.ndarray]:
    """Return the same by generalised least squares with the full covariance of the noise."""
    n = len(time_s)
    lags = np.abs(np.subtract.outer(time_s, time_s)) / np.median(np.diff(time_s))
    level, best = -np.inf, (-np.inf, np.zeros(3))
    begins = time_s[: n - min_frames + 1][:: -max((n - min_frames) // 20, 1)]

    def fit(design: np.ndarray, y: np.ndarray, information: np.ndarray, variance: float) -> tuple[float, float]:
        solution = np.linalg.solve(design.T @ information @ design, design.T @ information @ y)
        rest = y - design @ solution
        square = rest @ information @ rest
        size = np.linalg.slogdet(information)[1]
        return -(n + 10) / 2 * np.log((square + 10 * variance) / (n + 10)) + size / 2, solution[-1]

    for correlation in CORRELATIONS:
        information = np.linalg.inv(correlation**lags)
        ones = np.ones((n, 1))
        flat = [fit(ones, residuals[:, d], information, stated[d])[0] for d in range(3)]
        level = max(level, sum(flat))
        for begin in begins:
            design = np.column_stack((ones, np.maximum(time_s - begin, 0.0)))
            drifted, slope = zip(*(fit(design, residuals[:, d], information, stated[d]) for d in range(3)))
            for value in (drifted[0] + drifted[1] + flat[2], flat[0] + flat[1] + drifted[2]):
                if value > best[0]:
                    best = value, np.array(slope)
    return float(np.sqrt(2 * max(best[0] - level, 0.0))), best[1]


@pytest.mark.parametrize("drift", [0.0, 0.3])
def test_the_test_is_a_likelihood_ratio_of_generalised_least_squares(drift: float) -> None:
    residuals = make_noise(1, 40, 0.6, 3)[0]
    time_s = np.arange(40) * 0.2
    residuals[:, 0] += drift * np.maximum(time_s - 4.0, 0.0) * 3
    stated = np.array([0.5, 1.0, 2.0])
    found = find_drift(residuals, time_s, stated, 8)
    sigmas, slope = find_slowly(residuals, time_s, stated, 8)
    assert found.sigmas == pytest.approx(sigmas, abs=1e-6)
    np.testing.assert_allclose(found.slope, slope, atol=1e-9)


def test_a_missing_frame_lowers_the_correlation_across_the_gap() -> None:
    residuals, keep = make_noise(1, 60, 0.8, 4)[0], np.arange(60) % 7 != 3
    time_s = np.arange(60) * 0.1
    found = find_drift(residuals[keep], time_s[keep], np.ones(3), 10)
    sigmas, _ = find_slowly(residuals[keep], time_s[keep], np.ones(3), 10)
    assert found.sigmas == pytest.approx(sigmas, abs=1e-6)


def test_batches_units_and_the_start_of_time_change_nothing() -> None:
    residuals, time_s = make_noise(3, 50, 0.5, 5), np.arange(50) * 0.1
    together = find_drift(residuals, time_s, np.ones(3), 10)
    alone = find_drift(residuals[1] * 7.0 + 3.0, time_s + 1e6, np.full(3, 49.0), 10)
    assert together.sigmas.shape == (3,) and alone.sigmas == pytest.approx(together.sigmas[1], abs=1e-5)
    np.testing.assert_allclose(alone.slope, 7 * together.slope[1], atol=1e-5)


@pytest.mark.parametrize(("autocorrelation", "slope"), [(0.0, 0.20), (0.5, 0.33), (0.9, 0.59)])
def test_drifts_of_thirteen_tenths_of_the_oracle_are_detected_in_thirty_frames(
    autocorrelation: float, slope: float
) -> None:
    """slope: what an oracle with known noise and begin detects in 95 % of runs, for errors of 0.3 m, in m/s."""
    time_s = np.arange(130) * 0.1
    residuals = 0.3 * make_noise(60, 130, autocorrelation, 6)
    sound = find_drift(residuals, time_s, np.full(3, 0.09), 10)
    residuals[:, :, 1] += 1.3 * slope * np.maximum(time_s - time_s[99], 0.0)
    found = find_drift(residuals, time_s, np.full(3, 0.09), 10)
    config = PoseMonitorConfig()
    assert np.mean(config.is_drift(found)) >= 0.93 and not config.is_drift(sound).any()
    assert np.median(found.slope[:, 1]) == pytest.approx(1.3 * slope, rel=0.25)


def test_the_limit_of_a_drift_is_lower_for_strongly_correlated_errors() -> None:
    sigmas, correlation = np.array([5.0, 5.0, 5.3, 4.8]), np.array([0.7, 0.8, 0.0, 0.95])
    found = DriftTest(sigmas, np.zeros((4, 3)), correlation)
    assert PoseMonitorConfig().is_drift(found).tolist() == [False, True, True, False]


@pytest.mark.parametrize("gate", [0.0, -1.0])
def test_the_limit_of_correlated_errors_is_above_zero(gate: float) -> None:
    with pytest.raises(ConfigError, match="gates above 0"):
        PoseMonitorConfig(correlated_drift_gate_sigmas=gate)
