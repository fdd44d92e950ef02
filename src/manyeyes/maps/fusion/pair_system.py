# SPDX-License-Identifier: Apache-2.0
"""Couple the poses of overlapping observations by the lines that they share, with the stations of the lines eliminated.

A station s on a line that n observations detect has the residuals e_i = u'(T_i p_i) - u's, weighted by w_i, along the normal u of
the line. Eliminating s (Schur complement) leaves sum_i w_i (e_i - mean)^2 = 1/2 sum_ij w_i w_j / sum_k w_k (e_i - e_j)^2, a sum
over pairs of observations (Triggs et al., Bundle Adjustment, 1999, section 6). Here the members of the station of point p are the
points q of other observations around it, each with the weight of a redescending kernel (Geman-McClure) and of its longitudinal
distance, so that no association is hard. Residuals are lateral, along the mean normal of both lines, which has no bias on a bend.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, njit, set_row, set_rows
from manyeyes.maps.fusion.point_grid import find_cell_range
from manyeyes.ops._sort_kernels import sort

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NUM_OWN, NUM_SHARED, NUM_SUMS = 11, 12, 14


class OwnPoints(NamedTuple):
    """Points of observations: offsets (O + 1,), positions and unit tangents (P, 2) in the map's frame, kinds and sigmas (P,)."""

    offsets: I64x1
    xy: F64x2
    tangent: F64x2
    kind: I64x1
    sigma: F64x1


class OtherPoints(NamedTuple):
    """The same points in the order of a grid: cell (m), keys, offsets, positions, unit tangents (P, 2) and observations (P,)."""

    cell_m: float
    keys: I64x1
    offsets: I64x1
    xy: F64x2
    tangent: F64x2
    observation: I64x1


class PairLimits(NamedTuple):
    """Lateral gate (m), Geman-McClure kernel (m), longitudinal gate (m), cosine of the heading gate, sigma of a line (m), points of
    one line that count as one, every how many points are used.
    """

    gate_m: float
    kernel_m: float
    max_longitudinal_m: float
    min_cosine: float
    sigma_m: float
    points_per_independent: float
    point_stride: int


@njit(cache=True, nogil=True)
def sum_pairs(
    home: I64x1, pose: F64x2, weight: F64x1, own_points: OwnPoints, other_points: OtherPoints, limits: PairLimits
) -> tuple[F64x2, I64x1, I64x1, F64x2]:  # pragma: no cover - compiled
    """Sum the normal equations of all pairs of points of the home observations.

    Returns own, offsets, the rows of the other observations, and shared; see
    :class:`~manyeyes.maps.fusion.pose_solution.PairSums`.

    pose: (O, 3) about whose positions the observations turn. weight: (O,) weight of each observation's lines; where it is 0
        the lines move the observation, and no other by it.
    """
    first, xy, sigma = own_points.offsets, own_points.xy, own_points.sigma
    stride = limits.point_stride
    own, offsets = np.zeros((len(home), NUM_OWN)), np.zeros(len(home) + 1, np.int64)
    slot, met = np.full(len(pose), -1), np.empty(len(pose), np.int64)
    sums, alone = np.zeros((len(pose), NUM_SUMS)), np.zeros(NUM_SUMS)
    other, shared, filled = np.empty(64, np.int64), np.empty((64, NUM_SHARED)), 0
    near, columns = np.empty(256, np.int64), np.empty((5, 256))
    for h in range(len(home)):
        o, n = home[h], 0
        for p in range(first[o], first[o + 1], stride):
            near, columns, found = _gather_near(p, o, own_points, other_points, weight, limits, near, columns)
            _weigh_near(found, own_points.tangent[p, 0], own_points.tangent[p, 1], limits, columns)
            found, total = _keep_members(found, near, columns)
            if found == 0:
                continue
            residual, mean_x, mean_y, member_weight = columns[0], columns[2], columns[3], columns[4]
            mine = max(weight[o], 1e-9)
            # The other point's residual about the same station is the second half of the pair.
            half = 0.5 * mine if weight[o] > 0.0 else 1.0
            unit = stride / (limits.points_per_independent * (sigma[p] * sigma[p] + limits.sigma_m * limits.sigma_m))
            x, y = xy[p, 0] - pose[o, 0], xy[p, 1] - pose[o, 1]
            square = 0.0
            for m in range(found):
                q, w, r = near[m], member_weight[m], residual[m]
                jx, jy = -mean_y[m], mean_x[m]
                jt = jy * x - jx * y
                j = other_points.observation[q]
                square += w * r * r
                w = unit * w / (mine + total) * half
                if weight[o] <= 0.0:
                    _add_pair(alone, w, (jx, jy, jt), 0.0, r)
                    continue
                if slot[j] < 0:
                    slot[j], met[n] = n, j
                    sums[n] = 0.0
                    n += 1
                lx, ly = other_points.xy[q, 0] - pose[j, 0], other_points.xy[q, 1] - pose[j, 1]
                _add_pair(sums[slot[j]], w, (jx, jy, jt), jy * lx - jx * ly, r)
            vote = total / (total + 0.5)
            own[h, 9] += vote * square / total
            own[h, 10] += vote
        order = sort(met[:n])
        while filled + n > len(other):
            other, shared = _longer(other), _taller(shared)
        _add_own(own[h], alone)
        alone[:] = 0.0
        for i in range(n):
            row = sums[slot[order[i]]]
            _add_own(own[h], row)
            other[filled] = order[i]
            set_row(shared[filled], row[:NUM_SHARED])
            filled += 1
        for i in range(n):
            slot[met[i]] = -1
        offsets[h + 1] = filled
    return own, offsets, other[:filled].copy(), shared[:filled].copy()


