# SPDX-License-Identifier: Apache-2.0
"""Fusion of crossings: overlapping rings are grouped and each group is fused direction by direction.

Rings are grouped by average linkage on 1 - |A ∩ B| / min(|A|, |B|). A convex ring is described by its support function, its
extent in each direction. The fused extent is a weighted median over the observations whose ring is not cut off by the border of
their view in that direction, which corresponds to an occupancy vote of more than a half. No raster is needed, so the result is
rotation equivariant. A result that fills most of its rectangle becomes the rectangle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, add_row, njit, set_row
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.fusion.existence import (
    MATCHED,
    NEARBY,
    UNMATCHED,
    ElementStyles,
    EvidenceConfig,
    EvidenceParameters,
    EvidenceTable,
    MatchedObservations,
    ObservationScene,
    build_visibility_index,
    doubled,
    gather_observers,
    gather_visibility_rings,
    new_agent_scratch,
    update_existence,
)
from manyeyes.maps.fusion.observation_arrays import FieldsOfView, ObservationArrays, compute_visibility

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_DIRECTIONS = 32
_MIN_AREA_M2 = 0.5  # of a ring that is used


@dataclass(frozen=True)
class CrossingConfig:
    """Configuration of the fusion of crossings.

    min_overlap: smallest mean overlap within a group, as a fraction of the smaller ring.
    max_rings: largest number of rings that determine a group's shape.
    min_rectangle_fill: fraction of its rectangle that a ring fills to become the rectangle.
    view_border_m: a corner within this distance of the border of the view counts as cut off.
    """

    min_overlap: float = 0.3
    max_rings: int = 64
    min_rectangle_fill: float = 0.85
    view_border_m: float = 1.0


@dataclass(frozen=True, eq=False)
class FusedCrossings:
    """K fused crossings: ring k is ``xy[ring_offsets[k]:ring_offsets[k + 1]]``; and their evidence."""

    ring_offsets: Ints
    xy: Floats
    evidence: EvidenceTable


def fuse_crossings(
    arrays: ObservationArrays,
    pose: Floats,
    weight: Floats,
    rank: Ints,
    config: CrossingConfig,
    evidence_config: EvidenceConfig,
) -> FusedCrossings:
    """Fuse the crossings of all observations with agents at pose (O, 3).

    weight: (O,) of each observation. rank: (O,) lower for better observations.
    """
    rows = np.flatnonzero(np.asarray(arrays.elements.kind) == CROSSING)
    owner = arrays.observation_of_element[rows]
    seen = _OpenRings(*_transform_rings(arrays, rows, owner, pose))
    hulls = _hulls(*seen)
    area = _areas(*hulls)
    usable = area > _MIN_AREA_M2
    label = _group_rings(
        *hulls, area, usable, np.argsort(rank[owner], kind="stable"), config.min_overlap, config.max_rings
    )
    count = int(label.max(initial=-1)) + 1
    cut = _mark_cut_points(*seen, owner, pose, gather_visibility_rings(arrays), config.view_border_m)
    rings = [
        _fuse_shape(np.flatnonzero(label == g), *hulls, *seen, cut, weight[owner], config.min_rectangle_fill)
        for g in range(count)
    ]
    start = np.concatenate(([0], np.cumsum([len(r) for r in rings], dtype=np.int64))).astype(np.int64)
    xy = np.concatenate(rings) if rings else np.zeros((0, 2))
    styles = ElementStyles(np.asarray(arrays.elements.style), evidence_config.score_weight(arrays.elements.score))
    evidence = EvidenceTable.zeros(np.full(count, CROSSING, np.int64), styles.style.shape[1])
    sources = _accumulate_evidence(
        _OpenRings(start, xy),
        _CrossingHulls(*hulls, area, owner, rows),
        ObservationScene(
            build_visibility_index(arrays, pose), gather_observers(arrays, pose), gather_visibility_rings(arrays)
        ),
        styles,
        evidence_config.to_kernel_params(CROSSING),
        (evidence_config.decay_time_s[CROSSING], config.min_overlap),
        evidence,
    )
    sigma = np.sqrt(0.2**2 / np.maximum(1, evidence.agents) + evidence_config.bias_sigma_m**2)
    return FusedCrossings(start, xy, evidence._replace(sigma=sigma).with_sources(sources, arrays.digests))


class _OpenRings(NamedTuple):
    """R open rings: ring r is ``points[first[r]:first[r + 1]]``."""

    first: I64x1
    points: F64x2


class _CrossingHulls(NamedTuple):
    """Convex hulls of R observed crossings, their areas (m²), and the rows of their observations and elements (R,)."""

    first: I64x1
    points: F64x2
    area: F64x1
    observation: I64x1
    element: I64x1


def _transform_rings(arrays: ObservationArrays, rows: Ints, owner: Ints, pose: Floats) -> tuple[Ints, Floats]:
    """Return rings of elements ``rows`` in the map's frame: offsets and points."""
    elements = arrays.elements.take(rows)
    at = pose[np.repeat(owner, elements.counts)]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    x, y = elements.points[:, 0], elements.points[:, 1]
    return np.asarray(elements.offsets), np.stack((c * x - s * y + at[:, 0], s * x + c * y + at[:, 1]), 1)


