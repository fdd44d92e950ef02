# SPDX-License-Identifier: Apache-2.0
"""Degrees to metres about an origin: the transverse Mercator projection of WGS 84 with scale 1 on the origin's meridian.

Source: Krüger (1912) in the form of Karney, "Transverse Mercator with an accuracy of a few nanometers", J. Geodesy 85 (2011),
series to the fourth order in the third flattening: within a micrometre where |longitude - origin's| < 3°.
The same projection as ``+proj=tmerc +lat_0=LAT +lon_0=LON +k_0=1 +ellps=WGS84``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_A_M = 6378137.0
_F = 1 / 298.257223563
_N = _F / (2 - _F)
_E = np.sqrt(_F * (2 - _F))
_RADIUS_M = _A_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_FORWARD = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)
_INVERSE = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96 - _N**4 / 360,
    _N**2 / 48 + _N**3 / 15 - 437 * _N**4 / 1440,
    17 * _N**3 / 480 - 37 * _N**4 / 840,
    4397 * _N**4 / 161280,
)


def metres_from_degrees(latitude: ArrayLike, longitude: ArrayLike, origin: tuple[float, float]) -> Array:
    """Return (N, 2) metres east and north of an origin (latitude, longitude in degrees) at points (N,) in degrees."""
    phi = np.radians(np.asarray(latitude, np.float64))
    lam = np.radians(np.asarray(longitude, np.float64) - origin[1])
    conformal = _conformal(phi)
    xi = np.arctan2(conformal, np.cos(lam))
    eta = np.arcsinh(np.sin(lam) / np.hypot(conformal, np.cos(lam)))
    north, east = xi.copy(), eta.copy()
    for j, alpha in enumerate(_FORWARD, start=1):
        north += alpha * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        east += alpha * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    return _RADIUS_M * np.stack((east, north - _meridian(origin[0])), -1)


def degrees_from_metres(xy: ArrayLike, origin: tuple[float, float]) -> Array:
    """Return (N, 2) latitude and longitude in degrees of points (N, 2) in metres about an origin; the inverse of the above."""
    xy = np.asarray(xy, np.float64) / _RADIUS_M
    xi, eta = xy[..., 1] + _meridian(origin[0]), xy[..., 0]
    north, east = xi.copy(), eta.copy()
    for j, beta in enumerate(_INVERSE, start=1):
        north -= beta * np.sin(2 * j * xi) * np.cosh(2 * j * eta)
        east -= beta * np.cos(2 * j * xi) * np.sinh(2 * j * eta)
    target = np.sin(north) / np.hypot(np.sinh(east), np.cos(north))
    tau = target.copy()
    # Newton's method on the conformal latitude; three steps reach rounding error.
    for _ in range(4):
        sigma = np.sinh(_E * np.arctanh(_E * tau / np.hypot(1.0, tau)))
        value = tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau)
        slope = np.hypot(1.0, value) * np.hypot(1.0, tau) * (1 - _E**2) / (1 + (1 - _E**2) * tau**2)
        tau += (target - value) / slope
    longitude = np.degrees(np.arctan2(np.sinh(east), np.cos(north))) + origin[1]
    return np.stack((np.degrees(np.arctan(tau)), longitude), -1)


def _conformal(phi: Array) -> Array:
    """Tangent of the conformal latitude."""
    tau = np.tan(phi)
    sigma = np.sinh(_E * np.arctanh(_E * np.sin(phi)))
    return tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau)


def _meridian(latitude: float) -> float:
    """Rectifying latitude of the origin, radians."""
    xi = np.arctan(_conformal(np.radians(np.array(latitude))))
    return float(xi + sum(alpha * np.sin(2 * j * xi) for j, alpha in enumerate(_FORWARD, start=1)))