@njit(cache=True, nogil=True)
def _add_pair(
    row: F64x1, w: float, jacobian: tuple[float, float, float], lt: float, r: float
) -> None:  # pragma: no cover - compiled
    """Add a pair of weight w and residual r to the sums of its two observations.

    jacobian: (jx, jy, jt) by the pose of the observation itself; lt: by the heading of the other one, whose first two are -jx, -jy.
    Columns: jx jx, jx jy, jy jy, jx lt, jy lt, lt lt, jt jx, jt jy, jt lt, jx r, jy r, lt r, jt jt, jt r.
    """
    jx, jy, jt = jacobian
    x, y, t, s = w * jx, w * jy, w * lt, w * jt
    row[0] += x * jx
    row[1] += x * jy
    row[2] += y * jy
    row[3] += x * lt
    row[4] += y * lt
    row[5] += t * lt
    row[6] += s * jx
    row[7] += s * jy
    row[8] += s * lt
    row[9] += x * r
    row[10] += y * r
    row[11] += t * r
    row[12] += s * jt
    row[13] += s * r


@njit(cache=True, nogil=True)
def _add_own(own: F64x1, row: F64x1) -> None:  # pragma: no cover - compiled
    """Add sums of :func:`_add_pair` to the first 9 columns of own."""
    own[0] += row[0]
    own[1] += row[1]
    own[2] += row[6]
    own[3] += row[2]
    own[4] += row[7]
    own[5] += row[12]
    own[6] += row[9]
    own[7] += row[10]
    own[8] += row[13]


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_near(
    p: int,
    o: int,
    own_points: OwnPoints,
    other_points: OtherPoints,
    weight: F64x1,
    limits: PairLimits,
    near: I64x1,
    columns: F64x2,
) -> tuple[I64x1, F64x2, int]:  # pragma: no cover - compiled
    """Gather the points of other observations around point p: which, (dx, dy, tangent, weight) and their number.

    They lie in a rectangle along the tangent of p that holds all within the gates, which are along a mean of two tangents.
    """
    x, y, kind, cell = own_points.xy[p, 0], own_points.xy[p, 1], own_points.kind[p], other_points.cell_m
    u, v = own_points.tangent[p, 0], own_points.tangent[p, 1]
    lean = np.sqrt(0.5 * (1.0 - limits.min_cosine))
    along = (limits.max_longitudinal_m + lean * limits.gate_m) * (1.0 + 1e-9)
    aside = (limits.gate_m + lean * limits.max_longitudinal_m) * (1.0 + 1e-9)
    reach_x, reach_y = abs(u) * along + abs(v) * aside, abs(v) * along + abs(u) * aside
    low_y, high_y = int(np.floor((y - reach_y) / cell)), int(np.floor((y + reach_y) / cell))
    n = 0
    for ix in range(int(np.floor((x - reach_x) / cell)), int(np.floor((x + reach_x) / cell)) + 1):
        low, high = find_cell_range(other_points.keys, other_points.offsets, kind, ix, low_y, high_y)
        while n + high - low > len(near):
            near, columns = _longer(near), _wider(columns)
        for q in range(low, high):
            ex, ey = other_points.xy[q, 0] - x, other_points.xy[q, 1] - y
            near[n] = q
            # A point that does not count is overwritten by the next one, which is faster than a branch.
            is_near = (abs(ex * u + ey * v) <= along) & (abs(ey * u - ex * v) <= aside)
            n += 1 if is_near & (other_points.observation[q] != o) else 0
    dx, dy, tangent_x, tangent_y, weights = columns[0], columns[1], columns[2], columns[3], columns[4]
    for k in range(n):
        q = near[k]
        dx[k], dy[k] = other_points.xy[q, 0] - x, other_points.xy[q, 1] - y
        tangent_x[k], tangent_y[k] = other_points.tangent[q, 0], other_points.tangent[q, 1]
        weights[k] = weight[other_points.observation[q]]
    return near, columns, n


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh_near(n: int, u: float, v: float, limits: PairLimits, columns: F64x2) -> None:  # pragma: no cover - compiled
    """Replace columns of the points around one with tangent (u, v): residual for dx, mean tangent, weight as a member.

    The same as :func:`~manyeyes.maps.fusion.point_grid.line_residual`, without branches, so that the loop is vectorised.
    """
    dx, dy, tangent_x, tangent_y, weight = columns[0], columns[1], columns[2], columns[3], columns[4]
    gate, reach, min_cosine, c2 = limits.gate_m, limits.max_longitudinal_m, limits.min_cosine, limits.kernel_m**2
    for k in range(n):
        dot = u * tangent_x[k] + v * tangent_y[k]
        sign = 1.0 if dot > 0.0 else -1.0
        norm = np.sqrt(2.0 + 2.0 * abs(dot))
        mx, my = (u + sign * tangent_x[k]) / norm, (v + sign * tangent_y[k]) / norm
        along, aside = dx[k] * mx + dy[k] * my, dy[k] * mx - dx[k] * my
        g = c2 / (c2 + aside * aside)
        w = weight[k] * g * g * (1.0 - abs(along) / reach)
        weight[k] = w if (abs(dot) >= min_cosine) & (abs(along) <= reach) & (abs(aside) <= gate) else 0.0
        dx[k], tangent_x[k], tangent_y[k] = aside, mx, my