def compute_convex_hull(ring: Floats) -> Floats:
    """Compute the convex hull (K, 2) of one ring, anticlockwise."""
    return _hulls(np.array([0, len(ring)]), np.ascontiguousarray(ring)).points


def compute_overlap(one: Floats, two: Floats) -> float:
    """Compute the common area of two convex anticlockwise rings as a fraction of the smaller one."""
    if min(len(one), len(two)) < 3:
        return 0.0
    return float(_common(one, two)) / max(1e-9, min(float(_area(one)), float(_area(two))))


@njit(cache=True, nogil=True)
def _hulls(first: I64x1, points: F64x2) -> _OpenRings:  # pragma: no cover - compiled
    """Convex hulls, anticlockwise, of rings: offsets and points (Andrew's monotone chain)."""
    out_first, out, filled = np.zeros(len(first), np.int64), np.empty((len(points) + len(first), 2)), 0
    for r in range(len(first) - 1):
        ring = points[first[r] : first[r + 1]]
        order = np.arange(len(ring))
        for i in range(1, len(ring)):
            j = i
            while j > 0 and (ring[order[j], 0], ring[order[j], 1]) < (ring[order[j - 1], 0], ring[order[j - 1], 1]):
                order[j], order[j - 1] = order[j - 1], order[j]
                j -= 1
        hull, n = np.empty((2 * len(ring) + 2, 2)), 0
        for turn in range(2):
            base = n
            for i in range(len(ring)):
                p = ring[order[i]] if turn == 0 else ring[order[len(ring) - 1 - i]]
                while n - base >= 2 and (
                    (hull[n - 1, 0] - hull[n - 2, 0]) * (p[1] - hull[n - 2, 1])
                    - (hull[n - 1, 1] - hull[n - 2, 1]) * (p[0] - hull[n - 2, 0])
                    <= 0.0
                ):
                    n -= 1
                set_row(hull[n], p)
                n += 1
            n -= 1  # the last point of one half is the first of the other
        n = min(n, len(ring))
        for i in range(n):
            set_row(out[filled + i], hull[i])
        filled += n
        out_first[r + 1] = filled
    return _OpenRings(out_first, out[:filled].copy())


@njit(cache=True, nogil=True)
def _area(ring: F64x2) -> float:  # pragma: no cover - compiled
    """Compute the signed area of a ring."""
    total, j = 0.0, len(ring) - 1
    for i in range(len(ring)):
        total += (ring[j, 0] - ring[0, 0]) * (ring[i, 1] - ring[0, 1]) - (ring[i, 0] - ring[0, 0]) * (
            ring[j, 1] - ring[0, 1]
        )
        j = i
    return 0.5 * total


@njit(cache=True, nogil=True)
def _areas(first: I64x1, points: F64x2) -> F64x1:  # pragma: no cover - compiled
    """Compute the area (R,) of each ring; 0 for fewer than three points."""
    out = np.zeros(len(first) - 1)
    for r in range(len(out)):
        if first[r + 1] - first[r] >= 3:
            out[r] = _area(points[first[r] : first[r + 1]])
    return out


