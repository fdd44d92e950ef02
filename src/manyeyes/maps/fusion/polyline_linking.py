# SPDX-License-Identifier: Apache-2.0
"""Link stations to polylines: mutual best neighbours are linked and the lines are smoothed without shrinking bends.

Two stations are linked if each is the other's best partner in that direction. So a line never passes through another's station
and three lines never become one. Gaps and turns are measured along the mean normal of the two: a bend of constant radius has no
lateral gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx2, F64x1, F64x2, I64x1, I64x2, I64x3, njit
from manyeyes.datatypes import ConfigError
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range, line_residual

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

_GUIDE_CELL_M = 2.5
_INWARD_M = 3.0  # from an end into the line, where neighbours are searched
# Sides of a station, by its own tangent.
_FRONT, _BEHIND = 0, 1


@dataclass(frozen=True)
class LinkConfig:
    """Configuration of linking and smoothing.

    max_gap_m: largest gap between linked stations; max_join_gap_m: between line ends in the second round.
    max_dashed_gap_m: between ends of dashed lines.
    max_low_coverage_gap_m: between ends whose summed visibility is at most max_coverage, where missing a line by chance is
        plausible. Gaps longer than max_join_gap_m are not joined where a line runs beside their ends, at most max_guide_m
        away, and none beside their middle: where all lines end, a junction begins.
    max_lateral_m, lateral_slope: largest lateral gap between linked stations at no gap, and its growth per metre.
    max_end_lateral_m, end_lateral_slope: the same between line ends, which have fewer detections and so more scatter.
    max_heading_rad, heading_slope: largest turn at no gap, and its growth per metre.
    max_low_coverage_heading_rad: largest turn over gaps of max_low_coverage_gap_m.
    lateral_cost: metres of gap that a metre of lateral gap costs.
    smoothing_sigma: Gaussian scale, in stations, of the local parabola.
    block_m, block_halo_m: the ground is divided into squares of this side, whole metres and even, the origin in the middle of one;
        the links in one are those of the stations in it and up to the halo around it
        (:mod:`manyeyes.maps.fusion.block_linking`). The halo covers two extensions that meet, and what they were found with.
    """

    max_gap_m: float = 6.0
    max_join_gap_m: float = 8.0
    max_dashed_gap_m: float = 12.0
    max_low_coverage_gap_m: float = 24.0
    max_coverage: float = 6.0
    max_guide_m: float = 5.0
    max_lateral_m: float = 0.25
    lateral_slope: float = 0.08
    max_end_lateral_m: float = 0.8
    end_lateral_slope: float = 0.04
    max_heading_rad: float = 0.26
    heading_slope: float = 0.06
    max_low_coverage_heading_rad: float = 0.6
    lateral_cost: float = 4.0
    smoothing_sigma: float = 2.0
    block_m: int = 512
    block_halo_m: float = 256.0

    def __post_init__(self) -> None:
        if not (self.block_m >= 2 and self.block_m % 2 == 0 and self.block_halo_m >= 0):
            raise ConfigError(
                "LinkConfig needs a block_m of whole metres, even and above 0, and a block_halo_m of at least 0; "
                f"got {self.block_m} and {self.block_halo_m}."
            )


def link_stations(
    xy: Floats,
    tangent: Floats,
    kind: Ints,
    log_odds: Floats,
    dashed: Flags,
    coverage: Floats,
    config: LinkConfig = LinkConfig(),
) -> tuple[Ints, Ints]:
    """Link stations (K,) to chains: offsets (L + 1,) and station rows in order along each chain.

    Every station is in exactly one chain. coverage: (K,) summed visibility. A closed loop is opened at its weakest station.
    """
    return trace_chains(find_links(xy, tangent, kind, log_odds, dashed, coverage, config), log_odds)


def find_links(
    xy: Floats,
    tangent: Floats,
    kind: Ints,
    log_odds: Floats,
    dashed: Flags,
    coverage: Floats,
    config: LinkConfig = LinkConfig(),
) -> Ints:
    """Find the links of stations, as :func:`link_stations`: (K, 2) the row linked in front of and behind its tangent, or -1."""
    gates = _LinkGates(
        config.max_lateral_m,
        config.lateral_slope,
        config.max_heading_rad,
        config.heading_slope,
        config.lateral_cost,
    )
    pair = _pair_neighbours(xy, tangent, kind, np.ones((len(xy), 2), np.bool_), config.max_gap_m, gates)
    lateral = (config.max_end_lateral_m, config.end_lateral_slope)
    near = _LinkGates(*lateral, config.max_heading_rad, config.heading_slope, config.lateral_cost)
    far = _LinkGates(*lateral, config.max_low_coverage_heading_rad, 0.0, config.lateral_cost)
    rounds = (
        (config.max_join_gap_m, near, np.ones(len(xy), bool)),
        (config.max_dashed_gap_m, near, dashed),
        (config.max_low_coverage_gap_m, far, coverage <= config.max_coverage),
    )
    for max_gap, gates, allowed in rounds:
        offsets, members = trace_chains(pair, log_odds)
        ends = np.unique(np.concatenate((members[offsets[:-1]], members[offsets[1:] - 1])))
        ends = ends[allowed[ends]]
        direction = _end_tangents(xy, tangent, offsets, members)
        joined = _join_ends(pair, ends, xy, direction, kind, max_gap, gates)
        if gates is far:
            guides = build_grid(xy[:, 0], xy[:, 1], np.zeros(len(xy), np.int64), _GUIDE_CELL_M)
            joined = _drop_across_junctions(
                pair, joined, xy, tangent, guides, (config.max_join_gap_m, config.max_guide_m)
            )
        pair = joined
    return pair


def _pair_neighbours(
    xy: Floats, tangent: Floats, kind: Ints, free: NDArray[np.bool_], max_gap: float, gates: _LinkGates
) -> Ints:
    """Return (K, 2): the station linked in front of and behind each one's own tangent, or -1; free: (K, 2) sides to link."""
    grid = build_grid(xy[:, 0], xy[:, 1], kind, max_gap)
    candidates = _LinkCandidates(grid.keys, grid.offsets, grid.order, xy, tangent)
    return _select_mutual(_find_best_partners(xy, tangent, kind, free, candidates, max_gap, gates))


