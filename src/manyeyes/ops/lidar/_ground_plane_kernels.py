# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``ops.lidar.ground_plane``: lowest returns of cells, consensus over planes, reweighted least squares."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x2, F64x1, F64x2, I32x1, njit, set_row


class Tolerance(NamedTuple):
    """Maximum distance in metres of a ground return from the plane: base_m + per_m times its range."""

    base_m: float
    per_m: float


@njit(cache=True, nogil=True)
def lowest_of_cells(
    xyz: F32x2, cell_m: float, max_range_m: float, max_offset_m: float, max_slope: float
) -> tuple[F64x2, I32x1]:  # pragma: no cover
    """Return the lowest return of each occupied cell (K, 3), in the order of cells, and the cell of each point (N,), -1 outside.

    A point is outside beyond max_range_m, and where no plane of max_offset_m and max_slope passes.
    """
    side, shift, scale = count_cells(cell_m, max_range_m), max_range_m, 1.0 / cell_m
    max_squared, slope_squared = max_range_m * max_range_m, max_slope * max_slope
    cell_of_point = np.full(len(xyz), -1, np.int32)
    lowest, height = np.full(side * side, -1, np.int32), np.full(side * side, np.inf, np.float32)
    count = 0
    for p in range(len(xyz)):
        x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), xyz[p, 2]
        squared, excess = x * x + y * y, abs(float(z)) - max_offset_m
        # Written so that NaN is outside.
        if not squared < max_squared or not (excess <= 0.0 or excess * excess <= slope_squared * squared):
            continue
        cell = int((y + shift) * scale) * side + int((x + shift) * scale)
        cell_of_point[p] = cell
        if z < height[cell]:
            count += lowest[cell] < 0
            lowest[cell], height[cell] = p, z
    places, row = np.empty((count, 3)), 0
    for cell in range(side * side):
        if lowest[cell] >= 0:
            for axis in range(3):
                places[row, axis] = xyz[lowest[cell], axis]
            row += 1
    return places, cell_of_point


@njit(cache=True, nogil=True)
def count_cells(cell_m: float, max_range_m: float) -> int:  # pragma: no cover
    """Return the number of cells along an edge of the grid."""
    return math.ceil(2.0 * max_range_m / cell_m)


@njit(cache=True, nogil=True)
def find_consensus(
    places: F64x2,
    weight: F64x1,
    ranges: F64x1,
    tolerance: Tolerance,
    draws: F64x2,
    max_slope: float,
    below_factor: float,
) -> F64x1:  # pragma: no cover
    """Return the plane (slope along x, slope along y, height at the origin) of the maximum score, of the plane z = 0 and of those
    through the places (K, 3) that each row of draws (H, 3) in [0, 1) selects.

    Score: the sum over places of weight (K,) times 1 - (distance / tolerance)^2 within the tolerance, and -below_factor where a
    place is below it. A truncated quadratic of RANSAC (MSAC: Torr and Zisserman, CVIU 2000); ground is what nothing lies below.
    """
    best, best_score = np.zeros(3), -np.inf
    plane, last = np.zeros(3), len(places) - 1
    for h in range(-1, len(draws)):
        if h >= 0:
            i, j, k = int(draws[h, 0] * last), int(draws[h, 1] * last), int(draws[h, 2] * last)
            x1, y1, z1 = places[j, 0] - places[i, 0], places[j, 1] - places[i, 1], places[j, 2] - places[i, 2]
            x2, y2, z2 = places[k, 0] - places[i, 0], places[k, 1] - places[i, 1], places[k, 2] - places[i, 2]
            area = x1 * y2 - x2 * y1
            # Slim triangles have no defined slope.
            if abs(area) < 0.2 * max(x1 * x1 + y1 * y1, x2 * x2 + y2 * y2):
                continue
            plane[0], plane[1] = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
            if plane[0] * plane[0] + plane[1] * plane[1] > max_slope * max_slope:
                continue
            plane[2] = places[i, 2] - plane[0] * places[i, 0] - plane[1] * places[i, 1]
        score = 0.0
        for n in range(len(places)):
            limit = tolerance.base_m + tolerance.per_m * ranges[n]
            above = (places[n, 2] - plane[0] * places[n, 0] - plane[1] * places[n, 1] - plane[2]) / limit
            if above < -1.0:
                score -= below_factor * weight[n]
            elif above < 1.0:
                score += weight[n] * (1.0 - above * above)
        if score > best_score:
            best_score = score
            set_row(best, plane)
    return best