@njit(cache=True, nogil=True)
def _common(a: F64x2, b: F64x2) -> float:  # pragma: no cover - compiled
    """Return the area common to two convex anticlockwise rings (Sutherland and Hodgman's clipping)."""
    ring = a.copy()
    for k in range(len(b)):
        p, q = b[k], b[(k + 1) % len(b)]
        ring = _half_plane(ring, p[0], p[1], q[1] - p[1], p[0] - q[0])
        if len(ring) < 3:
            return 0.0
    return _area(ring)


@njit(cache=True, nogil=True)
def _half_plane(ring: F64x2, px: float, py: float, nx: float, ny: float) -> F64x2:  # pragma: no cover - compiled
    """Return the part of a convex ring where (x - px) nx + (y - py) ny <= 0."""
    out, n = np.empty((len(ring) + 2, 2)), 0
    for i in range(len(ring)):
        a, b = ring[i], ring[(i + 1) % len(ring)]
        da = (a[0] - px) * nx + (a[1] - py) * ny
        db = (b[0] - px) * nx + (b[1] - py) * ny
        if da <= 0.0:
            set_row(out[n], a)
            n += 1
        if (da < 0.0 < db) or (db < 0.0 < da):
            t = da / (da - db)
            out[n, 0], out[n, 1] = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])
            n += 1
    return out[:n].copy()


@njit(cache=True, nogil=True)
def _group_rings(
    first: I64x1, points: F64x2, area: F64x1, usable: Boolx1, walk: I64x1, min_overlap: float, max_rings: int
) -> I64x1:  # pragma: no cover - compiled
    """Assign each ring (R,) to a group; -1 for rings that are too small or too many. Groups are numbered by their best ring.

    Rings whose boxes touch form a block. The best ``max_rings`` rings of a block are joined by average linkage while the best
    pair of groups overlaps by at least ``min_overlap``. Ties go to the better ranks.
    """
    count = len(area)
    label = np.full(count, -1, np.int64)
    block = np.full(count, -1, np.int64)
    low, high = np.empty((count, 2)), np.empty((count, 2))
    for r in range(count):
        for axis in range(2):
            low[r, axis] = points[first[r] : first[r + 1], axis].min() if first[r + 1] > first[r] else 0.0
            high[r, axis] = points[first[r] : first[r + 1], axis].max() if first[r + 1] > first[r] else 0.0
    groups = 0
    stack = np.empty(count, np.int64)
    for seed in walk:
        if block[seed] >= 0 or not usable[seed]:
            continue
        block[seed], stack[0], n = seed, seed, 1
        members = 1
        while n > 0:
            n -= 1
            r = stack[n]
            for q in range(count):
                if block[q] < 0 and usable[q] and _touch(low, high, q, r):
                    block[q], stack[n] = seed, q
                    n += 1
                    members += 1
        chosen, n = np.empty(min(members, max_rings), np.int64), 0
        for r in walk:
            if block[r] == seed and n < len(chosen):
                chosen[n] = r
                n += 1
        groups = _average_linkage(chosen, first, points, area, min_overlap, label, groups)
    return label


@njit(cache=True, nogil=True)
def _touch(low: F64x2, high: F64x2, q: int, r: int) -> bool:  # pragma: no cover - compiled
    """Return whether the boxes of rings q and r meet."""
    across = low[q, 0] <= high[r, 0] and low[r, 0] <= high[q, 0]
    return across and low[q, 1] <= high[r, 1] and low[r, 1] <= high[q, 1]


@njit(cache=True, nogil=True)
def _average_linkage(
    chosen: I64x1, first: I64x1, points: F64x2, area: F64x1, min_overlap: float, label: I64x1, groups: int
) -> int:  # pragma: no cover - compiled
    """Write the groups of the chosen rings to label, numbered from ``groups`` on; the number after the last."""
    n = len(chosen)
    share = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            a, b = chosen[i], chosen[j]
            common = _common(points[first[a] : first[a + 1]], points[first[b] : first[b + 1]])
            share[i, j] = share[j, i] = common / min(area[a], area[b])
    size, into = np.ones(n), np.arange(n)
    while True:
        best, bi, bj = min_overlap, -1, -1
        for i in range(n):
            if into[i] != i:
                continue
            for j in range(i):
                if into[j] == j and share[i, j] > best + 1e-9:
                    best, bi, bj = share[i, j], i, j
        if bi < 0:
            break
        for k in range(n):
            if into[k] == k and k != bi and k != bj:
                share[bj, k] = share[k, bj] = (size[bi] * share[bi, k] + size[bj] * share[bj, k]) / (
                    size[bi] + size[bj]
                )
        size[bj] += size[bi]
        into[bi] = bj
    return _label_groups(chosen, into, label, groups)


