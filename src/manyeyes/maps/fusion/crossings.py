# SPDX-License-Identifier: Apache-2.0
"""Crossings: rings that overlap are one crossing, whose extent is what half of those who could see its side agree on.

Stage 6 of specs/maps.md 3.4. Rings are grouped by average linkage on 1 - |A ∩ B| / min(|A|, |B|). A convex ring is told
by how far it reaches in each direction (its support function), so the occupancy vote "more than half of those who saw
it" becomes a weighted median a direction: over the observations whose own reach in that direction was not cut off by
their view. That needs no raster, and so turns with the world. A result that fills most of its rectangle becomes the
rectangle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import njit
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.fusion.existence import EvidenceConfig, fold_looks, looks, sights, witnesses
from manyeyes.maps.fusion.observation_arrays import Sightings, sight

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_DIRECTIONS = 32


@dataclass(frozen=True)
class PolygonConfig:
    """overlap: least mean share of the smaller ring in common within a group. most: rings that decide a group's shape.

    rectangle: share of its rectangle that a ring fills to become it. cut_m: a corner this near the border of the view
    is cut off.
    """

    overlap: float = 0.3
    most: int = 64
    rectangle: float = 0.85
    cut_m: float = 1.0


@dataclass(frozen=True, eq=False)
class Crossings:
    """K fused crossings: ring k is ``xy[start[k]:start[k + 1]]``; the rest as in evidence.Witness; sigma: (K,) metres
    of its sides.
    """

    start: Ints
    xy: Floats
    sigma: Floats
    log_odds: Floats
    coverage: Floats
    support: Ints
    agents: Ints
    state: Ints
    t_first: Ints
    t_last: Ints
    style: Floats
    first: Ints
    sources: Ints


def find_crossings(
    sightings: Sightings,
    pose: Floats,
    weight: Floats,
    rank: Ints,
    config: PolygonConfig,
    evidence: EvidenceConfig,
) -> Crossings:
    """Crossings from all sightings with agents at pose (O, 3); ``weight`` (O,) of each observation, ``rank`` (O,) lower
    for better ones.
    """
    rows = np.flatnonzero(np.asarray(sightings.elements.kind) == CROSSING)
    owner = sightings.element_observation[rows]
    first, points = _placed(sightings, rows, owner, pose)
    hull_first, hulls = _hulls(first, points)
    area = _areas(hull_first, hulls)
    usable = area > 0.5
    label = _groups(
        hull_first, hulls, area, usable, np.argsort(rank[owner], kind="stable"), config.overlap, config.most
    )
    count = int(label.max(initial=-1)) + 1
    reach = _own_reach(first, points, owner, pose, sights(sightings), config.cut_m)
    rings = [
        _shape(np.flatnonzero(label == g), hull_first, hulls, *reach, weight[owner], config.rectangle)
        for g in range(count)
    ]
    start = np.concatenate(([0], np.cumsum([len(r) for r in rings], dtype=np.int64))).astype(np.int64)
    xy = np.concatenate(rings) if rings else np.zeros((0, 2))
    index = looks(sightings, pose)
    out = _evidence(
        (start, xy),
        (hull_first, hulls, area, owner, rows),
        (index.keys, index.start, index.of),
        witnesses(sightings, pose),
        sights(sightings),
        (np.asarray(sightings.elements.style), evidence.worth(sightings.elements.score)),
        replace(evidence, publish=evidence.publish_ring).numbers,
        (evidence.publish_agents, evidence.retire_agents),
        evidence.decay_s[CROSSING],
        config.overlap,
    )
    support = out[3]
    sigma = np.sqrt(0.2**2 / np.maximum(1, support) + evidence.bias_m**2)
    return Crossings(start, xy, sigma, *out)


def _placed(sightings: Sightings, rows: Ints, owner: Ints, pose: Floats) -> tuple[Ints, Floats]:
    """Rings of elements ``rows`` in the map's frame: offsets and points."""
    elements = sightings.elements.take(rows)
    at = pose[np.repeat(owner, elements.counts)]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    x, y = elements.points[:, 0], elements.points[:, 1]
    return np.asarray(elements.first), np.stack((c * x - s * y + at[:, 0], s * x + c * y + at[:, 1]), 1)


def hulls_of(ring: Floats) -> Floats:
    """The convex hull (K, 2) of one ring, anticlockwise."""
    return _hulls(np.array([0, len(ring)]), np.ascontiguousarray(ring))[1]


def overlap_of(one: Floats, two: Floats) -> float:
    """The share of the smaller of two convex anticlockwise rings that they have in common."""
    if min(len(one), len(two)) < 3:
        return 0.0
    return float(_common(one, two)) / max(1e-9, min(float(_area(one)), float(_area(two))))