@njit(cache=True, nogil=True)
def _keep_members(n: int, near: I64x1, columns: F64x2) -> tuple[int, float]:  # pragma: no cover - compiled
    """Keep the points with a weight, in order: their number and sum of weights."""
    residual, mean_x, mean_y, weight = columns[0], columns[2], columns[3], columns[4]
    found, total = 0, 0.0
    for k in range(n):
        w = weight[k]
        near[found], residual[found], weight[found] = near[k], residual[k], w
        mean_x[found], mean_y[found] = mean_x[k], mean_y[k]
        total += w
        found += 1 if w > 0.0 else 0
    return found, float(total)


@njit(cache=True, nogil=True)
def _longer(rows: I64x1) -> I64x1:  # pragma: no cover - compiled
    bigger = np.empty(2 * len(rows), np.int64)
    set_row(bigger[: len(rows)], rows)
    return bigger


@njit(cache=True, nogil=True)
def _taller(rows: F64x2) -> F64x2:  # pragma: no cover - compiled
    bigger = np.empty((2 * len(rows), rows.shape[1]))
    set_rows(bigger[: len(rows)], rows)
    return bigger


@njit(cache=True, nogil=True)
def _wider(columns: F64x2) -> F64x2:  # pragma: no cover - compiled
    bigger = np.empty((columns.shape[0], 2 * columns.shape[1]))
    set_rows(bigger[:, : columns.shape[1]], columns)
    return bigger