@njit(cache=True, nogil=True)
def _label_groups(chosen: I64x1, into: I64x1, label: I64x1, groups: int) -> int:  # pragma: no cover - compiled
    """Write the group of each chosen ring, the root of ``into``, to label, numbered from ``groups`` on; the number after."""
    for i in range(len(chosen)):
        root = i
        while into[root] != root:
            root = into[root]
        if root == i:
            label[chosen[i]] = groups
            groups += 1
        else:
            label[chosen[i]] = label[chosen[root]]
    return groups


@njit(cache=True, nogil=True)
def _mark_cut_points(
    first: I64x1, points: F64x2, owner: I64x1, pose: F64x2, rings: FieldsOfView, cut: float
) -> Boolx1:  # pragma: no cover - compiled
    """Return (P,) whether each ring point, in the map's frame, lies at the border of its observation's view."""
    out = np.zeros(len(points), np.bool_)
    for r in range(len(first) - 1):
        o = owner[r]
        c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
        for p in range(first[r], first[r + 1]):
            dx, dy = points[p, 0] - pose[o, 0], points[p, 1] - pose[o, 1]
            out[p] = compute_visibility(c * dx + s * dy, -s * dx + c * dy, o, rings.views, rings.occluders, cut) < 1.0
    return out


@njit(cache=True, nogil=True)
def _fuse_shape(
    members: I64x1,
    hull_first: I64x1,
    hulls: F64x2,
    first: I64x1,
    points: F64x2,
    cut: Boolx1,
    weight: F64x1,
    rectangle: float,
) -> F64x2:  # pragma: no cover - compiled
    """Return the fused ring (K, 2), anticlockwise, of the rings ``members``; cut: (P,) points at the border of their view."""
    cc, ss, mass, mx, my = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in members:
        ring = hulls[hull_first[r] : hull_first[r + 1]]
        for i in range(len(ring)):
            dx, dy = ring[(i + 1) % len(ring), 0] - ring[i, 0], ring[(i + 1) % len(ring), 1] - ring[i, 1]
            length, angle = np.hypot(dx, dy), 4.0 * np.arctan2(dy, dx)
            cc += weight[r] * length * length * np.cos(angle)
            ss += weight[r] * length * length * np.sin(angle)
            w = weight[r] * length
            mass += w
            mx += w * 0.5 * (ring[i, 0] + ring[(i + 1) % len(ring), 0])
            my += w * 0.5 * (ring[i, 1] + ring[(i + 1) % len(ring), 1])
    axis, mx, my = np.arctan2(ss, cc) / 4.0, mx / mass, my / mass
    reach = np.empty(_DIRECTIONS)
    value, certain, heavy = np.empty(len(members)), np.empty(len(members), np.bool_), np.empty(len(members))
    for d in range(_DIRECTIONS):
        angle = axis + 2.0 * np.pi * d / _DIRECTIONS
        u, v = np.cos(angle), np.sin(angle)
        for i in range(len(members)):
            r = members[i]
            value[i], certain[i], heavy[i] = -np.inf, True, weight[r]
            for p in range(first[r], first[r + 1]):
                far = (points[p, 0] - mx) * u + (points[p, 1] - my) * v
                if far > value[i]:
                    value[i], certain[i] = far, not cut[p]
        reach[d] = _median(value[certain], heavy[certain]) if certain.any() else value.max()
    box, quarter = np.empty((4, 2)), _DIRECTIONS // 4
    for k in range(4):
        one, two = axis + np.pi / 2 * k, axis + np.pi / 2 * (k + 1)
        a, b = reach[quarter * k], reach[quarter * (k + 1) % _DIRECTIONS]
        box[k, 0], box[k, 1] = mx + a * np.cos(one) + b * np.cos(two), my + a * np.sin(one) + b * np.sin(two)
    ring = box.copy()
    for d in range(_DIRECTIONS):
        angle = axis + 2.0 * np.pi * d / _DIRECTIONS
        u, v = np.cos(angle), np.sin(angle)
        clipped = _half_plane(ring, mx + reach[d] * u, my + reach[d] * v, u, v)
        if len(clipped) >= 3:
            ring = clipped
    return box if _area(ring) >= rectangle * _area(box) else ring


