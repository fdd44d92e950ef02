# SPDX-License-Identifier: Apache-2.0
"""Error models of detected boxes: independent Gaussian errors, and the ones measured on pairs of real boxes.

Real boxes are less accurate longitudinally than laterally, a fraction of them has much larger errors, and errors of one object last
for many frames. The defaults of :class:`MeasuredBoxErrors` were fitted to 265 pairs of boxes of two LiDARs at an intersection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from manyeyes.datatypes import ConfigError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BoxNoise:
    """Errors of detected boxes: sigma_xy_m an axis, sigma_yaw_rad, flip (chance of a heading off by pi), sigma_size_m."""

    sigma_xy_m: float = 0.25
    sigma_yaw_rad: float = math.radians(2.5)
    p_flip: float = 0.03
    sigma_size_m: float = 0.15


@dataclass(frozen=True)
class MeasuredBoxErrors:
    """Per-axis, heavy-tailed and autocorrelated errors of boxes that state no standard deviations.

    sigma_longitudinal_m, sigma_lateral_m: of positions; tail_fraction of boxes has tail_scale times these. sigma_yaw_rad: of
    headings; yaw_tail_fraction of boxes has sigma_yaw_tail_rad. p_flip: probability of a heading turned by pi. sigma_size_m: of
    lengths, twice that of widths. autocorrelation: of an object's errors between two instants, for one agent.
    """

    sigma_longitudinal_m: float = 0.30
    sigma_lateral_m: float = 0.20
    tail_fraction: float = 0.08
    tail_scale: float = 3.0
    sigma_yaw_rad: float = math.radians(3.0)
    yaw_tail_fraction: float = 0.10
    sigma_yaw_tail_rad: float = math.radians(12.0)
    p_flip: float = 0.06
    sigma_size_m: float = 0.15
    autocorrelation: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.autocorrelation < 1 or not max(self.tail_fraction, self.yaw_tail_fraction, self.p_flip) <= 1:
            raise ConfigError("MeasuredBoxErrors needs an autocorrelation in [0, 1) and fractions of at most 1.")


REAL_BOXES = MeasuredBoxErrors()
"""The error model "real"."""
INTERSECTION_BOXES = MeasuredBoxErrors(0.43, 0.43, 0.0, 1.0, math.radians(4.0), 0.0, 0.0, 0.06)
"""Boxes with the whole spread of the measured pairs in one Gaussian."""


@dataclass(frozen=True)
class BoxErrors:
    """xy: (N, 2) in the object's axes, longitudinal and lateral (m). yaw: (N,) radians. size: (N, 2) length and width (m)."""

    xy: Floats
    yaw: Floats
    size: Floats


_XY, _YAW, _TAIL, _YAW_TAIL, _FLIP, _SIZE = slice(0, 2), 2, 3, 4, 5, slice(6, 8)


def draw_latent(num_objects: int, rng: np.random.Generator) -> Floats:
    """Return (N, 8) standard normal numbers, from which :func:`make_errors` computes the errors of N objects."""
    return rng.standard_normal((num_objects, 8))


def step_latent(latent: Floats, autocorrelation: float, rng: np.random.Generator) -> Floats:
    """Return the latent numbers one instant later, or earlier: an autoregressive process of first order."""
    return autocorrelation * latent + math.sqrt(1 - autocorrelation**2) * draw_latent(len(latent), rng)


def make_errors(model: MeasuredBoxErrors, latent: Floats) -> BoxErrors:
    """Return the errors that latent numbers (N, 8) stand for."""
    is_tail = latent[:, _TAIL] < _quantile(model.tail_fraction)
    is_yaw_tail = latent[:, _YAW_TAIL] < _quantile(model.yaw_tail_fraction)
    scale = np.where(is_tail, model.tail_scale, 1.0)[:, None]
    sigma_yaw = np.where(is_yaw_tail, model.sigma_yaw_tail_rad, model.sigma_yaw_rad)
    return BoxErrors(
        latent[:, _XY] * scale * [model.sigma_longitudinal_m, model.sigma_lateral_m],
        latent[:, _YAW] * sigma_yaw + math.pi * (latent[:, _FLIP] < _quantile(model.p_flip)),
        latent[:, _SIZE] * model.sigma_size_m * [1.0, 0.5],
    )


def _quantile(probability: float) -> float:
    """Return the quantile of the standard normal distribution; infinite at 0 and 1."""
    return float(ndtri(probability))