@njit(cache=True, nogil=True)
def refine(
    places: F64x2, weight: F64x1, ranges: F64x1, tolerance: Tolerance, plane: F64x1, num_iterations: int
) -> tuple[F64x1, F64x1]:  # pragma: no cover
    """Return the plane (3,) after iterations of least squares, and the last weights (K,): weight times Tukey's biweight.

    The plane before is returned, with weights zero, where the places that are within the tolerance do not define one.
    """
    plane, found = plane.copy(), np.zeros(len(places))
    for _ in range(num_iterations):
        sxx = sxy = syy = sx = sy = s = sxz = syz = sz = 0.0
        for n in range(len(places)):
            x, y, z = places[n, 0], places[n, 1], places[n, 2]
            u = (z - plane[0] * x - plane[1] * y - plane[2]) / (tolerance.base_m + tolerance.per_m * ranges[n])
            w = 1.0 - u * u
            w = weight[n] * w * w if w > 0.0 else 0.0
            found[n] = w
            sxx, sxy, syy, sx, sy, s = sxx + w * x * x, sxy + w * x * y, syy + w * y * y, sx + w * x, sy + w * y, s + w
            sxz, syz, sz = sxz + w * x * z, syz + w * y * z, sz + w * z
        if s <= 0.0:
            break
        # Centred normal equations of two unknowns.
        mx, my, mz = sx / s, sy / s, sz / s
        cxx, cxy, cyy = sxx / s - mx * mx, sxy / s - mx * my, syy / s - my * my
        cxz, cyz = sxz / s - mx * mz, syz / s - my * mz
        determinant = cxx * cyy - cxy * cxy
        if determinant <= 1e-9 * (cxx + cyy) ** 2:
            found[:] = 0.0
            break
        plane[0] = (cxz * cyy - cyz * cxy) / determinant
        plane[1] = (cxx * cyz - cxy * cxz) / determinant
        plane[2] = mz - plane[0] * mx - plane[1] * my
    return plane, found


@njit(cache=True, nogil=True)
def ring_weights(places: F64x2, ring_m: float) -> tuple[F64x1, F64x1]:  # pragma: no cover
    """Return ranges (K,) of places (K, 3), and weights with which every ring beyond ring_m counts the same."""
    ranges, weight = np.empty(len(places)), np.empty(len(places))
    for n in range(len(places)):
        ranges[n] = math.hypot(places[n, 0], places[n, 1])
        weight[n] = ring_m / max(ranges[n], ring_m)
    return ranges, weight


@njit(cache=True, nogil=True)
def weighted_moments(places: F64x2, weight: F64x1, plane: F64x1) -> tuple[F64x2, F64x2, float]:  # pragma: no cover
    """Return T' W T and T' W^2 T (3, 3), of the rows x, y, 1 of places (K, 3), and the weighted mean of squared residuals."""
    once, twice = np.zeros((3, 3)), np.zeros((3, 3))
    squares, total, row = 0.0, 0.0, np.ones(3)
    for n in range(len(places)):
        row[0], row[1], w = places[n, 0], places[n, 1], weight[n]
        for i in range(3):
            for j in range(3):
                once[i, j] += w * row[i] * row[j]
                twice[i, j] += w * w * row[i] * row[j]
        residual = places[n, 2] - plane[0] * row[0] - plane[1] * row[1] - plane[2]
        squares, total = squares + w * residual * residual, total + w
    return once, twice, squares / total


@njit(cache=True, nogil=True)
def mean_of_cells(
    xyz: F32x2, cell_of_point: I32x1, num_cells: int, plane: F64x1, tolerance: Tolerance
) -> F64x2:  # pragma: no cover
    """Return the mean (K, 3) of the points of each cell within the tolerance of a plane, in the order of cells that have such."""
    sums = np.zeros((num_cells, 4))
    for p in range(len(xyz)):
        cell = cell_of_point[p]
        if cell < 0:
            continue
        x, y, z = float(xyz[p, 0]), float(xyz[p, 1]), float(xyz[p, 2])
        excess = abs(z - plane[0] * x - plane[1] * y - plane[2]) - tolerance.base_m
        if excess <= 0.0 or excess * excess <= tolerance.per_m * tolerance.per_m * (x * x + y * y):
            sums[cell, 0] += x
            sums[cell, 1] += y
            sums[cell, 2] += z
            sums[cell, 3] += 1.0
    means, count = np.empty((num_cells, 3)), 0
    for cell in range(num_cells):
        if sums[cell, 3] > 0.0:
            for axis in range(3):
                means[count, axis] = sums[cell, axis] / sums[cell, 3]
            count += 1
    return means[:count]
