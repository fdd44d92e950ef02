# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the voting: hypotheses from matching edges, their support, and refinement on one-to-one pairs.

An edge joins two landmarks of one agent. Its length and its angles to the two headings (modulo pi) do not depend on the frame.
Two matched edges give the relative pose with a yaw as exact as the edge is long. A single pair of objects gives a yaw only as
exact as a detected heading, which is an error of two metres at 50 m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import Boolx1, Boolx2, F64x1, F64x2, F64x3, I64x1, I64x2, njit
from manyeyes.ops._sort_kernels import argsort

_PI = np.pi
# Columns of a covariance (N, 3).
_XX, _XY, _YY = range(3)


class LandmarkArrays(NamedTuple):
    """xy: (N, 2) metres; yaw: (N,) radians; sigma_xy, sigma_yaw: (N,) their standard deviations."""

    xy: F64x2
    yaw: F64x1
    sigma_xy: F64x1
    sigma_yaw: F64x1


class OrientedLandmarks(NamedTuple):
    """As :class:`LandmarkArrays`, with the covariance (N, 3) of each place in its agent's axes: xx, xy and yy."""

    xy: F64x2
    yaw: F64x1
    covariance: F64x2
    sigma_yaw: F64x1


class Edges(NamedTuple):
    """ends: (E, 2) landmarks; length: (E,) metres; direction: (E,) radians; heading: (E, 2) of both ends from it, modulo pi."""

    ends: I64x2
    length: F64x1
    direction: F64x1
    heading: F64x2


class EdgeMatches(NamedTuple):
    """Matched edges. edges: (H, 2) of a and of b; swapped: (H,) whether the ends of b's edge are exchanged; turn: (H,) radians, of
    the edge, from both headings; misfit: (H,) squared residuals.
    """

    edges: I64x2
    swapped: Boolx1
    turn: F64x1
    misfit: F64x1


class LandmarkGrid(NamedTuple):
    """Landmarks by square cells, each in all cells within reach of it: cell c = column * num_rows + row holds
    ``rows[start[c]:start[c + 1]]``; columns go along x.
    """

    rows: I64x1
    start: I64x1
    x_min: float
    y_min: float
    num_columns: int
    num_rows: int
    cell_m: float


class InverseCovariance(NamedTuple):
    """The three numbers of a symmetric matrix (2, 2)."""

    xx: float
    xy: float
    yy: float


class RefinedPoses(NamedTuple):
    """Refined poses (K, 3) and their information (K, 3, 3); rows start[k] to start[k + 1] of pairs and misfit belong to pose k."""

    poses: F64x2
    information: F64x3
    pairs: I64x2
    misfit: F64x1
    start: I64x1


class RefinedPose(NamedTuple):
    """pose: (3,) x, y, yaw; information: (3, 3) of it; pairs: (P, 2) landmarks of a and b; misfit: (P,) squared."""

    pose: F64x1
    information: F64x2
    pairs: I64x2
    misfit: F64x1


@njit(cache=True, nogil=True)
def wrap_half_turn(angle: float) -> float:  # pragma: no cover - compiled
    """Return an angle modulo pi, in [-pi/2, pi/2)."""
    shifted = angle + 0.5 * _PI
    # What % gives for the angles that occur most, without its division.
    if 0.0 <= shifted < _PI:
        return shifted - 0.5 * _PI
    if _PI <= shifted < 2.0 * _PI:
        return shifted - _PI - 0.5 * _PI
    if -_PI <= shifted < 0.0:
        return shifted + _PI - 0.5 * _PI
    return shifted % _PI - 0.5 * _PI


@njit(cache=True, nogil=True)
def build_edge_table(
    xy: F64x2, yaw: F64x1, min_length: float, max_length: float
) -> Edges:  # pragma: no cover - compiled
    """Return edges between landmarks whose distance is within min_length and max_length (m)."""
    n = len(xy)
    size = n * (n - 1) // 2
    ends, heading = np.empty((size, 2), np.int64), np.empty((size, 2))
    lengths, direction = np.empty(size), np.empty(size)
    count = 0
    for i in range(n):
        for j in range(i + 1, n):
            dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            length = np.hypot(dx, dy)
            if length < min_length or length > max_length:
                continue
            along = np.arctan2(dy, dx)
            ends[count, 0], ends[count, 1] = i, j
            lengths[count], direction[count] = length, along
            heading[count, 0], heading[count, 1] = wrap_half_turn(yaw[i] - along), wrap_half_turn(yaw[j] - along)
            count += 1
    return Edges(ends[:count], lengths[:count], direction[:count], heading[:count])