def _join_ends(
    pair: Ints, ends: Ints, xy: Floats, direction: Floats, kind: Ints, max_gap: float, gates: _LinkGates
) -> Ints:
    """Links with those of a second round added: free ends only; direction: (K, 2) of the line over its last stations."""
    free = (pair < 0)[ends]
    # A tangent that was turned round for the fit turns front and back round with it.
    more = _pair_neighbours(xy[ends], direction[ends], kind[ends], free, max_gap, gates)
    added = pair.copy()
    for side in range(2):
        rows = np.flatnonzero((more[:, side] >= 0) & free[:, side])
        added[ends[rows], side] = ends[more[rows, side]]
    return added


class _LinkCandidates(NamedTuple):
    """Stations that may be linked to: keys, starts and order of their grid, places and unit tangents by row."""

    keys: I64x1
    start: I64x1
    order: I64x1
    xy: F64x2
    tangent: F64x2


class _LinkGates(NamedTuple):
    """Largest lateral gap (m) and turn (rad) at no gap, and their growth a metre of gap; cost of a metre of lateral gap."""

    max_lateral_m: float
    lateral_slope: float
    max_turn: float
    turn_slope: float
    lateral_cost: float


@njit(cache=True, nogil=True)
def _find_best_partners(
    xy: F64x2, tangent: F64x2, kind: I64x1, free: Boolx2, points: _LinkCandidates, max_gap: float, params: _LinkGates
) -> I64x3:  # pragma: no cover - compiled
    """Return (K, 2, 2) best partner on each side (_FRONT, _BEHIND): its row and which of its sides faces back; -1 for none."""
    keys, start, order, rxy, rtangent = points
    lateral0, lateral1, heading0, heading1, lateral_cost = params
    best = np.full((len(xy), 2, 2), -1, np.int64)
    for k in range(len(xy)):
        x, y, u, v = xy[k, 0], xy[k, 1], tangent[k, 0], tangent[k, 1]
        ix, iy = int(np.floor(x / max_gap)), int(np.floor(y / max_gap))
        cost = np.full(2, np.inf)
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, kind[k], ix + dx, iy - 1, iy + 1)
            for place in range(low, high):
                q = order[place]
                if q == k:
                    continue
                ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
                gap = np.hypot(ex, ey)
                if gap > max_gap or gap < 1e-9:
                    continue
                dot = u * rtangent[q, 0] + v * rtangent[q, 1]
                if abs(dot) < 0.5:
                    continue
                turn = np.arccos(min(1.0, abs(dot)))
                if turn > heading0 + heading1 * gap:
                    continue
                along, aside = line_residual(ex, ey, u, v, rtangent[q, 0], rtangent[q, 1], 0.5)
                aside = abs(aside)
                if aside > lateral0 + lateral1 * gap or abs(along) < 0.3 or aside > abs(along):
                    continue
                side = _FRONT if along > 0.0 else _BEHIND
                back = 1 - side if dot > 0.0 else side
                if not free[k, side] or not free[q, back]:
                    continue
                value = gap + lateral_cost * aside + 2.0 * turn
                if value < cost[side] or (value == cost[side] and q < best[k, side, 0]):
                    cost[side] = value
                    best[k, side, 0], best[k, side, 1] = q, back
    return best


