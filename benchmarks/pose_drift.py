# SPDX-License-Identifier: Apache-2.0
"""The pose monitor on autocorrelated errors: false alarms, and the smallest drift that is detected, beside an oracle's.

Innovations are an autoregressive process of first order, of the stated standard deviation, around a constant error within the
prior's covariance. *False alarms*: fraction of windows of 30 s at 10 Hz in which a sound agent is reported, after 10 s without a
window. *Smallest drift*: the slope that is reported in 95 % of runs within so many frames after 100 sound ones; the oracle, a
likelihood ratio, knows the noise and the begin. *Offset*: power of the test of one frame, and frames in which the monitor
reports one. The monitor does not know the autocorrelation.

python -m benchmarks.pose_drift [--runs 240] [--out benchmarks/results/pose_drift.json]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.pose_real import Line, make_rate_line, write_lines
from numpy.typing import NDArray
from scipy.stats import ncx2

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.corrector import CHI2_3DOF_P001
from manyeyes.pose.drift_test import find_drift
from manyeyes.pose.pose_monitor import PoseHealth, PoseMonitorConfig, PoseMonitorState, update_monitor
from manyeyes.pose.types import PosePrior, PoseStatus, no_estimate

Floats = NDArray[np.float64]

AUTOCORRELATIONS = (0.0, 0.3, 0.5, 0.7, 0.9)
ORACLE = {0.0: (0.20, 0.076, 0.038), 0.5: (0.33, 0.13, 0.065), 0.9: (0.59, 0.27, 0.15)}
"""Smallest drift (m/s) that the oracle detects with power 0.95 within DRIFT_FRAMES, for errors of ORACLE_SIGMA_M."""
ORACLE_SIGMA_M, DRIFT_FRAMES, SOUND_FRAMES, PERIOD_S = 0.30, (30, 60, 100), 100, 0.1
WARM_UP_FRAMES, WINDOW_FRAMES = 100, 300


def make_noise(runs: int, frames: int, autocorrelation: float, *key: int | str) -> Floats:
    """Return (runs, frames, 3) autoregressive noise of unit variance."""
    steps = keyed_generator("pose drift", *key).standard_normal((runs, frames, 3))
    noise = steps.copy()
    for t in range(1, frames):
        noise[:, t] = autocorrelation * noise[:, t - 1] + np.sqrt(1 - autocorrelation**2) * steps[:, t]
    return noise


def run_monitor(innovations: Floats, sigma: Floats, prior: PosePrior) -> list[PoseHealth]:
    """Return the health after every frame of innovations (N, 3) with standard deviations (3,)."""
    state, health, template = PoseMonitorState.new(), list[PoseHealth](), no_estimate(prior, PoseStatus.OK)
    for n, innovation in enumerate(innovations):
        estimate = replace(template, measured=prior.pose + innovation, measured_covariance=np.diag(sigma**2), inliers=6)
        state, report = update_monitor(state, estimate, prior, n * PERIOD_S)
        health.append(report.health)
    return health


def false_alarms(runs: int) -> Iterator[Line]:
    """Yield the fraction of windows with a false alarm, of a whole monitor."""
    sigma, prior = np.array([0.15, 0.15, 0.003]), PosePrior.of([20.0, -5.0, 1.0], 0.5, 0.01)
    for autocorrelation in AUTOCORRELATIONS:
        noise = (
            make_noise(runs, WARM_UP_FRAMES + WINDOW_FRAMES, autocorrelation, "sound", int(100 * autocorrelation))
            * sigma
        )
        bias = keyed_generator("pose drift", "bias").standard_normal((runs, 1, 3)) * [0.5, 0.5, 0.01]
        drifts, offsets = [], []
        for run in noise + bias:
            health = run_monitor(run, sigma, prior)[WARM_UP_FRAMES:]
            drifts.append(PoseHealth.DRIFTING in health)
            offsets.append(PoseHealth.OFFSET in health)
        what = f"windows of 30 s, autocorrelation {autocorrelation:g}"
        yield make_rate_line(f"{what}: drift of a sound agent", drifts, (None, 0.01))
        yield make_rate_line(f"{what}: drift or offset of a sound agent", np.array(drifts) | offsets, (None, None))


def smallest_drifts(runs: int) -> Iterator[Line]:
    """Yield the power at 1.0 and 1.3 times the oracle's smallest drift; the target is 0.95 at 1.3 times."""
    config = PoseMonitorConfig()
    for autocorrelation, slopes in ORACLE.items():
        for frames, slope in zip(DRIFT_FRAMES, slopes):
            total = SOUND_FRAMES + frames
            noise = ORACLE_SIGMA_M * make_noise(
                runs, total, autocorrelation, "drift", frames, int(100 * autocorrelation)
            )
            elapsed = np.maximum(np.arange(total) - (SOUND_FRAMES - 1), 0) * PERIOD_S
            for factor in (1.0, 1.3):
                moved = noise.copy()
                moved[:, :, 0] += factor * slope * elapsed
                detected = np.zeros(runs, bool)
                for end in range(total, SOUND_FRAMES + frames // 2, -3):
                    first = max(end - config.max_frames, 0)
                    time_s = np.arange(first, end) * PERIOD_S
                    stated = np.full(3, ORACLE_SIGMA_M**2)
                    found = find_drift(moved[:, first:end], time_s, stated, config.min_drift_frames)
                    detected |= config.is_drift(found)
                what = f"drift of {factor:g} x {slope:g} m/s, sigma {ORACLE_SIGMA_M:g} m, autocorrelation {autocorrelation:g}"
                yield make_rate_line(
                    f"{what}, {frames} frames: detected", detected, (0.95 if factor == 1.3 else None, None)
                )


def offsets(runs: int) -> Iterator[Line]:
    """Yield the power of the test of one frame: by chi^2 with 3 degrees of freedom, which nothing exceeds at its p-value, and as
    the monitor reports it. Offsets are in standard deviations of measurement and prior together, along x.
    """
    sigma, prior = np.array([0.15, 0.15, 0.003]), PosePrior.of([20.0, -5.0, 1.0], 0.5, 0.01)
    joint = np.sqrt(sigma**2 + np.diag(prior.covariance))
    for number, sigmas in enumerate((5.0, 5.5, 6.5, 1.3 * 5.5)):
        what = f"offset of {sigmas:g} sigma in one frame, p = 0.001"
        power = float(ncx2.sf(CHI2_3DOF_P001, 3, sigmas**2))
        yield Line(f"{what}: power of the oracle", power, power, power, 0, "", None)
        noise = keyed_generator("pose drift", "offset", number).standard_normal((runs, 3)) * joint
        moved = noise + np.array([sigmas * joint[0], 0.0, 0.0])
        reported = [run_monitor(one[None], sigma, prior)[0] is PoseHealth.OFFSET for one in moved]
        yield make_rate_line(f"{what}: reported", reported, (0.95 if sigmas > 6.5 else None, None))


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=240)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_drift.json"))
    options = parser.parse_args()
    lines = []
    for table in (offsets(options.runs), smallest_drifts(options.runs // 2), false_alarms(options.runs)):
        for line in table:
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
            lines.append(line)
    write_lines(options.out, "pose_drift", lines, 0)


if __name__ == "__main__":
    main()