@njit(cache=True, nogil=True)
def find_compatible(
    size_a: F64x2, size_b: F64x2, instant_a: I64x1, instant_b: I64x1, gate: float
) -> Boolx2:  # pragma: no cover - compiled
    """Return (N, M) bool: landmarks of one instant that may be one object: widths within ``gate`` (m), lengths within about
    twice that.
    """
    ok = np.empty((len(size_a), len(size_b)), np.bool_)
    for i in range(len(size_a)):
        for j in range(len(size_b)):
            ok[i, j] = (
                instant_a[i] == instant_b[j]
                and abs(size_a[i, 0] - size_b[j, 0]) < gate * 2.0 + 0.1 * size_a[i, 0]
                and abs(size_a[i, 1] - size_b[j, 1]) < gate
            )
    return ok


@njit(cache=True, nogil=True)
def match_edges(
    a: LandmarkArrays,
    b: LandmarkArrays,
    edges_a: Edges,
    edges_b: Edges,
    is_compatible: Boolx2,
    gate: float,
    max_matches: int,
) -> EdgeMatches:  # pragma: no cover - compiled
    """Return edges that agree within ``gate`` standard deviations.

    edges_a, edges_b: by ascending length. is_compatible: (N, M) pairs that may be one object. Only the first max_matches are
    returned.
    """
    ends_a, length_a, _, heading_a = edges_a
    ends_b, length_b, _, heading_b = edges_b
    square_gate = gate * gate
    edges, swapped = np.empty((max_matches, 2), np.int64), np.empty(max_matches, np.bool_)
    turns, misfit = np.empty(max_matches), np.empty(max_matches)
    variance_a, variance_b = _edge_variances(ends_a, a.sigma_xy), _edge_variances(ends_b, b.sigma_xy)
    yaw_weight = _yaw_weights(a.sigma_yaw, b.sigma_yaw)
    count, low = 0, 0
    largest = 0.0
    if len(a.xy) and len(b.xy):
        largest = gate * 2.0 * max(a.sigma_xy.max(), b.sigma_xy.max())
    for p in range(len(ends_a)):
        while low < len(ends_b) and length_b[low] < length_a[p] - largest:
            low += 1
        i, j = ends_a[p, 0], ends_a[p, 1]
        for q in range(low, len(ends_b)):
            if length_b[q] > length_a[p] + largest:
                break
            square, spread = (length_a[p] - length_b[q]) ** 2, variance_a[p] + variance_b[q]
            if square > square_gate * spread:
                continue
            for way in range(2):
                k, m = ends_b[q, way], ends_b[q, 1 - way]
                if not (is_compatible[i, k] and is_compatible[j, m]):
                    continue
                one = _wrap_near(heading_a[p, 0] - heading_b[q, way])
                two = _wrap_near(heading_a[p, 1] - heading_b[q, 1 - way])
                # Headings relative to the edge: one unknown turn of the edge, two measured angles.
                w1, w2 = yaw_weight[i, k], yaw_weight[j, m]
                if (one - two) ** 2 * w1 * w2 > square_gate * (w1 + w2):
                    continue
                w0 = length_a[p] * length_b[q] / spread
                turn = (one * w1 + two * w2) / (w0 + w1 + w2)
                cost = square / spread + turn * turn * w0 + (one - turn) ** 2 * w1 + (two - turn) ** 2 * w2
                if cost > square_gate or count == max_matches:
                    continue
                edges[count, 0], edges[count, 1], swapped[count] = p, q, way == 1
                turns[count], misfit[count] = turn, cost
                count += 1
    return EdgeMatches(edges[:count], swapped[:count], turns[:count], misfit[:count])


@njit(cache=True, nogil=True)
def _edge_variances(ends: I64x2, sigma_xy: F64x1) -> F64x1:  # pragma: no cover - compiled
    """Return (E,) sums of the variances of both ends."""
    out = np.empty(len(ends))
    for p in range(len(ends)):
        out[p] = sigma_xy[ends[p, 0]] ** 2 + sigma_xy[ends[p, 1]] ** 2
    return out


