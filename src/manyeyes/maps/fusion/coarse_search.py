# SPDX-License-Identifier: Apache-2.0
"""Coarse pose search: correlate each observation with the lines of other agents over a grid of shifts and yaws.

For each observation the points of *other* agents are drawn into a soft raster in its own frame, one layer per class and 30
degrees of heading, and every shift (and a few yaws) is tried. A layer has value s / (s + 1), with s about the number of agents
that detected a line there. So dense lines do not dominate, and support by more agents is still preferred.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from manyeyes._jit import Boolx1, F32x3, F64x1, F64x2, I64x1, njit
from manyeyes.maps.fusion.observation_arrays import ObservationArrays
from manyeyes.maps.fusion.point_grid import build_grid, find_cell_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NUM_LAYERS = 24
"""Of a raster: six sectors of 30 degrees of each class."""


class SearchParameters(NamedTuple):
    """The values of CoarseSearchConfig as compiled loops read them."""

    max_shift_m: float
    cell_m: float
    min_score_gain: float
    min_shift_m: float
    cost_per_m: float
    yaw_steps_rad: F64x1
    point_stride: int


class SearchedObservations(NamedTuple):
    """O observations: prior poses (O, 3), whether they are surveyed and their agents (O,); offsets (O + 1,), positions and unit
    tangents (P, 2) in their own frames and kinds (P,) of their points.
    """

    pose: F64x2
    trusted: Boolx1
    agent: I64x1
    offsets: I64x1
    xy: F64x2
    tangent: F64x2
    kind: I64x1


class DrawnPoints(NamedTuple):
    """Points in the order of their grid of 8 m: its keys and offsets, positions (P, 2) in the map's frame, headings (P,) of their
    lines in half turns, and agents (P,).
    """

    keys: I64x1
    start: I64x1
    xy: F64x2
    heading: F64x1
    agent: I64x1


class _RasterFrame(NamedTuple):
    """A raster in an observation's frame: its lower corner (m), numbers of cells along x and y, and their edge (m)."""

    x0: float
    y0: float
    nx: int
    ny: int
    cell: float


@dataclass(frozen=True)
class CoarseSearchConfig:
    """Configuration of the coarse search.

    max_shift_m: largest shift along x and y; cell_m: its step.
    min_score_gain: smallest gain of the mean value per point. min_shift_m: smaller shifts are left to Gauss-Newton.
    cost_per_m: cost per metre of shift. yaw_steps_rad: yaws that are tried.
    point_stride: every n-th point is evaluated.
    """

    max_shift_m: float = 4.5
    cell_m: float = 0.5
    min_score_gain: float = 0.06
    min_shift_m: float = 1.2
    cost_per_m: float = 0.012
    yaw_steps_rad: tuple[float, ...] = (0.0,)
    point_stride: int = 2

    @property
    def kernel_params(self) -> SearchParameters:
        """The configuration as compiled loops read it."""
        return SearchParameters(
            self.max_shift_m,
            self.cell_m,
            self.min_score_gain,
            self.min_shift_m,
            self.cost_per_m,
            np.array(self.yaw_steps_rad),
            self.point_stride,
        )


def search_coarse(arrays: ObservationArrays, keep: NDArray[np.bool_], home: Ints, config: CoarseSearchConfig) -> Floats:
    """Search the poses (H, 3) of the home observations; ``keep`` (P,) are the points of the raster.

    Trusted observations keep their poses.
    """
    xy, tangent = arrays.to_world(np.asarray(arrays.pose))
    chosen = np.flatnonzero(keep)
    grid = build_grid(xy[chosen, 0], xy[chosen, 1], arrays.kind_of_point[chosen], 8.0)
    rows = chosen[grid.order]
    agent = arrays.agent[arrays.observation_of_point[rows]]
    drawn = DrawnPoints(grid.keys, grid.offsets, xy.take(rows, 0), count_half_turns(tangent.take(rows, 0)), agent)
    shifts = find_best_shifts(home, to_searched_observations(arrays), drawn, config.kernel_params)
    return apply_shifts(arrays, home, shifts)


def count_half_turns(tangent: Floats) -> Floats:
    """Compute the headings (P,), in half turns, of unit tangents (P, 2)."""
    return np.arctan2(tangent[:, 1], tangent[:, 0]) / np.pi


def to_searched_observations(arrays: ObservationArrays) -> SearchedObservations:
    """Gather the observations for the compiled search."""
    return SearchedObservations(
        np.asarray(arrays.pose),
        np.asarray(arrays.trusted),
        np.asarray(arrays.agent),
        arrays.observation_offsets,
        arrays.xy,
        arrays.tangent,
        arrays.kind_of_point,
    )


