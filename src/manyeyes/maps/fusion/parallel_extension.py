# SPDX-License-Identifier: Apache-2.0
"""Extend a polyline parallel to a neighbour across poorly covered gaps.

A missed detection hides one line and not its neighbour. Where a chain of stations ends, a line beside it that has been parallel
so far serves as a guide. Stations are inferred at constant distance from the guide until they arrive at another part of the
same line or, if they do not arrive, for a limited length. They are inferred only where the guide is covered at least once and
at most ``max_coverage`` times, so that missing the line by chance is plausible. The method is this project's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import BOUNDARY
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CELL_M = 2.5
_MAX_LONGITUDINAL_M = 0.8  # along a line, within which a point of it lies beside another point


@dataclass(frozen=True)
class ParallelExtensionConfig:
    """Configuration of the extension.

    min_guide_m, max_guide_m: lateral distance of a guide.
    max_spacing_change_m: largest change of that distance over the last parallel_length_m of the line.
    max_heading_rad: largest angle between line and guide.
    max_coverage: largest summed visibility of an inferred station.
    max_lateral_m: largest lateral offset on arrival at the other part of the line.
    max_bridge_m: largest length that arrives; max_open_m: by kind, largest length that does not (divider, boundary, crossing,
        stop line).
    """

    min_guide_m: float = 2.0
    max_guide_m: float = 5.0
    max_spacing_change_m: float = 0.5
    parallel_length_m: float = 8.0
    max_heading_rad: float = 0.15
    max_coverage: float = 5.0
    max_lateral_m: float = 1.2
    max_bridge_m: float = 80.0
    max_open_m: tuple[float, float, float, float] = (40.0, 0.0, 0.0, 0.0)


def extend_parallel(
    xy: Floats,
    kind: Ints,
    coverage: Floats,
    chains: tuple[Ints, Ints],
    config: ParallelExtensionConfig = ParallelExtensionConfig(),
) -> tuple[Floats, Floats, Ints]:
    """Inferred stations (V, 2), their unit tangents and the end station (V,) that each continues.

    xy, kind, coverage: (K,) stations, as in :func:`~manyeyes.maps.fusion.polyline_linking.link_stations`, which returns ``chains``.
    """
    offsets, members = chains
    chain, place = np.empty(len(xy), np.int64), np.empty(len(xy), np.int64)
    chain[members] = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    place[members] = np.arange(len(members))
    grid = build_grid(xy[:, 0], xy[:, 1], np.zeros(len(xy), np.int64), _CELL_M)
    line = xy[members]
    chains_of = _Chains(offsets, line, _chords(line, offsets), kind[members], coverage[members], chain[members])
    return _extend_chains(members, chains_of, grid._replace(order=place[grid.order]), _limits(config))


class _Chains(NamedTuple):
    """L chains of stations: chain c is rows ``first[c]:first[c + 1]`` of the columns, which have a row (M,) a station.

    direction: (M, 2) unit vector of the chain. coverage: summed visibility. chain: index of the chain.
    """

    first: I64x1
    xy: F64x2
    direction: F64x2
    kind: I64x1
    coverage: F64x1
    chain: I64x1


class _ExtensionLimits(NamedTuple):
    """The fields of ParallelExtensionConfig, all as floats, max_heading_rad as a cosine; max_open_m: (4,) by kind."""

    min_distance_m: float
    max_distance_m: float
    max_distance_change_m: float
    lookback_m: float
    min_cosine: float
    max_coverage: float
    max_lateral_m: float
    max_bridge_m: float
    max_open_m: F64x1


def _limits(config: ParallelExtensionConfig) -> _ExtensionLimits:
    return _ExtensionLimits(
        min_distance_m=float(config.min_guide_m),
        max_distance_m=float(config.max_guide_m),
        max_distance_change_m=float(config.max_spacing_change_m),
        lookback_m=float(config.parallel_length_m),
        min_cosine=float(np.cos(config.max_heading_rad)),
        max_coverage=float(config.max_coverage),
        max_lateral_m=float(config.max_lateral_m),
        max_bridge_m=float(config.max_bridge_m),
        max_open_m=np.array(config.max_open_m),
    )


def _chords(line: Floats, offsets: Ints) -> Floats:
    """Return (M, 2) unit direction of each chain at its points, over three points on each side."""
    at = np.arange(len(line))
    low, high = np.repeat(offsets[:-1], np.diff(offsets)), np.repeat(offsets[1:] - 1, np.diff(offsets))
    step = line[np.minimum(at + 3, high)] - line[np.maximum(at - 3, low)]
    return step / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]


@njit(cache=True, nogil=True)
def _extend_chains(
    members: I64x1, lines: _Chains, grid: PointGrid, params: _ExtensionLimits
) -> tuple[F64x2, F64x2, I64x1]:  # pragma: no cover - compiled
    """Inferred stations (V, 2), unit tangents (V, 2) and the end station (V,), of members, that each continues.

    grid: of the points of the chains, its order in rows of lines.
    """
    offsets, chord, kind, chain = lines.first, lines.direction, lines.kind, lines.chain
    xy, tangent, source = [(0.0, 0.0)], [(0.0, 0.0)], [0]
    path, turn = np.empty((1024, 2)), np.empty((1024, 2))
    is_bridged = np.zeros(len(chain), np.bool_)
    for c in range(len(offsets) - 1):
        if offsets[c + 1] - offsets[c] < 4 or kind[offsets[c]] > BOUNDARY:
            continue
        for side in range(2):
            end, inward = (offsets[c], 1) if side == 0 else (offsets[c + 1] - 1, -1)
            # Of two ends that lead to each other one is enough.
            if is_bridged[end]:
                continue
            best, arrived = 0, -1
            for g in _find_guides(end, inward, lines, grid, params):
                against = (chord[g, 0] * chord[end, 0] + chord[g, 1] * chord[end, 1]) * inward > 0.0
                n, gap, at = _follow_guide(end, g, -1 if against else 1, lines, grid, params, path, turn)
                # One that arrives before one that does not, then the longer.
                if n == 0 or (arrived >= 0 and at < 0) or ((at >= 0) == (arrived >= 0) and n <= best):
                    continue
                for _ in range(best):
                    xy.pop()
                    tangent.pop()
                    source.pop()
                best, arrived = n, at
                for i in range(n):
                    share = gap * (i + 1) / (n + 1)
                    xy.append((path[i, 0] - turn[i, 1] * share, path[i, 1] + turn[i, 0] * share))
                    tangent.append((turn[i, 0], turn[i, 1]))
                    source.append(int(members[end]))
            if arrived >= 0:
                is_bridged[
                    max(offsets[chain[arrived]], arrived - 4) : min(offsets[chain[arrived] + 1], arrived + 5)
                ] = True
    return np.array(xy)[1:], np.array(tangent)[1:], np.array(source)[1:]


@njit(cache=True, nogil=True)
def _find_guides(
    end: int, inward: int, lines: _Chains, grid: PointGrid, params: _ExtensionLimits
) -> list[int]:  # pragma: no cover - compiled
    """Return points within _MAX_LONGITUDINAL_M, along it, of the end of a chain, on lines that run beside it there and did so
    before.
    """
    offsets, line, chord, kind, _, chain = lines
    keys, start, order = grid.keys, grid.offsets, grid.order
    nearest, farthest, even = params.min_distance_m, params.max_distance_m, params.max_distance_change_m
    back, cosine = params.lookback_m, params.min_cosine
    found = [0]
    x, y = line[end, 0], line[end, 1]
    size = offsets[chain[end] + 1] - offsets[chain[end]]
    inner, walked = end, 0.0
    for _ in range(size - 1):
        if walked >= back:
            break
        walked += np.hypot(line[inner + inward, 0] - line[inner, 0], line[inner + inward, 1] - line[inner, 1])
        inner += inward
    ix, iy = int(np.floor(x / _CELL_M)), int(np.floor(y / _CELL_M))
    wide = int(np.ceil(np.hypot(farthest, _MAX_LONGITUDINAL_M) / _CELL_M))
    for dx in range(-wide, wide + 1):
        low, high = find_cell_range(keys, start, 0, ix + dx, iy - wide, iy + wide)
        for k in range(low, high):
            q = order[k]
            if chain[q] == chain[end] or kind[q] > BOUNDARY:
                continue
            dot = chord[q, 0] * chord[end, 0] + chord[q, 1] * chord[end, 1]
            ex, ey = x - line[q, 0], y - line[q, 1]
            aside, along = chord[q, 0] * ey - chord[q, 1] * ex, chord[q, 0] * ex + chord[q, 1] * ey
            if abs(dot) < cosine or abs(along) > _MAX_LONGITUDINAL_M or abs(aside) < nearest or abs(aside) > farthest:
                continue
            before = _lateral_offset(line[inner, 0], line[inner, 1], int(chain[q]), offsets, line, chord)
            if abs(before - aside) <= even:
                found.append(q)
    return found[1:]


@njit(cache=True, nogil=True)
def _lateral_offset(
    x: float, y: float, c: int, offsets: I64x1, line: F64x2, chord: F64x2
) -> float:  # pragma: no cover - compiled
    """Return how far left of a chain a place lies; inf where it has no foot on it."""
    best, out = np.inf, np.inf
    for q in range(offsets[c], offsets[c + 1]):
        ex, ey = x - line[q, 0], y - line[q, 1]
        square = ex * ex + ey * ey
        if square < best:
            best = square
            along = abs(chord[q, 0] * ex + chord[q, 1] * ey)
            out = chord[q, 0] * ey - chord[q, 1] * ex if along < 3.0 else np.inf
    return out


@njit(cache=True, nogil=True)
def _follow_guide(
    end: int, g: int, ahead: int, lines: _Chains, grid: PointGrid, params: _ExtensionLimits, path: F64x2, turn: F64x2
) -> tuple[int, float, int]:  # pragma: no cover - compiled
    """Return places beside a guide from its point g on, written to way and turn: their number, the gap across where they
    arrive, and at which point (-1: nowhere).
    """
    _, line, chord, kind, coverage, chain = lines
    max_coverage, across, bridge, open_m = (
        params.max_coverage,
        params.max_lateral_m,
        params.max_bridge_m,
        params.max_open_m,
    )
    ex, ey = line[end, 0] - line[g, 0], line[end, 1] - line[g, 1]
    aside = chord[g, 0] * ey - chord[g, 1] * ex
    n, walked, free, q = 0, 0.0, 0, g
    while n < len(path):
        after = q + ahead
        if after < 0 or after >= len(line) or chain[after] != chain[g]:
            break
        step = np.hypot(line[after, 0] - line[q, 0], line[after, 1] - line[q, 1])
        walked, q = walked + step, after
        if step > 6.0 or walked > bridge or coverage[q] > max_coverage or coverage[q] <= 0.5:
            break
        u, v = ahead * chord[q, 0], ahead * chord[q, 1]
        x, y = line[q, 0] - aside * chord[q, 1], line[q, 1] + aside * chord[q, 0]
        if walked > 2.0:
            at, gap = _find_arrival(x, y, u, v, end, lines, grid, across)
            if at >= 0:
                return n, gap, at
        if walked >= 1.0:
            path[n, 0], path[n, 1], turn[n, 0], turn[n, 1] = x, y, u, v
            n += 1
            free = n if walked <= open_m[kind[end]] else free
    return free, 0.0, -1


@njit(cache=True, nogil=True)
def _find_arrival(
    x: float, y: float, u: float, v: float, end: int, lines: _Chains, grid: PointGrid, max_lateral: float
) -> tuple[int, float]:  # pragma: no cover - compiled
    """Return the point of another chain of the end's kind nearest across a way at x, y in direction u, v, and how far left it
    lies; -1: none.
    """
    _, line, chord, kind, _, chain = lines
    keys, start, order = grid.keys, grid.offsets, grid.order
    ix, iy = int(np.floor(x / _CELL_M)), int(np.floor(y / _CELL_M))
    best, at = np.inf, -1
    for dx in range(-1, 2):
        low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
        for k in range(low, high):
            q = order[k]
            if chain[q] == chain[end] or kind[q] != kind[end] or abs(chord[q, 0] * u + chord[q, 1] * v) < 0.9:
                continue
            ex, ey = line[q, 0] - x, line[q, 1] - y
            aside = u * ey - v * ex
            if abs(u * ex + v * ey) <= 1.0 and abs(aside) <= max_lateral and abs(aside) < abs(best):
                best, at = aside, q
    return at, best