@njit(cache=True, nogil=True)
def _median(value: F64x1, weight: F64x1) -> float:  # pragma: no cover - compiled
    """Return the weighted median, between the two middle values where the halves balance."""
    order = np.arange(len(value))
    for i in range(1, len(order)):
        j = i
        while j > 0 and value[order[j]] < value[order[j - 1]]:
            order[j], order[j - 1] = order[j - 1], order[j]
            j -= 1
    half, total = 0.5 * weight.sum(), 0.0
    for i in range(len(order)):
        total += weight[order[i]]
        if total > half * (1.0 + 1e-9):
            return float(value[order[i]])
        if total >= half * (1.0 - 1e-9) and i + 1 < len(order):
            return float(0.5 * (value[order[i]] + value[order[i + 1]]))
    return float(value[order[-1]])


@njit(cache=True, nogil=True)
def _places_in(ring: F64x2) -> F64x2:  # pragma: no cover - compiled
    """Return the middle of a ring (K, 2), and the points halfway from it to each corner: (K + 1, 2)."""
    places = np.empty((1 + len(ring), 2))
    places[0, 0], places[0, 1] = ring[:, 0].mean(), ring[:, 1].mean()
    for i in range(len(ring)):
        for axis in range(2):
            places[1 + i, axis] = 0.5 * (places[0, axis] + ring[i, axis])
    return places


@njit(cache=True, nogil=True)
def _accumulate_evidence(
    fused: _OpenRings,
    rings: _CrossingHulls,
    scene: ObservationScene,
    element_columns: ElementStyles,
    params: EvidenceParameters,
    decay_time_s_and_min_overlap: tuple[float, float],
    out: EvidenceTable,
) -> I64x1:  # pragma: no cover - compiled
    """Write the evidence of each fused ring, from the hulls that overlap it enough, to ``out``; returns the sources."""
    decay_time_s, min_overlap = decay_time_s_and_min_overlap
    start, xy = fused
    style, score_weight = element_columns
    hull_first, hulls, area, owner, rows = rings
    time_ns = scene.observers.time_ns
    count, observations = len(start) - 1, len(time_ns)
    found, filled = np.empty(max(16, len(area)), np.int64), 0
    overlap_state, gain = np.full(observations, UNMATCHED, np.int64), np.zeros(observations)
    by_agent = new_agent_scratch(scene.observers.num_agents)
    for k in range(count):
        ring = xy[start[k] : start[k + 1]]
        size = _area(ring)
        places = _places_in(ring)
        middle = places[0]
        for r in range(len(area)):
            if (
                area[r] <= _MIN_AREA_M2
                or abs(hulls[hull_first[r], 0] - middle[0]) > 60.0
                or abs(hulls[hull_first[r], 1] - middle[1]) > 60.0
            ):
                continue
            share = _common(hulls[hull_first[r] : hull_first[r + 1]], ring) / min(area[r], size)
            if share >= min_overlap:
                if overlap_state[owner[r]] != MATCHED:
                    add_row(out.style[k], style[rows[r]])
                    gain[owner[r]] = 0.0
                gain[owner[r]] = max(gain[owner[r]], score_weight[rows[r]])
                overlap_state[owner[r]] = MATCHED
            elif share > 0.05 and overlap_state[owner[r]] == UNMATCHED:
                overlap_state[owner[r]] = NEARBY
        begin = filled
        for o in range(observations):
            if overlap_state[o] == MATCHED:
                if filled == len(found):
                    found = doubled(found)
                found[filled] = o
                filled += 1
        hits = found[begin:filled]
        out.log_odds[k], out.coverage[k], out.agents[k], out.state[k] = update_existence(
            places, k, MatchedObservations(hits, overlap_state, gain), scene, params, decay_time_s, by_agent
        )
        out.support[k] = len(hits)
        if len(hits) > 0:
            out.t_first[k], out.t_last[k] = time_ns[hits[0]], time_ns[hits[-1]]
        out.source_offsets[k + 1] = filled
        overlap_state[:] = UNMATCHED
    return found[:filled].copy()
