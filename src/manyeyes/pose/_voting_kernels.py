# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the voting: hypotheses from matching edges, their support, and refinement on one-to-one pairs.

An edge joins two landmarks of one agent. Its length and its angles to the two headings (modulo pi) do not depend on the frame.
Two matched edges give the relative pose with a yaw as exact as the edge is long. A single pair of objects gives a yaw only as
exact as a detected heading, which is an error of two metres at 50 m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import Boolx2, F64x1, F64x2, I64x1, I64x2, njit

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


class LandmarkGrid(NamedTuple):
    """Points by square cells: cell c = column * num_rows + row holds ``order[start[c]:start[c + 1]]``; columns go along x."""

    order: I64x1
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


class RefinedPose(NamedTuple):
    """pose: (3,) x, y, yaw; information: (3, 3) of it; pairs: (P, 2) landmarks of a and b; misfit: (P,) squared."""

    pose: F64x1
    information: F64x2
    pairs: I64x2
    misfit: F64x1


@njit(cache=True, nogil=True)
def wrap_half_turn(angle: float) -> float:  # pragma: no cover - compiled
    """Return an angle modulo pi, in [-pi/2, pi/2)."""
    return (angle + 0.5 * _PI) % _PI - 0.5 * _PI


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
    max_poses: int,
) -> tuple[F64x2, F64x1]:  # pragma: no cover - compiled
    """Return poses (H, 3) a_from_b of edges that agree within ``gate`` standard deviations, and their squared residuals (H,).

    edges_a, edges_b: by ascending length. is_compatible: (N, M) pairs that may be one object. Only the first max_poses are
    returned.
    """
    xy_a, _, sxy_a, syaw_a = a
    xy_b, _, sxy_b, syaw_b = b
    ends_a, length_a, direction_a, heading_a = edges_a
    ends_b, length_b, direction_b, heading_b = edges_b
    out = np.empty((max_poses, 3))
    misfit = np.empty(max_poses)
    count = 0
    largest = 0.0
    if len(sxy_a) and len(sxy_b):
        largest = gate * 2.0 * max(sxy_a.max(), sxy_b.max())
    low = 0
    for p in range(len(ends_a)):
        while low < len(ends_b) and length_b[low] < length_a[p] - largest:
            low += 1
        i, j = ends_a[p, 0], ends_a[p, 1]
        for q in range(low, len(ends_b)):
            if length_b[q] > length_a[p] + largest:
                break
            for way in range(2):
                k, m = ends_b[q, way], ends_b[q, 1 - way]
                if not (is_compatible[i, k] and is_compatible[j, m]):
                    continue
                spread = sxy_a[i] ** 2 + sxy_b[k] ** 2 + sxy_a[j] ** 2 + sxy_b[m] ** 2
                cost = (length_a[p] - length_b[q]) ** 2 / spread
                if cost > gate * gate:
                    continue
                tilt = spread / (length_a[p] * length_b[q])
                one = wrap_half_turn(heading_a[p, 0] - heading_b[q, way])
                two = wrap_half_turn(heading_a[p, 1] - heading_b[q, 1 - way])
                # Headings relative to the edge: one unknown turn of the edge, two measured angles.
                v1, v2 = syaw_a[i] ** 2 + syaw_b[k] ** 2, syaw_a[j] ** 2 + syaw_b[m] ** 2
                weight = 1.0 / tilt + 1.0 / v1 + 1.0 / v2
                turn = (one / v1 + two / v2) / weight
                cost += turn * turn / tilt + (one - turn) ** 2 / v1 + (two - turn) ** 2 / v2
                if cost > gate * gate or count == max_poses:
                    continue
                yaw = direction_a[p] - direction_b[q] + turn + (_PI if way else 0.0)
                c, s = np.cos(yaw), np.sin(yaw)
                mx, my = 0.5 * (xy_b[k, 0] + xy_b[m, 0]), 0.5 * (xy_b[k, 1] + xy_b[m, 1])
                out[count, 0] = 0.5 * (xy_a[i, 0] + xy_a[j, 0]) - (c * mx - s * my)
                out[count, 1] = 0.5 * (xy_a[i, 1] + xy_a[j, 1]) - (s * mx + c * my)
                out[count, 2] = (yaw + _PI) % (2.0 * _PI) - _PI
                misfit[count] = cost
                count += 1
    return out[:count], misfit[:count]


@njit(cache=True, nogil=True)
def build_grid(xy: F64x2, cell: float) -> LandmarkGrid:  # pragma: no cover - compiled
    """Sort points (N, 2) into square cells of edge cell; cells grow where there would be too many."""
    x0, y0, x1, y1 = xy[:, 0].min(), xy[:, 1].min(), xy[:, 0].max(), xy[:, 1].max()
    cell = max(cell, max(x1 - x0, y1 - y0) / 1000.0)
    nx, ny = int((x1 - x0) / cell) + 1, int((y1 - y0) / cell) + 1
    key = np.empty(len(xy), np.int64)
    start = np.zeros(nx * ny + 1, np.int64)
    for n in range(len(xy)):
        key[n] = int((xy[n, 0] - x0) / cell) * ny + int((xy[n, 1] - y0) / cell)
        start[key[n] + 1] += 1
    start = np.cumsum(start)
    order = np.argsort(key, kind="mergesort")
    return LandmarkGrid(order, start, x0, y0, nx, ny, cell)


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
    """Return (H,) sum over landmarks of b of the best max(0, 1 - d^2 / tau^2) among a's."""
    xy_a, yaw_a, _, _ = a
    xy_b, yaw_b, _, _ = b
    order, start, x0, y0, nx, ny, cell = grid
    score = np.zeros(len(poses))
    for h in range(len(poses)):
        c, s = np.cos(poses[h, 2]), np.sin(poses[h, 2])
        total = 0.0
        for k in range(len(xy_b)):
            x = c * xy_b[k, 0] - s * xy_b[k, 1] + poses[h, 0]
            y = s * xy_b[k, 0] + c * xy_b[k, 1] + poses[h, 1]
            i0, i1 = int(np.floor((x - tau - x0) / cell)), int(np.floor((x + tau - x0) / cell))
            j0, j1 = int(np.floor((y - tau - y0) / cell)), int(np.floor((y + tau - y0) / cell))
            if i1 < 0 or j1 < 0 or i0 >= nx or j0 >= ny:
                continue
            best = 0.0
            for i in range(max(i0, 0), min(i1, nx - 1) + 1):
                for m in range(start[i * ny + max(j0, 0)], start[i * ny + min(j1, ny - 1) + 1]):
                    r = order[m]
                    gain = 1.0 - ((x - xy_a[r, 0]) ** 2 + (y - xy_a[r, 1]) ** 2) / (tau * tau)
                    if gain <= best or not is_compatible[r, k]:
                        continue
                    if abs(wrap_half_turn(yaw_a[r] - yaw_b[k] - poses[h, 2])) < turn:
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
    order = np.argsort(cost[:count], kind="mergesort")
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
        step = np.linalg.solve(information, gradient)
        pose += step
        pose[2] = (pose[2] + _PI) % (2.0 * _PI) - _PI
        if np.abs(step).max() < 1e-11:
            break
    return pose, information


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