@njit(cache=True, nogil=True)
def _hulls(first, points):  # pragma: no cover - compiled
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
                hull[n] = p
                n += 1
            n -= 1  # the last point of one half is the first of the other
        n = min(n, len(ring))
        out[filled : filled + n] = hull[:n]
        filled += n
        out_first[r + 1] = filled
    return out_first, out[:filled].copy()


@njit(cache=True, nogil=True)
def _area(ring):  # pragma: no cover - compiled
    total, j = 0.0, len(ring) - 1
    for i in range(len(ring)):
        total += (ring[j, 0] - ring[0, 0]) * (ring[i, 1] - ring[0, 1]) - (ring[i, 0] - ring[0, 0]) * (
            ring[j, 1] - ring[0, 1]
        )
        j = i
    return 0.5 * total


@njit(cache=True, nogil=True)
def _areas(first, points):  # pragma: no cover - compiled
    out = np.zeros(len(first) - 1)
    for r in range(len(out)):
        if first[r + 1] - first[r] >= 3:
            out[r] = _area(points[first[r] : first[r + 1]])
    return out


@njit(cache=True, nogil=True)
def _common(a, b):  # pragma: no cover - compiled
    """Area common to two convex anticlockwise rings (Sutherland and Hodgman's clipping)."""
    ring = a.copy()
    for k in range(len(b)):
        p, q = b[k], b[(k + 1) % len(b)]
        ring = _half_plane(ring, p[0], p[1], q[1] - p[1], p[0] - q[0])
        if len(ring) < 3:
            return 0.0
    return _area(ring)


@njit(cache=True, nogil=True)
def _half_plane(ring, px, py, nx, ny):  # pragma: no cover - compiled
    """The part of a convex ring where (x - px) nx + (y - py) ny <= 0."""
    out, n = np.empty((len(ring) + 2, 2)), 0
    for i in range(len(ring)):
        a, b = ring[i], ring[(i + 1) % len(ring)]
        da = (a[0] - px) * nx + (a[1] - py) * ny
        db = (b[0] - px) * nx + (b[1] - py) * ny
        if da <= 0.0:
            out[n] = a
            n += 1
        if (da < 0.0 < db) or (db < 0.0 < da):
            t = da / (da - db)
            out[n, 0], out[n, 1] = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])
            n += 1
    return out[:n].copy()