@njit(cache=True, nogil=True)
def _drop_across_junctions(
    pair: I64x2, joined: I64x2, xy: F64x2, tangent: F64x2, grid: PointGrid, limits: tuple[float, float]
) -> I64x2:  # pragma: no cover - compiled
    """Return joined (K, 2) without those links, new since pair, over gaps beside which the other lines end, too.

    grid: of all stations. limits: gaps up to the first (m) stay; other lines are at most the second (m) aside.
    """
    min_gap, max_guide = limits
    out = joined.copy()
    for k in range(len(pair)):
        for side in range(2):
            q = joined[k, side]
            if q < 0 or q == pair[k, side]:
                continue
            dx, dy = xy[q, 0] - xy[k, 0], xy[q, 1] - xy[k, 1]
            gap = np.hypot(dx, dy)
            if gap <= min_gap:
                continue
            u, v = dx / gap, dy / gap
            inward, middle = _INWARD_M / gap, 0.5
            before, after = -inward, 1.0 + inward
            has_neighbour = _is_accompanied(
                xy[k, 0] + before * dx, xy[k, 1] + before * dy, u, v, xy, tangent, grid, max_guide
            ) or _is_accompanied(xy[k, 0] + after * dx, xy[k, 1] + after * dy, u, v, xy, tangent, grid, max_guide)
            if has_neighbour and not _is_accompanied(
                xy[k, 0] + middle * dx, xy[k, 1] + middle * dy, u, v, xy, tangent, grid, max_guide
            ):
                out[k, side] = -1
    return out


@njit(cache=True, nogil=True)
def _is_accompanied(
    x: float, y: float, u: float, v: float, xy: F64x2, tangent: F64x2, grid: PointGrid, max_guide: float
) -> bool:  # pragma: no cover - compiled
    """Return whether a station of another line in direction u, v lies beside a place, 1 m to max_guide aside."""
    wide = int(np.ceil(max_guide / _GUIDE_CELL_M)) + 1
    ix, iy = int(np.floor(x / _GUIDE_CELL_M)), int(np.floor(y / _GUIDE_CELL_M))
    for cell in range(-wide, wide + 1):
        low, high = find_cell_range(grid.keys, grid.offsets, 0, ix + cell, iy - wide, iy + wide)
        for place in range(low, high):
            g = grid.order[place]
            ex, ey = xy[g, 0] - x, xy[g, 1] - y
            is_beside = abs(ex * u + ey * v) < 2.0 and 1.0 < abs(ey * u - ex * v) < max_guide
            if is_beside and abs(u * tangent[g, 0] + v * tangent[g, 1]) > 0.95:
                return True
    return False


@njit(cache=True, nogil=True)
def _select_mutual(best: I64x3) -> I64x2:  # pragma: no cover - compiled
    pair = np.full((len(best), 2), -1, np.int64)
    for k in range(len(best)):
        for side in range(2):
            q, back = best[k, side, 0], best[k, side, 1]
            if q >= 0 and best[q, back, 0] == k and best[q, back, 1] == side:
                pair[k, side] = q
    return pair


