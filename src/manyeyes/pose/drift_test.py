# SPDX-License-Identifier: Apache-2.0
"""Test a sequence of residuals for a drift: a likelihood ratio with autocorrelated noise of unknown size.

The residuals of one vehicle's poses are similar in successive frames, so that a slope by least squares is far less significant than
independent errors suggest. The noise is an autoregressive process of first order, whose correlation and size are estimated together
with the drift. The hypothesis of no drift may explain the same sequence by a larger correlation. A drift begins at one of several
frames; before it the residual is level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CORRELATIONS = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.92, 0.95)
"""Autocorrelations of successive frames that are tried."""
MAX_BEGINS = 20
"""Number of frames at which a drift may begin."""
_PRIOR_DOF = 10.0
"""Weight of the stated variance against the observed one, in residuals."""


@dataclass(frozen=True)
class DriftTest:
    """sigmas: (...) the root of twice the log-likelihood ratio, the larger one of translation and yaw. slope: (..., 3) metres and
    radians per second of the most likely drift. correlation: (...) of successive frames under it.
    """

    sigmas: Floats
    slope: Floats
    correlation: Floats


def find_drift(residuals: Floats, time_s: NDArray[np.floating], stated_variance: Floats, min_frames: int) -> DriftTest:
    """Return the most likely drift of sequences of residuals.

    Args:
        residuals: (..., N, 3) of x, y (m) and yaw (rad). time_s: (N,) increasing. stated_variance: (3,) of one residual.
        min_frames: frames that a drift lasts at least; N is at least 3 and min_frames.
    """
    n = len(time_s)
    whitener = _make_whitener(np.round(time_s - time_s[0], 4).tobytes(), min_frames)
    whitened = whitener.apply(residuals)
    # (..., R, K, 3): of every correlation and every begin.
    along = whitener.ramps @ whitened
    rest = np.square(whitened).sum(-2) - np.square(np.einsum("rn,...rnd->...rd", whitener.base, whitened))
    flat = _log_likelihood(rest, stated_variance, n) - whitener.volume[:, None]
    drifted = _log_likelihood(np.maximum(rest[..., None, :] - np.square(along), 0.0), stated_variance, n)
    drifted -= whitener.volume[:, None, None]
    translation = drifted[..., :2].sum(-1) + flat[..., None, 2]
    yaw = drifted[..., 2] + flat[..., None, :2].sum(-1)
    return _select_best(flat.sum(-1), np.stack((translation, yaw), -1), along / whitener.span[..., None])


@dataclass(frozen=True)
class _Whitener:
    """What follows from the times alone: alpha (R, N - 1) of successive frames, base (R, N) a whitened level of unit length, ramps
    (R, K, N) whitened drifts of unit length without their part along it, span (R, K) their lengths, volume (R,) of the whitening.
    """

    alpha: Floats
    base: Floats
    ramps: Floats
    span: Floats
    volume: Floats

    def apply(self, series: Floats) -> Floats:
        """Return series (..., N, D) as innovations (..., R, N, D) of unit variance."""
        return _whiten(series[..., None, :, :], self.alpha)


@lru_cache(maxsize=64)
def _make_whitener(times: bytes, min_frames: int) -> _Whitener:
    """Return the whitener of times (N,) float64 s; callers pass times since the first frame, so that steady rates share one."""
    time_s = np.frombuffer(times)
    n = len(time_s)
    begins = time_s[: n - min_frames + 1][:: -max((n - min_frames) // MAX_BEGINS, 1)]
    rising = np.maximum(time_s - begins[:, None], 0.0)
    apart = np.diff(time_s) / np.median(np.diff(time_s))
    alpha = np.minimum(np.array(CORRELATIONS)[:, None] ** apart, 0.99)
    base = _whiten(np.ones((1, n, 1)), alpha)[..., 0]
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    ramps = _whiten(rising.T[None], alpha).swapaxes(1, 2)
    ramps -= np.einsum("rkn,rn->rk", ramps, base)[..., None] * base[:, None]
    span = np.linalg.norm(ramps, axis=2)
    return _Whitener(alpha, base, ramps / span[..., None], span, np.log(1 - np.square(alpha)).sum(1) / 2)


def _select_best(level: Floats, with_drift: Floats, slopes: Floats) -> DriftTest:
    """Return the test of log-likelihoods level (..., R), with_drift (..., R, K, 2) and slopes (..., R, K, 3)."""
    shape = with_drift.shape[-3:]
    flat = with_drift.reshape(*with_drift.shape[:-3], -1)
    best = flat.argmax(-1)
    ratio = np.take_along_axis(flat, best[..., None], -1)[..., 0] - level.max(-1)
    correlation, begin, _ = np.unravel_index(best, shape)
    row = (correlation * shape[1] + begin)[..., None, None]
    chosen = np.take_along_axis(slopes.reshape(*slopes.shape[:-3], -1, 3), row, -2)[..., 0, :]
    return DriftTest(np.sqrt(2 * np.maximum(ratio, 0.0)), chosen, np.array(CORRELATIONS)[correlation])


def _whiten(series: Floats, alpha: Floats) -> Floats:
    """Return series (..., 1, N, D) as innovations (..., R, N, D), if successive values are correlated by alpha (R, N - 1)."""
    step = (series[..., 1:, :] - alpha[..., None] * series[..., :-1, :]) / np.sqrt(1 - np.square(alpha))[..., None]
    first = np.broadcast_to(series[..., :1, :], (*step.shape[:-2], 1, step.shape[-1]))
    return np.concatenate((first, step), -2)


def _log_likelihood(squares: Floats, stated_variance: Floats, n: int) -> Floats:
    """Return log-likelihoods (..., 3) of sums of squares, with the variance that is most likely given the stated one."""
    dof = n + _PRIOR_DOF
    return -dof / 2 * np.log((squares + _PRIOR_DOF * stated_variance) / dof)