@njit(cache=True, nogil=True)
def _yaw_weights(sigma_a: F64x1, sigma_b: F64x1) -> F64x2:  # pragma: no cover - compiled
    """Return (N, M) inverse variances of the difference of two headings."""
    out = np.empty((len(sigma_a), len(sigma_b)))
    for i in range(len(sigma_a)):
        for k in range(len(sigma_b)):
            out[i, k] = 1.0 / (sigma_a[i] ** 2 + sigma_b[k] ** 2)
    return out


@njit(cache=True, nogil=True)
def _wrap_near(angle: float) -> float:  # pragma: no cover - compiled
    """Return an angle modulo pi, in [-pi/2, pi/2), as :func:`wrap_half_turn` but for rounding, without a division."""
    return angle - _PI * np.floor(angle * (1.0 / _PI) + 0.5)


@njit(cache=True, nogil=True)
def compute_edge_poses(
    xy_a: F64x2, xy_b: F64x2, edges_a: Edges, edges_b: Edges, matches: EdgeMatches, rows: I64x1
) -> F64x2:  # pragma: no cover - compiled
    """Return poses (R, 3) a_from_b of these rows of the matches."""
    out = np.empty((len(rows), 3))
    for n in range(len(rows)):
        p, q = matches.edges[rows[n], 0], matches.edges[rows[n], 1]
        way = 1 if matches.swapped[rows[n]] else 0
        i, j = edges_a.ends[p, 0], edges_a.ends[p, 1]
        k, m = edges_b.ends[q, way], edges_b.ends[q, 1 - way]
        yaw = edges_a.direction[p] - edges_b.direction[q] + matches.turn[rows[n]] + (_PI if way else 0.0)
        c, s = np.cos(yaw), np.sin(yaw)
        mx, my = 0.5 * (xy_b[k, 0] + xy_b[m, 0]), 0.5 * (xy_b[k, 1] + xy_b[m, 1])
        out[n, 0] = 0.5 * (xy_a[i, 0] + xy_a[j, 0]) - (c * mx - s * my)
        out[n, 1] = 0.5 * (xy_a[i, 1] + xy_a[j, 1]) - (s * mx + c * my)
        out[n, 2] = (yaw + _PI) % (2.0 * _PI) - _PI
    return out


@njit(cache=True, nogil=True)
def build_grid(xy: F64x2, reach: float) -> LandmarkGrid:  # pragma: no cover - compiled
    """Put landmarks (N, 2) into all cells of edge ``reach`` (m) within reach of them; cells grow where there would be too many."""
    # Wider than the reach: rounding of a query's cell then never matters.
    margin = 1.001 * reach
    x0, y0 = xy[:, 0].min() - margin, xy[:, 1].min() - margin
    width, height = xy[:, 0].max() + margin - x0, xy[:, 1].max() + margin - y0
    cell = max(reach, max(width, height) / 1000.0)
    nx, ny = int(width / cell) + 1, int(height / cell) + 1
    landmark, at = np.empty(64, np.int64), np.empty(64, np.int64)
    count = 0
    for n in range(len(xy)):
        x, y = xy[n, 0] - x0, xy[n, 1] - y0
        for i in range(int((x - margin) / cell), min(int((x + margin) / cell), nx - 1) + 1):
            dx = max(i * cell - x, x - (i + 1) * cell, 0.0)
            for j in range(int((y - margin) / cell), min(int((y + margin) / cell), ny - 1) + 1):
                dy = max(j * cell - y, y - (j + 1) * cell, 0.0)
                if dx * dx + dy * dy > margin * margin:
                    continue
                if count == len(at):
                    landmark, at = np.append(landmark, landmark), np.append(at, at)
                landmark[count], at[count] = n, i * ny + j
                count += 1
    # One more cell, which is empty: that of all points outside.
    start = np.zeros(nx * ny + 2, np.int64)
    for n in range(count):
        start[at[n]] += 1
    for cell_number in range(1, len(start)):
        start[cell_number] += start[cell_number - 1]
    rows = np.empty(count, np.int64)
    for n in range(count):
        start[at[n]] -= 1
        rows[start[at[n]]] = landmark[n]
    return LandmarkGrid(rows, start, x0, y0, nx, ny, cell)