@njit(cache=True, nogil=True)
def trace_chains(pair: I64x2, log_odds: F64x1) -> tuple[I64x1, I64x1]:  # pragma: no cover - compiled
    """Chains of linked stations: offsets and rows; open chains first by their smallest end, then loops, opened where
    weakest.
    """
    count = len(pair)
    done = np.zeros(count, np.bool_)
    offsets, members, filled = [0], np.empty(count, np.int64), 0
    for loops in range(2):
        for k in range(count):
            if done[k] or (loops == 0 and pair[k, 0] >= 0 and pair[k, 1] >= 0):
                continue
            begin = k
            if loops == 1:
                last, at = k, pair[k, 0]
                while at != k:
                    if log_odds[at] < log_odds[begin] or (log_odds[at] == log_odds[begin] and at < begin):
                        begin = at
                    one, two = pair[at, 0], pair[at, 1]
                    step = two if one == last else one
                    last, at = at, step
            at, last = begin, -1
            while at >= 0 and not done[at]:
                done[at] = True
                members[filled] = at
                filled += 1
                one, two = pair[at, 0], pair[at, 1]
                if last < 0:
                    step = one if one >= 0 else two
                else:
                    step = two if one == last else one
                last, at = at, step
            offsets.append(filled)
    return np.array(offsets), members


@njit(cache=True, nogil=True)
def _end_tangents(xy: F64x2, tangent: F64x2, offsets: I64x1, members: I64x1) -> F64x2:  # pragma: no cover - compiled
    """Tangents (K, 2) with those of chain ends replaced by the chord over their last stations, of the same sign."""
    out = tangent.copy()
    for c in range(len(offsets) - 1):
        a, b = offsets[c], offsets[c + 1]
        far = min(5, b - a - 1)
        if far < 2:
            continue
        for end, inner in ((members[a], members[a + far]), (members[b - 1], members[b - 1 - far])):
            dx, dy = xy[end, 0] - xy[inner, 0], xy[end, 1] - xy[inner, 1]
            norm = np.hypot(dx, dy)
            sign = 1.0 if dx * tangent[end, 0] + dy * tangent[end, 1] > 0.0 else -1.0
            out[end, 0], out[end, 1] = sign * dx / norm, sign * dy / norm
    return out


@njit(cache=True, nogil=True)
def smooth_chains(
    xy: F64x2, offsets: I64x1, members: I64x1, weight: F64x1, sigma: float
) -> F64x2:  # pragma: no cover - compiled
    """Chains' stations (M, 2) in order, each moved to a parabola through its neighbours along the chain, weighted by
    distance.

    A parabola follows a bend that a mean would cut. Stations move across the line and along it alike; ends have
    neighbours on one side.
    """
    out = np.empty((len(members), 2))
    window = int(np.ceil(2.5 * sigma))
    for c in range(len(offsets) - 1):
        a, b = offsets[c], offsets[c + 1]
        arc = np.zeros(b - a)
        for i in range(1, b - a):
            p, q = members[a + i - 1], members[a + i]
            arc[i] = arc[i - 1] + np.hypot(xy[q, 0] - xy[p, 0], xy[q, 1] - xy[p, 1])
        for i in range(b - a):
            low, high = max(0, i - window), min(b - a, i + window + 1)
            s = np.zeros(5)
            tx, ty = np.zeros(3), np.zeros(3)
            for j in range(low, high):
                m = members[a + j]
                d = arc[j] - arc[i]
                w = weight[m] * np.exp(-0.5 * (d / sigma) ** 2)
                power = w
                for n in range(5):
                    s[n] += power
                    if n < 3:
                        tx[n] += power * xy[m, 0]
                        ty[n] += power * xy[m, 1]
                    power *= d
            out[a + i, 0], out[a + i, 1] = xy[members[a + i], 0], xy[members[a + i], 1]
            if high - low >= 5:
                # The parabola's value here is the first unknown of three equations: Cramer's rule.
                c0, c1, c2 = s[2] * s[4] - s[3] * s[3], s[2] * s[3] - s[1] * s[4], s[1] * s[3] - s[2] * s[2]
                determinant = s[0] * c0 + s[1] * c1 + s[2] * c2
                if determinant > 1e-9 * s[0] * s[2] * s[4]:
                    out[a + i, 0] = (tx[0] * c0 + tx[1] * c1 + tx[2] * c2) / determinant
                    out[a + i, 1] = (ty[0] * c0 + ty[1] * c1 + ty[2] * c2) / determinant
    return out