def apply_shifts(arrays: ObservationArrays, home: Ints, shifts: Floats) -> Floats:
    """Apply shifts (H, 3), in the observations' own frames, to the prior poses (H, 3)."""
    start = np.asarray(arrays.pose)[home]
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    x, y = shifts[:, 0], shifts[:, 1]
    return np.stack((start[:, 0] + c * x - s * y, start[:, 1] + s * x + c * y, start[:, 2] + shifts[:, 2]), 1)


def find_isolated_shifts(
    drives: tuple[str, ...], xy: Floats, is_shifted: NDArray[np.bool_], radius_m: float
) -> NDArray[np.bool_]:
    """Find the shifted observations (O,) whose drive was shifted at no more than half of its observations nearby.

    The error of a prior pose is mostly common to a drive, so that a shift of one observation among others that fit where they are
    is taken for a lock on the wrong line.

    Args:
        drives: (O,) drive of each observation. xy: (O, 2) metres, prior positions. is_shifted: (O,).
        radius_m: of the drive's observations, those within this distance count, the observation itself included.
    """
    if not is_shifted.any():
        return is_shifted
    # Drives lie in planes too far apart to count.
    drive = np.unique(np.array(drives), return_inverse=True)[1]
    place = np.concatenate((xy, 4.0 * radius_m * drive[:, None]), 1)
    total, shifted = (
        KDTree(place[rows]).query_ball_point(place, radius_m, return_length=True)
        for rows in (np.arange(len(place)), np.flatnonzero(is_shifted))
    )
    return is_shifted & (2 * np.asarray(shifted) <= np.asarray(total))


@njit(cache=True, nogil=True)
def find_best_shifts(
    home: I64x1, observations: SearchedObservations, others: DrawnPoints, params: SearchParameters
) -> F64x2:  # pragma: no cover - compiled
    """Find the shift (H, 3) of each home observation, in its own frame, with the best score; zero for none."""
    pose, trusted, agent, first, xy, tangent, kind = observations
    max_shift, cell, min_gain, min_shift, cost_per_m, yaw_steps, stride = params
    shifts = np.zeros((len(home), 3))
    radius = int(np.floor(max_shift / cell))
    for h in range(len(home)):
        o = home[h]
        a, b = first[o], first[o + 1]
        if trusted[o] or b - a < 8:
            continue
        x0, y0 = xy[a:b, 0].min() - max_shift - 2.0, xy[a:b, 1].min() - max_shift - 2.0
        nx = int((xy[a:b, 0].max() + max_shift + 2.0 - x0) / cell) + 1
        ny = int((xy[a:b, 1].max() + max_shift + 2.0 - y0) / cell) + 1
        frame = _RasterFrame(x0, y0, nx, ny, cell)
        picture, is_blurred = _count_points(pose[o], int(agent[o]), others, frame), np.zeros(NUM_LAYERS, np.bool_)
        best, bx, by, bt = 0.0, 0, 0, 0.0
        at_rest = 0.0
        for turn in yaw_steps:
            layer, column, row = _find_cells(xy[a:b], tangent[a:b], kind[a:b], frame, turn, stride)
            _blur_layers(picture, layer, is_blurred)
            score = _correlate(picture, layer, column, row, radius)
            if turn == 0.0:
                at_rest = score[radius, radius]
                best = max(best, at_rest)
            for i in range(2 * radius + 1):
                for j in range(2 * radius + 1):
                    shift = np.hypot(i - radius, j - radius) * cell
                    value = score[i, j] - cost_per_m * shift
                    if value > best:
                        best, bx, by, bt = value, i - radius, j - radius, turn
        if best > at_rest + min_gain and np.hypot(bx, by) * cell > min_shift:
            c, s = np.cos(bt), np.sin(bt)
            mx, my = xy[a:b, 0].mean(), xy[a:b, 1].mean()
            shifts[h, 0] = bx * cell + mx - (c * mx - s * my)
            shifts[h, 1] = by * cell + my - (s * mx + c * my)
            shifts[h, 2] = bt
    return shifts


