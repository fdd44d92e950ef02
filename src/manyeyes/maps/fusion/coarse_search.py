# SPDX-License-Identifier: Apache-2.0
"""Gross search: an observation that stands metres off is moved to where what other agents saw fits it best.

Stage 1 of specs/maps.md 3.4. For each observation the points of *other* agents are drawn as a soft picture in its own
frame, one layer a class and 30 degrees of heading, and every shift (and a few yaws) is tried. A layer's value s / (s +
1), with s about the number of agents who saw a line there, keeps dense lines from deciding and still prefers what more
agents saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F32x3, F64x1, F64x2, I64x1, njit
from manyeyes.maps.fusion.observation_arrays import Sightings
from manyeyes.maps.fusion.point_grid import build_grid, span

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class GrossConfig:
    """reach_m: largest shift tried along x and y; cell_m: its step; gain: mean value a point must win; least_m: smaller
    shifts are left to the sweeps; price: value a metre of shift costs; yaws: turns tried (rad); stride: every n-th
    point is looked up.
    """

    reach_m: float = 4.5
    cell_m: float = 0.5
    gain: float = 0.06
    least_m: float = 1.2
    price: float = 0.012
    yaws: tuple[float, ...] = (0.0,)
    stride: int = 2


def gross_search(sightings: Sightings, keep: NDArray[np.bool_], home: Ints, config: GrossConfig) -> Floats:
    """Poses (H, 3) of the home observations after the search; ``keep`` (P,) are the points that others may be compared
    with.

    Trusted observations stay where they are.
    """
    xy, tangent = sightings.world(np.asarray(sightings.pose))
    chosen = np.flatnonzero(keep)
    grid = build_grid(xy[chosen, 0], xy[chosen, 1], sightings.kind[chosen], 8.0)
    rows = chosen[grid.order]
    moves = best_moves(
        home,
        np.asarray(sightings.pose),
        np.asarray(sightings.trusted),
        (sightings.first, sightings.xy, sightings.tangent, sightings.kind),
        (
            grid.keys,
            grid.start,
            xy[rows],
            tangent[rows],
            sightings.agent[sightings.observation[rows]],
        ),
        np.asarray(sightings.agent),
        np.array(config.yaws),
        (config.reach_m, config.cell_m, config.gain, config.least_m, config.price),
        config.stride,
    )
    return moved_by(sightings, home, moves)


def moved_by(sightings: Sightings, home: Ints, moves: Floats) -> Floats:
    """Claimed poses (H, 3) moved by moves (H, 3) of their own frames."""
    start = np.asarray(sightings.pose)[home]
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    x, y = moves[:, 0], moves[:, 1]
    return np.stack((start[:, 0] + c * x - s * y, start[:, 1] + s * x + c * y, start[:, 2] + moves[:, 2]), 1)


@njit(cache=True, nogil=True)
def best_moves(
    home: I64x1,
    pose: F64x2,
    trusted: Boolx1,
    own: tuple[I64x1, F64x2, F64x2, I64x1],
    others: tuple[I64x1, I64x1, F64x2, F64x2, I64x1],
    agent: I64x1,
    yaws: F64x1,
    numbers: tuple[float, float, float, float, float],
    stride: int,
) -> F64x2:  # pragma: no cover - compiled
    """The move (H, 3) of each home observation's own frame that fits it best to the points of others, all zero for
    none.
    """
    first, xy, tangent, kind = own
    reach, cell, gain, least, price = numbers
    moves = np.zeros((len(home), 3))
    radius = int(np.floor(reach / cell))
    for h in range(len(home)):
        o = home[h]
        a, b = first[o], first[o + 1]
        if trusted[o] or b - a < 8:
            continue
        x0, y0 = xy[a:b, 0].min() - reach - 2.0, xy[a:b, 1].min() - reach - 2.0
        nx = int((xy[a:b, 0].max() + reach + 2.0 - x0) / cell) + 1
        ny = int((xy[a:b, 1].max() + reach + 2.0 - y0) / cell) + 1
        picture = _draw(pose[o], int(agent[o]), others, x0, y0, nx, ny, cell)
        best, bx, by, bt = 0.0, 0, 0, 0.0
        at_rest = 0.0
        for turn in yaws:
            score = _correlate(picture, xy[a:b], tangent[a:b], kind[a:b], turn, x0, y0, cell, radius, stride)
            if turn == 0.0:
                at_rest = score[radius, radius]
                best = max(best, at_rest)
            for i in range(2 * radius + 1):
                for j in range(2 * radius + 1):
                    shift = np.hypot(i - radius, j - radius) * cell
                    value = score[i, j] - price * shift
                    if value > best:
                        best, bx, by, bt = value, i - radius, j - radius, turn
        if best > at_rest + gain and np.hypot(bx, by) * cell > least:
            c, s = np.cos(bt), np.sin(bt)
            mx, my = xy[a:b, 0].mean(), xy[a:b, 1].mean()
            moves[h, 0] = bx * cell + mx - (c * mx - s * my)
            moves[h, 1] = by * cell + my - (s * mx + c * my)
            moves[h, 2] = bt
    return moves


@njit(cache=True, nogil=True)
def _draw(
    pose: F64x1,
    agent: int,
    others: tuple[I64x1, I64x1, F64x2, F64x2, I64x1],
    x0: float,
    y0: float,
    nx: int,
    ny: int,
    cell: float,
) -> F32x3:  # pragma: no cover - compiled
    """What other agents saw, in the frame of a pose: (layers, nx, ny) of s."""
    keys, start, rxy, rtangent, ragent = others
    picture = np.zeros((24, nx, ny), np.float32)
    stamp = np.empty((5, 5), np.float32)
    for i in range(5):
        for j in range(5):
            # 0.8: a line sampled once a metre gives about 1 on it.
            stamp[i, j] = 0.8 * np.exp(-0.5 * ((i - 2) ** 2 + (j - 2) ** 2))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    cx, cy = x0 + nx * cell / 2, y0 + ny * cell / 2
    wx, wy = c * cx - s * cy + pose[0], s * cx + c * cy + pose[1]
    half = np.hypot(nx, ny) * cell / 2
    ix0, ix1 = int(np.floor((wx - half) / 8.0)), int(np.floor((wx + half) / 8.0))
    iy0, iy1 = int(np.floor((wy - half) / 8.0)), int(np.floor((wy + half) / 8.0))
    for k in range(4):
        for ix in range(ix0, ix1 + 1):
            low, high = span(keys, start, k, ix, iy0, iy1)
            for q in range(low, high):
                if ragent[q] == agent:
                    continue
                dx, dy = rxy[q, 0] - pose[0], rxy[q, 1] - pose[1]
                i = int(np.floor((c * dx + s * dy - x0) / cell))
                j = int(np.floor((-s * dx + c * dy - y0) / cell))
                if i < 2 or j < 2 or i >= nx - 2 or j >= ny - 2:
                    continue
                u = c * rtangent[q, 0] + s * rtangent[q, 1]
                v = -s * rtangent[q, 0] + c * rtangent[q, 1]
                where = (np.arctan2(v, u) / np.pi % 1.0) * 6.0
                one = int(np.floor(where)) % 6
                two = (one + (1 if where - np.floor(where) > 0.5 else 5)) % 6
                for layer in (6 * k + one, 6 * k + two):
                    for di in range(5):
                        for dj in range(5):
                            picture[layer, i + di - 2, j + dj - 2] += stamp[di, dj]
    return picture


@njit(cache=True, nogil=True)
def _correlate(
    picture: F32x3,
    xy: F64x2,
    tangent: F64x2,
    kind: I64x1,
    turn: float,
    x0: float,
    y0: float,
    cell: float,
    radius: int,
    stride: int,
) -> F64x2:  # pragma: no cover - compiled
    """Mean of s / (s + 1) of the picture under the points for each shift (2 radius + 1, 2 radius + 1) after a turn about
    their mean.
    """
    _, nx, ny = picture.shape
    score = np.zeros((2 * radius + 1, 2 * radius + 1))
    c, s = np.cos(turn), np.sin(turn)
    mx, my = xy[:, 0].mean(), xy[:, 1].mean()
    count, one = 0, np.float32(1.0)
    for p in range(0, len(xy), stride):
        dx, dy = xy[p, 0] - mx, xy[p, 1] - my
        i = int(np.floor((c * dx - s * dy + mx - x0) / cell))
        j = int(np.floor((s * dx + c * dy + my - y0) / cell))
        u, v = c * tangent[p, 0] - s * tangent[p, 1], s * tangent[p, 0] + c * tangent[p, 1]
        layer = 6 * kind[p] + int(np.floor((np.arctan2(v, u) / np.pi % 1.0) * 6.0)) % 6
        count += 1
        if i < radius or j < radius or i >= nx - radius or j >= ny - radius:
            continue
        for di in range(2 * radius + 1):
            row = picture[layer, i + di - radius, j - radius : j + radius + 1]
            for dj in range(2 * radius + 1):
                score[di, dj] += row[dj] / (row[dj] + one)
    return score / max(1, count)