@njit(cache=True, nogil=True)
def _groups(first, points, area, usable, walk, overlap, most):  # pragma: no cover - compiled
    """(R,) the group of each ring, -1 for those that are too many or too small; groups numbered by their best ring.

    Rings whose boxes touch form a block; a block's best ``most`` rings are joined by average linkage while the best
    pair of groups has at least ``overlap`` in common. Ties go to the better ranks.
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
        chosen, n = np.empty(min(members, most), np.int64), 0
        for r in walk:
            if block[r] == seed and n < len(chosen):
                chosen[n] = r
                n += 1
        groups = _average_linkage(chosen, first, points, area, overlap, label, groups)
    return label


@njit(cache=True, nogil=True)
def _touch(low, high, q, r):  # pragma: no cover - compiled
    """Whether the boxes of rings q and r meet."""
    across = low[q, 0] <= high[r, 0] and low[r, 0] <= high[q, 0]
    return across and low[q, 1] <= high[r, 1] and low[r, 1] <= high[q, 1]


@njit(cache=True, nogil=True)
def _average_linkage(chosen, first, points, area, overlap, label, groups):  # pragma: no cover - compiled
    n = len(chosen)
    share = np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            a, b = chosen[i], chosen[j]
            common = _common(points[first[a] : first[a + 1]], points[first[b] : first[b + 1]])
            share[i, j] = share[j, i] = common / min(area[a], area[b])
    size, into = np.ones(n), np.arange(n)
    while True:
        best, bi, bj = overlap, -1, -1
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
    for i in range(n):
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
def _own_reach(first, points, owner, pose, seen, cut):  # pragma: no cover - compiled
    """(P,) whether each ring point, in the map's frame, lies at the border of its observation's view."""
    out = np.zeros(len(points), np.bool_)
    for r in range(len(first) - 1):
        o = owner[r]
        c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
        for p in range(first[r], first[r + 1]):
            dx, dy = points[p, 0] - pose[o, 0], points[p, 1] - pose[o, 1]
            out[p] = sight(c * dx + s * dy, -s * dx + c * dy, o, seen[0], seen[1], cut) < 1.0
    return first, points, out


@njit(cache=True, nogil=True)
def _shape(members, hull_first, hulls, first, points, cut, weight, rectangle):  # pragma: no cover - compiled
    """The fused ring (K, 2), anticlockwise, of the rings ``members``."""
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
    reach = np.empty(32)
    value, certain, heavy = np.empty(len(members)), np.empty(len(members), np.bool_), np.empty(len(members))
    for d in range(32):
        angle = axis + 2.0 * np.pi * d / 32
        u, v = np.cos(angle), np.sin(angle)
        for i in range(len(members)):
            r = members[i]
            value[i], certain[i], heavy[i] = -np.inf, True, weight[r]
            for p in range(first[r], first[r + 1]):
                far = (points[p, 0] - mx) * u + (points[p, 1] - my) * v
                if far > value[i]:
                    value[i], certain[i] = far, not cut[p]
        reach[d] = _median(value[certain], heavy[certain]) if certain.any() else value.max()
    box = np.empty((4, 2))
    for k in range(4):
        one, two = axis + np.pi / 2 * k, axis + np.pi / 2 * (k + 1)
        a, b = reach[8 * k], reach[(8 * k + 8) % 32]
        box[k, 0], box[k, 1] = mx + a * np.cos(one) + b * np.cos(two), my + a * np.sin(one) + b * np.sin(two)
    ring = box.copy()
    for d in range(32):
        u, v = np.cos(axis + 2.0 * np.pi * d / 32), np.sin(axis + 2.0 * np.pi * d / 32)
        clipped = _half_plane(ring, mx + reach[d] * u, my + reach[d] * v, u, v)
        if len(clipped) >= 3:
            ring = clipped
    return box if _area(ring) >= rectangle * _area(box) else ring


@njit(cache=True, nogil=True)
def _median(value, weight):  # pragma: no cover - compiled
    """The weighted median, between the two middle values where the halves balance."""
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
            return value[order[i]]
        if total >= half * (1.0 - 1e-9) and i + 1 < len(order):
            return 0.5 * (value[order[i]] + value[order[i + 1]])
    return value[order[-1]]


@njit(cache=True, nogil=True)
def _evidence(fused, rings, index, who, seen, told, numbers, least, decay, overlap):  # pragma: no cover - compiled
    start, xy = fused
    style, worth = told
    hull_first, hulls, area, owner, rows = rings
    count, observations = len(start) - 1, len(who[0])
    odds, coverage = np.zeros(count), np.zeros(count)
    support, agents, state = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    t_first, t_last, votes = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros((count, style.shape[1]))
    first, found, filled = np.zeros(count + 1, np.int64), np.empty(max(16, len(area)), np.int64), 0
    aside_of, gain = np.zeros(observations, np.int64), np.zeros(observations)
    book, stamp = np.zeros((who[4], 4)), np.zeros((who[4], 4), np.int64)
    for k in range(count):
        ring = xy[start[k] : start[k + 1]]
        size = _area(ring)
        middle = np.array([ring[:, 0].mean(), ring[:, 1].mean()])
        places = np.empty((1 + len(ring), 2))
        places[0] = middle
        for i in range(len(ring)):
            places[1 + i] = 0.5 * (middle + ring[i])
        for r in range(len(area)):
            if (
                area[r] <= 0.5
                or abs(hulls[hull_first[r], 0] - middle[0]) > 60.0
                or abs(hulls[hull_first[r], 1] - middle[1]) > 60.0
            ):
                continue
            share = _common(hulls[hull_first[r] : hull_first[r + 1]], ring) / min(area[r], size)
            if share >= overlap:
                if aside_of[owner[r]] != 1:
                    votes[k] += style[rows[r]]
                    gain[owner[r]] = 0.0
                gain[owner[r]] = max(gain[owner[r]], worth[rows[r]])
                aside_of[owner[r]] = 1
            elif share > 0.05 and aside_of[owner[r]] == 0:
                aside_of[owner[r]] = 2
        begin = filled
        for o in range(observations):
            if aside_of[o] == 1:
                if filled == len(found):
                    bigger = np.empty(2 * filled, np.int64)
                    bigger[:filled] = found
                    found = bigger
                found[filled] = o
                filled += 1
        hits = found[begin:filled]
        odds[k], coverage[k], agents[k], state[k] = fold_looks(
            places, k, hits, (aside_of, gain), index, who, seen, numbers, least, decay, book, stamp
        )
        support[k] = len(hits)
        if len(hits) > 0:
            t_first[k], t_last[k] = who[2][hits[0]], who[2][hits[-1]]
        first[k + 1] = filled
        aside_of[:] = 0
    return odds, coverage, support, agents, state, t_first, t_last, votes, first, found[:filled].copy()