@njit(cache=True, nogil=True)
def _count_points(
    pose: F64x1, agent: int, others: DrawnPoints, frame: _RasterFrame
) -> F32x3:  # pragma: no cover - compiled
    """Count the points of other agents in the frame of a pose: (layers, nx, ny), each point in two layers of heading."""
    keys, start, rxy, heading, ragent = others
    x0, y0, nx, ny, cell = frame
    picture, one = np.zeros((NUM_LAYERS, nx, ny), np.float32), np.float32(1.0)
    c, s, turn = np.cos(pose[2]), np.sin(pose[2]), pose[2] / np.pi
    cx, cy = x0 + nx * cell / 2, y0 + ny * cell / 2
    wx, wy = c * cx - s * cy + pose[0], s * cx + c * cy + pose[1]
    half = np.hypot(nx, ny) * cell / 2
    ix0, ix1 = int(np.floor((wx - half) / 8.0)), int(np.floor((wx + half) / 8.0))
    iy0, iy1 = int(np.floor((wy - half) / 8.0)), int(np.floor((wy + half) / 8.0))
    for k in range(NUM_LAYERS // 6):
        for ix in range(ix0, ix1 + 1):
            low, high = find_cell_range(keys, start, k, ix, iy0, iy1)
            for q in range(low, high):
                if ragent[q] == agent:
                    continue
                dx, dy = rxy[q, 0] - pose[0], rxy[q, 1] - pose[1]
                i = int(np.floor((c * dx + s * dy - x0) / cell))
                j = int(np.floor((-s * dx + c * dy - y0) / cell))
                # Two cells on each side hold what spreads there from others.
                if i < 2 or j < 2 or i >= nx - 2 or j >= ny - 2:
                    continue
                sector = (heading[q] - turn) * 6.0
                below = np.floor(sector)
                here = int(below - 6.0 * np.floor(below / 6.0))
                beside = (here + (1 if sector - below > 0.5 else 5)) % 6
                picture[6 * k + here, i, j] += one
                picture[6 * k + beside, i, j] += one
    return picture


@njit(cache=True, nogil=True)
def _find_cells(
    xy: F64x2, tangent: F64x2, kind: I64x1, frame: _RasterFrame, turn: float, stride: int
) -> tuple[I64x1, I64x1, I64x1]:  # pragma: no cover - compiled
    """Find layer, column and row (N,) of every stride-th point after a turn about the mean of all points."""
    x0, y0, _, _, cell = frame
    c, s = np.cos(turn), np.sin(turn)
    mx, my = xy[:, 0].mean(), xy[:, 1].mean()
    count = (len(xy) + stride - 1) // stride
    layer, column, row = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    for n in range(count):
        p = n * stride
        dx, dy = xy[p, 0] - mx, xy[p, 1] - my
        column[n] = int(np.floor((c * dx - s * dy + mx - x0) / cell))
        row[n] = int(np.floor((s * dx + c * dy + my - y0) / cell))
        u, v = c * tangent[p, 0] - s * tangent[p, 1], s * tangent[p, 0] + c * tangent[p, 1]
        layer[n] = 6 * kind[p] + int(np.floor((np.arctan2(v, u) / np.pi % 1.0) * 6.0)) % 6
    return layer, column, row


@njit(cache=True, nogil=True)
def _blur_layers(picture: F32x3, layers: I64x1, is_blurred: Boolx1) -> None:  # pragma: no cover - compiled
    """Blur the counts of layers that are not blurred yet to s: Gaussian of one cell within two cells, along both axes."""
    nx, ny = picture.shape[1:]
    # 0.8: a line sampled once a metre gives about 1 on it.
    middle, first, second = np.float32(0.8), np.float32(0.8 * np.exp(-0.5)), np.float32(0.8 * np.exp(-2.0))
    next_row, last_row = np.float32(np.exp(-0.5)), np.float32(np.exp(-2.0))
    along = np.zeros((nx + 4, ny), np.float32)
    for layer in layers:
        if is_blurred[layer]:
            continue
        is_blurred[layer] = True
        for i in range(nx):
            counts, out = picture[layer, i], along[i + 2]
            for j in range(2, ny - 2):
                out[j] = middle * counts[j] + first * (counts[j - 1] + counts[j + 1])
                out[j] += second * (counts[j - 2] + counts[j + 2])
            # Counts of the two outer cells are zero.
            out[0], out[1] = second * counts[2], first * counts[2] + second * counts[3]
            out[ny - 1], out[ny - 2] = second * counts[ny - 3], first * counts[ny - 3] + second * counts[ny - 4]
        for i in range(nx):
            out = picture[layer, i]
            for j in range(ny):
                out[j] = along[i + 2, j] + next_row * (along[i + 1, j] + along[i + 3, j])
                out[j] += last_row * (along[i, j] + along[i + 4, j])


@njit(cache=True, nogil=True)
def _correlate(
    picture: F32x3, layer: I64x1, column: I64x1, row: I64x1, radius: int
) -> F64x2:  # pragma: no cover - compiled
    """Compute the mean of s / (s + 1) under points, whose cells are given, for each shift (2 radius + 1, 2 radius + 1)."""
    nx, ny = picture.shape[1:]
    score, one = np.zeros((2 * radius + 1, 2 * radius + 1)), np.float32(1.0)
    for n in range(len(layer)):
        i, j = column[n], row[n]
        if i < radius or j < radius or i >= nx - radius or j >= ny - radius:
            continue
        for di in range(2 * radius + 1):
            under = picture[layer[n], i + di - radius, j - radius : j + radius + 1]
            for dj in range(2 * radius + 1):
                score[di, dj] += under[dj] / (under[dj] + one)
    return score / max(1, len(layer))