@njit(cache=True, nogil=True)
def compute_support(
    poses: F64x2,
    a: LandmarkArrays,
    b: LandmarkArrays,
    is_compatible: Boolx2,
    grid: LandmarkGrid,
    tau: float,
    turn: float,
) -> F64x1:  # pragma: no cover - compiled
    """Return (H,) sum over landmarks of b of the best max(0, 1 - d^2 / tau^2) among a's; grid: of a's, of reach tau."""
    n = len(b.xy)
    bx, by = np.ascontiguousarray(b.xy[:, 0]), np.ascontiguousarray(b.xy[:, 1])
    xs, ys, cells = np.empty(n), np.empty(n), np.empty(n, np.int64)
    per_cell = 1.0 / grid.cell_m
    outside = grid.num_columns * grid.num_rows
    score = np.zeros(len(poses))
    for h in range(len(poses)):
        px, py, yaw = poses[h, 0], poses[h, 1], poses[h, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        for k in range(n):
            xs[k] = c * bx[k] - s * by[k] + px
            ys[k] = s * bx[k] + c * by[k] + py
            column, row = (xs[k] - grid.x_min) * per_cell, (ys[k] - grid.y_min) * per_cell
            inside = (column >= 0.0) & (column < grid.num_columns) & (row >= 0.0) & (row < grid.num_rows)
            cells[k] = int(column) * grid.num_rows + int(row) if inside else outside
        total = 0.0
        for k in range(n):
            first, last = grid.start[cells[k]], grid.start[cells[k] + 1]
            best = 0.0
            for m in range(first, last):
                r = grid.rows[m]
                gain = 1.0 - ((xs[k] - a.xy[r, 0]) ** 2 + (ys[k] - a.xy[r, 1]) ** 2) / (tau * tau)
                if gain <= best or not is_compatible[r, k]:
                    continue
                if abs(wrap_half_turn(a.yaw[r] - b.yaw[k] - yaw)) < turn:
                    best = gain
            total += best
        score[h] = total
    return score


@njit(cache=True, nogil=True)
def select_distinct(
    poses: F64x2, order: I64x1, middle: F64x1, max_count: int, min_separation: float, turn: float
) -> I64x1:  # pragma: no cover - compiled
    """Return rows of poses, best first, of which no two agree within ``min_separation`` metres at the middle (2,) of b and
    ``turn`` radians.
    """
    chosen = np.empty(max_count, np.int64)
    place = np.empty((max_count, 2))
    count = 0
    for h in order:
        c, s = np.cos(poses[h, 2]), np.sin(poses[h, 2])
        x = c * middle[0] - s * middle[1] + poses[h, 0]
        y = s * middle[0] + c * middle[1] + poses[h, 1]
        new = True
        for m in range(count):
            angle = abs((poses[h, 2] - poses[chosen[m], 2] + _PI) % (2.0 * _PI) - _PI)
            if angle < turn and np.hypot(x - place[m, 0], y - place[m, 1]) < min_separation:
                new = False
                break
        if new:
            chosen[count], place[count, 0], place[count, 1] = h, x, y
            count += 1
            if count == max_count:
                break
    return chosen[:count]


@njit(cache=True, nogil=True)
def pair_information(
    error_a: F64x1, error_b: F64x1, c: float, s: float, slack: float
) -> InverseCovariance:  # pragma: no cover - compiled
    """xx, xy and yy of the inverse covariance, in a's axes, of where two landmarks are from each other: errors (3,) are xx, xy
    and yy of each in its own frame, a's turned from b's by an angle of cosine c and sine s, and slack of both axes (m).
    """
    bxx, bxy, byy = error_b[_XX], error_b[_XY], error_b[_YY]
    xx = error_a[_XX] + c * c * bxx - 2.0 * c * s * bxy + s * s * byy + slack * slack
    yy = error_a[_YY] + s * s * bxx + 2.0 * c * s * bxy + c * c * byy + slack * slack
    xy = error_a[_XY] + c * s * (bxx - byy) + (c * c - s * s) * bxy
    size = xx * yy - xy * xy
    return InverseCovariance(yy / size, -xy / size, xx / size)


@njit(cache=True, nogil=True)
def match_one_to_one(
    pose: F64x1, a: OrientedLandmarks, b: OrientedLandmarks, is_compatible: Boolx2, slack: float, gate: float
) -> tuple[I64x2, F64x1]:  # pragma: no cover - compiled
    """One-to-one pairs (P, 2), nearest first, and their squared misfits (P,) in standard deviations (3 numbers a
    pair).
    """
    xy_a, yaw_a, error_a, syaw_a = a
    xy_b, yaw_b, error_b, syaw_b = b
    c, s = np.cos(pose[2]), np.sin(pose[2])
    rows = np.empty((len(xy_a) * len(xy_b), 2), np.int64)
    cost = np.empty(len(xy_a) * len(xy_b))
    count = 0
    for k in range(len(xy_b)):
        x = c * xy_b[k, 0] - s * xy_b[k, 1] + pose[0]
        y = s * xy_b[k, 0] + c * xy_b[k, 1] + pose[1]
        for i in range(len(xy_a)):
            dx, dy = x - xy_a[i, 0], y - xy_a[i, 1]
            widest = error_a[i, _XX] + error_a[i, _YY] + error_b[k, _XX] + error_b[k, _YY] + slack * slack
            if dx * dx + dy * dy > gate * widest or not is_compatible[i, k]:
                continue
            wxx, wxy, wyy = pair_information(error_a[i], error_b[k], c, s, slack)
            turn = wrap_half_turn(yaw_a[i] - yaw_b[k] - pose[2])
            square = wxx * dx * dx + 2.0 * wxy * dx * dy + wyy * dy * dy
            square += turn * turn / (syaw_a[i] ** 2 + syaw_b[k] ** 2 + (0.1 * slack) ** 2)
            if square < gate:
                rows[count, 0], rows[count, 1], cost[count] = i, k, square
                count += 1
    used_a, used_b = np.zeros(len(xy_a), np.bool_), np.zeros(len(xy_b), np.bool_)
    taken = 0
    order = argsort(cost[:count])
    pairs, misfit = np.empty((count, 2), np.int64), np.empty(count)
    for m in order:
        i, k = rows[m, 0], rows[m, 1]
        if used_a[i] or used_b[k]:
            continue
        used_a[i] = used_b[k] = True
        pairs[taken, 0], pairs[taken, 1], misfit[taken] = i, k, cost[m]
        taken += 1
    return pairs[:taken], misfit[:taken]


@njit(cache=True, nogil=True)
def fit_pose(
    pose: F64x1, pairs: I64x2, a: OrientedLandmarks, b: OrientedLandmarks, rounds: int
) -> tuple[F64x1, F64x2]:  # pragma: no cover - compiled
    """Least squares on given pairs from a pose (3,): pose and the information matrix (3, 3) of x, y, yaw."""
    xy_a, yaw_a, error_a, syaw_a = a
    xy_b, yaw_b, error_b, syaw_b = b
    pose = pose.copy()
    information = np.zeros((3, 3))
    for _round in range(rounds):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        information[:] = 0.0
        gradient = np.zeros(3)
        for p in range(len(pairs)):
            i, k = pairs[p, 0], pairs[p, 1]
            wxx, wxy, wyy = pair_information(error_a[i], error_b[k], c, s, 0.0)
            v = 1.0 / (syaw_a[i] ** 2 + syaw_b[k] ** 2)
            ux, uy = c * xy_b[k, 0] - s * xy_b[k, 1], s * xy_b[k, 0] + c * xy_b[k, 1]
            rx, ry = xy_a[i, 0] - ux - pose[0], xy_a[i, 1] - uy - pose[1]
            # What a turn of the pose moves the landmark by, weighed.
            tx, ty = wxy * ux - wxx * uy, wyy * ux - wxy * uy
            information[0, 0] += wxx
            information[0, 1] += wxy
            information[1, 1] += wyy
            information[0, 2] += tx
            information[1, 2] += ty
            information[2, 2] += ux * ty - uy * tx + v
            gradient[0] += wxx * rx + wxy * ry
            gradient[1] += wxy * rx + wyy * ry
            gradient[2] += tx * rx + ty * ry + v * wrap_half_turn(yaw_a[i] - yaw_b[k] - pose[2])
        information[1, 0], information[2, 0], information[2, 1] = (
            information[0, 1],
            information[0, 2],
            information[1, 2],
        )
        if information[0, 0] <= 0.0:
            break
        step = _solve_symmetric(information, gradient)
        pose += step
        pose[2] = (pose[2] + _PI) % (2.0 * _PI) - _PI
        if max(abs(step[0]), abs(step[1]), abs(step[2])) < 1e-11:
            break
    return pose, information


@njit(cache=True, nogil=True)
def _solve_symmetric(matrix: F64x2, right: F64x1) -> F64x1:  # pragma: no cover - compiled
    """Return the solution (3,) of a positive definite system (3, 3), by its factors L D L'."""
    l10, l20 = matrix[0, 1] / matrix[0, 0], matrix[0, 2] / matrix[0, 0]
    d1 = matrix[1, 1] - l10 * matrix[0, 1]
    l21 = (matrix[1, 2] - l20 * matrix[0, 1]) / d1
    d2 = matrix[2, 2] - l20 * matrix[0, 2] - l21 * l21 * d1
    out = np.empty(3)
    y1 = right[1] - l10 * right[0]
    out[2] = (right[2] - l20 * right[0] - l21 * y1) / d2
    out[1] = y1 / d1 - l21 * out[2]
    out[0] = right[0] / matrix[0, 0] - l10 * out[1] - l20 * out[2]
    return out


@njit(cache=True, nogil=True)
def refine_pose(
    pose: F64x1,
    a: OrientedLandmarks,
    b: OrientedLandmarks,
    is_compatible: Boolx2,
    slack: float,
    gate: float,
    rounds: int,
) -> RefinedPose:  # pragma: no cover - compiled
    """Alternate pairing and fitting until the pairs are constant; wide at first, then as exact as stated."""
    information = np.zeros((3, 3))
    before = np.full((1, 2), -1, np.int64)
    for round_ in range(rounds):
        wide = slack * 0.5**round_ if round_ < 4 else 0.0
        pairs, misfit = match_one_to_one(pose, a, b, is_compatible, wide, gate)
        if len(pairs) == 0:
            return RefinedPose(pose, information, pairs, misfit)
        if wide == 0.0 and len(pairs) == len(before) and (pairs == before).all():
            break
        before = pairs
        pose, information = fit_pose(pose, pairs, a, b, 12)
    pairs, misfit = match_one_to_one(pose, a, b, is_compatible, 0.0, gate)
    return RefinedPose(pose, information, pairs, misfit)


@njit(cache=True, nogil=True)
def refine_poses(
    starts: F64x2,
    a: OrientedLandmarks,
    b: OrientedLandmarks,
    is_compatible: Boolx2,
    slack: float,
    gate: float,
    rounds: int,
) -> RefinedPoses:  # pragma: no cover - compiled
    """Refine each of the poses (K, 3) by :func:`refine_pose`."""
    max_pairs = min(len(a.xy), len(b.xy))
    poses, information = np.empty((len(starts), 3)), np.empty((len(starts), 3, 3))
    pairs, misfit = np.empty((len(starts) * max_pairs, 2), np.int64), np.empty(len(starts) * max_pairs)
    start = np.zeros(len(starts) + 1, np.int64)
    for k in range(len(starts)):
        refined = refine_pose(starts[k], a, b, is_compatible, slack, gate, rounds)
        poses[k], information[k] = refined.pose, refined.information
        first, last = start[k], start[k] + len(refined.pairs)
        pairs[first:last], misfit[first:last], start[k + 1] = refined.pairs, refined.misfit, last
    return RefinedPoses(poses, information, pairs[: start[-1]], misfit[: start[-1]], start)


@njit(cache=True, nogil=True)
def select_separate(
    poses: F64x2, middles: F64x2, max_distance: float, max_turn: float
) -> I64x1:  # pragma: no cover - compiled
    """Return rows of poses (K, 3), best first, without those alike a better one: within ``max_turn`` radians of it, and within
    ``max_distance`` metres at its middle (K, 2), a point of b.
    """
    rows, count = np.empty(len(poses), np.int64), 0
    for n in range(len(poses)):
        new = True
        for m in rows[:count]:
            turn = abs((poses[n, 2] - poses[m, 2] + _PI) % (2.0 * _PI) - _PI)
            if turn >= max_turn:
                continue
            x, y = _transform(poses[n], middles[m])
            better_x, better_y = _transform(poses[m], middles[m])
            if np.hypot(x - better_x, y - better_y) < max_distance:
                new = False
                break
        if new:
            rows[count] = n
            count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def _transform(pose: F64x1, point: F64x1) -> tuple[float, float]:  # pragma: no cover - compiled
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + c * point[0] - s * point[1], pose[1] + s * point[0] + c * point[1]
