# SPDX-License-Identifier: Apache-2.0
"""Observation model: one agent's view of the true map with the errors of a map model, in one compiled loop.

Draws are counted, not streamed: each is a hash of (observation's key, element, run, purpose) by splitmix64's finaliser
(Steele, Lea, Flood, OOPSLA 2014), so that an element is missed, bent and perturbed by the same unit draw whatever else is
visible and however large the noise is.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, F64x3, njit, set_row
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, NO_STYLE, STOP_LINE
from manyeyes.maps.elements.observation import has_crossing_edges

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STATION_M = 0.5
CHUNK = 64
MAX_ELEMENTS = 320
"""Elements that one observation holds at most."""


_DROP, _FRAGMENT, _CUT, _GAP, _CONFUSE, _BOW, _SCORE, _STYLE, _OTHER, _FALSE, _GHOST, _HEAD, _TAIL, _SIDE = range(14)
_PLACE = 16
_POINT = 64


COLUMN_KIND, COLUMN_SCORE, COLUMN_SIGMA, COLUMN_NAME = range(4)
"""Columns of :class:`OutputBuffers`."""


class MapModelNoise(NamedTuple):
    """View limits and errors of a map model. Lengths in metres, rates as probabilities; see CrowdConfig for each."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float
    miss_rate: float
    false_positive_rate: float
    fragment_rate: float
    confusion_rate: float
    point_sigma_m: float
    point_sigma_per_m: float
    lateral_bend_m: float
    endpoint_truncation_m: float
    style_error_rate: float


class OutputBuffers(NamedTuple):
    """Output of one observation: points (MAX_ELEMENTS, n, 2), columns (MAX_ELEMENTS, 4) and style (MAX_ELEMENTS, S).

    columns: kind, score, sigma (m), and the name of the true element, -1 for a false one; see COLUMN_KIND.
    """

    points: Array
    columns: Array
    style: Array


class TrueMapIndex(NamedTuple):
    """The true map in chunks, for fast visibility tests.

    points: (M, 2) metres, lines at stations STATION_M apart and the corners of crossings; first: (N + 1,) offsets; kind, style:
    (N,); element_name: (N,) identity of each element, the same in all versions of the map. Chunk c holds the stations
    ``chunk_first[c]:chunk_first[c + 1]``, all of one element, within chunk_radius[c] of chunk_center[c]; of_element: (N + 1,).
    """

    points: Array
    first: Indices
    kind: Indices
    style: Indices
    element_name: Indices
    chunk_center: Array
    chunk_radius: Array
    chunk_first: Indices
    of_element: Indices


def build_map_index(points: list[Array], kind: Indices, style: Indices, name: Indices) -> TrueMapIndex:
    """Return index lines (M, 2) and open rings of N elements with their kinds, styles and names."""
    dense = [p if k == CROSSING else _stations(p) for p, k in zip(points, kind.tolist())]
    first = np.concatenate(([0], np.cumsum([len(p) for p in dense]))).astype(np.int64)
    flat = np.concatenate(dense) if dense else np.zeros((0, 2))
    starts = [np.arange(a, b, CHUNK) for a, b in itertools.pairwise(first)]
    of_element = np.concatenate(([0], np.cumsum([len(s) for s in starts]))).astype(np.int64)
    chunk_first = np.concatenate((*starts, [len(flat)])).astype(np.int64)
    center, radius = np.zeros((len(chunk_first) - 1, 2)), np.zeros(len(chunk_first) - 1)
    for c, (a, b) in enumerate(itertools.pairwise(chunk_first)):
        center[c] = (flat[a:b].min(0) + flat[a:b].max(0)) / 2
        radius[c] = np.linalg.norm(flat[a:b] - center[c], axis=1).max()
    return TrueMapIndex(flat, first, kind, style, name, center, radius, chunk_first, of_element)


def _stations(line: Array) -> Array:
    """Return a line (M, 2) at equal steps of at most STATION_M."""
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
    s = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / STATION_M)) + 1))
    return np.stack([np.interp(s, along, line[:, axis]) for axis in (0, 1)], 1)


@njit(cache=True)
def hash_uniform(key: np.uint64, element: int, run: int, purpose: int) -> float:
    """Return a draw in (0, 1) for a key (uint64) and three counts."""
    z = key
    for part in (element, run, purpose):
        z = z + np.uint64(0x9E3779B97F4A7C15) * (np.uint64(part) + np.uint64(1))
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return (np.float64(z >> np.uint64(12)) + 0.5) * 2.0**-52


@njit(cache=True)
def hash_normal(key: np.uint64, element: int, run: int, purpose: int) -> float:
    """Return a standard normal draw (Box and Muller 1958) from the purposes ``purpose`` and ``purpose + 1024``."""
    radius = np.sqrt(-2.0 * np.log(hash_uniform(key, element, run, purpose)))
    return radius * np.cos(2.0 * np.pi * hash_uniform(key, element, run, purpose + 1024))


@njit(cache=True)
def _hidden(x: float, y: float, shadows: F64x3) -> bool:
    """Return whether a point lies in one of the convex anticlockwise quadrilaterals (Q, 4, 2)."""
    for q in range(shadows.shape[0]):
        inside = True
        for a in range(4):
            b = (a + 1) % 4
            ax, ay = shadows[q, a, 0], shadows[q, a, 1]
            if (shadows[q, b, 0] - ax) * (y - ay) - (shadows[q, b, 1] - ay) * (x - ax) < 0.0:
                inside = False
                break
        if inside:
            return True
    return False


@njit(cache=True)
def _resample(line: F64x2, count: int, closed: bool, out: F64x2) -> float:
    """Equal arc length: ``count`` points of a line (M, 2), of an open ring without repeating its first."""
    size = len(line)
    edges = size if closed else size - 1
    total = 0.0
    for i in range(edges):
        j = (i + 1) % size
        total += np.hypot(line[j, 0] - line[i, 0], line[j, 1] - line[i, 1])
    step = total / (count if closed else count - 1)
    i, passed = 0, 0.0
    length = np.hypot(line[1 % size, 0] - line[0, 0], line[1 % size, 1] - line[0, 1])
    for k in range(count):
        target = k * step
        while passed + length < target and i < edges - 1:
            passed += length
            i += 1
            j = (i + 1) % size
            length = np.hypot(line[j, 0] - line[i, 0], line[j, 1] - line[i, 1])
        t = min(1.0, (target - passed) / length) if length > 1e-12 else 0.0
        j = (i + 1) % size
        out[k, 0] = line[i, 0] + t * (line[j, 0] - line[i, 0])
        out[k, 1] = line[i, 1] + t * (line[j, 1] - line[i, 1])
    return total


@njit(cache=True)
def _clip_ring(ring: F64x2, noise: MapModelNoise) -> tuple[F64x2, float]:
    """Return a ring (M, 2) cut to the view (Sutherland and Hodgman 1974), and the cut ring's area."""
    work = ring.copy()
    for side in range(4):
        axis = 0 if side < 2 else 1
        sign = 1.0 if side % 2 == 0 else -1.0
        limit = noise.x_min if side == 0 else noise.x_max if side == 1 else noise.y_min if side == 2 else noise.y_max
        out = np.empty((2 * len(work) + 2, 2))
        n = 0
        for i in range(len(work)):
            j = (i + 1) % len(work)
            a, b = sign * (work[i, axis] - limit), sign * (work[j, axis] - limit)
            if a >= 0.0:
                set_row(out[n], work[i])
                n += 1
            if (a >= 0.0) != (b >= 0.0):
                t = a / (a - b)
                out[n, 0] = work[i, 0] + t * (work[j, 0] - work[i, 0])
                out[n, 1] = work[i, 1] + t * (work[j, 1] - work[i, 1])
                n += 1
        work = out[:n].copy()
        if n < 3:
            return work, 0.0
    area = 0.0
    for i in range(len(work)):
        j = (i + 1) % len(work)
        area += work[i, 0] * work[j, 1] - work[j, 0] * work[i, 1]
    return work, abs(area) / 2


@njit(cache=True)
def _emit_line(
    line: F64x2, noise: MapModelNoise, key: np.uint64, element: int, run: int, part: int, out: F64x2
) -> float:
    """Write one observed line into out (n, 2); returns its mean distance from the agent, or -1 where it is too short."""
    size = len(line)
    head = abs(hash_normal(key, element, run, _HEAD + 128 * part)) * noise.endpoint_truncation_m
    tail = abs(hash_normal(key, element, run, _TAIL + 128 * part)) * noise.endpoint_truncation_m
    a, b = int(head / STATION_M), size - int(tail / STATION_M)
    if b - a < 3:
        return -1.0
    length = _resample(line[a:b], len(out), False, out)
    if length < 2.0:
        return -1.0
    bow = hash_normal(key, element, run, _BOW + 128 * part) * noise.lateral_bend_m
    count = len(out)
    clean = out.copy()
    total = 0.0
    for k in range(count):
        before, after = clean[max(k - 1, 0)], clean[min(k + 1, count - 1)]
        dx, dy = after[0] - before[0], after[1] - before[1]
        size_of = max(np.hypot(dx, dy), 1e-9)
        distance = np.hypot(clean[k, 0], clean[k, 1])
        total += distance
        sigma = np.hypot(noise.point_sigma_m, noise.point_sigma_per_m * distance)
        bend = bow * np.sin(np.pi * k / (count - 1))
        shift = 2 * (k + count * part)
        out[k, 0] += sigma * hash_normal(key, element, run, _POINT + shift) - bend * dy / size_of
        out[k, 1] += sigma * hash_normal(key, element, run, _POINT + shift + 1) + bend * dx / size_of
    return total / count


@njit(cache=True)
def _emit_ring(ring: F64x2, noise: MapModelNoise, key: np.uint64, element: int, run: int, out: F64x2) -> float:
    """Write one observed crossing into out (n, 2): noisy corners, resampled; less noise where the ring would cross itself."""
    n = len(ring)
    x, y = ring[:, 0].mean(), ring[:, 1].mean()
    distance = np.hypot(x, y)
    sigma = np.hypot(noise.point_sigma_m, noise.point_sigma_per_m * distance)
    for attempt in range(4):
        scale = sigma * (1.0 - attempt / 3.0)
        moved = ring.copy()
        for i in range(n):
            moved[i, 0] += 1.5 * scale * hash_normal(key, element, run, _POINT + 2 * i)
            moved[i, 1] += 1.5 * scale * hash_normal(key, element, run, _POINT + 2 * i + 1)
        _resample(moved, len(out), True, out)
        for k in range(len(out)):
            out[k, 0] += 0.5 * scale * hash_normal(key, element, run, _POINT + 256 + 2 * k)
            out[k, 1] += 0.5 * scale * hash_normal(key, element, run, _POINT + 256 + 2 * k + 1)
        if not has_crossing_edges(out):
            return distance
    return -1.0


@njit(cache=True)
def _emit_false(
    line: F64x2, noise: MapModelNoise, key: np.uint64, element: int, run: int, out: F64x2
) -> tuple[int, float]:
    """Write a false line, half a lane beside a true one or anywhere in view; returns its kind and mean distance."""
    kind = DIVIDER if hash_uniform(key, element, run, _GHOST + 32) < 0.7 else BOUNDARY
    if hash_uniform(key, element, run, _GHOST) < 0.5 and len(line) > 6:
        side = 1.0 if hash_uniform(key, element, run, _SIDE) < 0.5 else -1.0
        offset = side * (1.2 + 1.0 * hash_uniform(key, element, run, _SIDE + 32))
        dx, dy = line[-1, 0] - line[0, 0], line[-1, 1] - line[0, 1]
        size_of = max(np.hypot(dx, dy), 1e-9)
        ghost = line.copy()
        for i in range(len(ghost)):
            ghost[i, 0] -= offset * dy / size_of
            ghost[i, 1] += offset * dx / size_of
        return kind, _emit_line(ghost, noise, key, element, run, 2, out)
    x = noise.x_min + (noise.x_max - noise.x_min) * hash_uniform(key, element, run, _PLACE)
    y = noise.y_min + (noise.y_max - noise.y_min) * hash_uniform(key, element, run, _PLACE + 1)
    heading = 2.0 * np.pi * hash_uniform(key, element, run, _PLACE + 2)
    half = 2.5 + 7.5 * hash_uniform(key, element, run, _PLACE + 3)
    stray = np.empty((int(4 * half), 2))
    for i in range(len(stray)):
        station = -half + 2.0 * half * i / (len(stray) - 1)
        stray[i, 0] = min(max(x + station * np.cos(heading), noise.x_min), noise.x_max)
        stray[i, 1] = min(max(y + station * np.sin(heading), noise.y_min), noise.y_max)
    return kind, _emit_line(stray, noise, key, element, run, 2, out)


@njit(cache=True)
def _max_range(noise: MapModelNoise) -> float:
    """Return the largest distance in view, metres."""
    return np.hypot(max(abs(noise.x_min), abs(noise.x_max)), max(abs(noise.y_min), abs(noise.y_max)))


@njit(cache=True)
def observe_map(
    scene: TrueMapIndex, noise: MapModelNoise, pose: F64x1, shadows: F64x3, key: np.uint64, buffers: OutputBuffers
) -> int:
    """Write all elements observed from a pose into the buffers; returns their number.

    pose: x, y, yaw (3,) of the agent, true. shadows: (Q, 4, 2) hidden quadrilaterals in its frame.
    """
    max_range = _max_range(noise)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    found = 0
    for e in range(len(scene.kind)):
        near = False
        for chunk in range(scene.of_element[e], scene.of_element[e + 1]):
            far = max_range + scene.chunk_radius[chunk]
            dx, dy = scene.chunk_center[chunk, 0] - pose[0], scene.chunk_center[chunk, 1] - pose[1]
            if dx * dx + dy * dy < far * far:
                near = True
                break
        if not near or found >= MAX_ELEMENTS - 6:
            continue
        a, b = scene.first[e], scene.first[e + 1]
        local = np.empty((b - a, 2))
        for i in range(a, b):
            dx, dy = scene.points[i, 0] - pose[0], scene.points[i, 1] - pose[1]
            local[i - a, 0], local[i - a, 1] = c * dx + s * dy, c * dy - s * dx
        if scene.kind[e] == CROSSING:
            found = _observe_crossing(scene, e, local, noise, shadows, key, buffers, found)
            continue
        start, run = -1, 0
        for i in range(len(local) + 1):
            is_visible = False
            if i < len(local):
                x, y = local[i, 0], local[i, 1]
                is_visible = noise.x_min <= x <= noise.x_max and noise.y_min <= y <= noise.y_max
                is_visible = is_visible and not _hidden(x, y, shadows)
            if is_visible and start < 0:
                start = i
            elif not is_visible and start >= 0:
                if found < MAX_ELEMENTS - 6:
                    found = _observe_line(scene, e, run, local[start:i], noise, key, buffers, found)
                start, run = -1, run + 1
    return found


@njit(cache=True)
def _observe_crossing(
    scene: TrueMapIndex,
    e: int,
    local: F64x2,
    noise: MapModelNoise,
    shadows: F64x3,
    key: np.uint64,
    buffers: OutputBuffers,
    found: int,
) -> int:
    """Observe one crossing, if at least half of it and 4 m² are visible; returns the number of elements so far."""
    points, columns, style = buffers
    max_range = _max_range(noise)
    ring, area = _clip_ring(local, noise)
    name = scene.element_name[e]
    if area < 4.0 or hash_uniform(key, name, 0, _CONFUSE) < noise.confusion_rate / 2:
        return found
    x, y = ring[:, 0].mean(), ring[:, 1].mean()
    hidden = 0.0
    for i in range(len(ring)):
        for fraction in (0.2, 0.5, 0.9):
            hidden += _hidden(x + fraction * (ring[i, 0] - x), y + fraction * (ring[i, 1] - y), shadows)
    distance = np.hypot(x, y)
    drop = noise.miss_rate * (0.5 + distance / max_range)
    if hidden > 1.5 * len(ring) or hash_uniform(key, name, 0, _DROP) < drop:
        return found
    if _emit_ring(ring, noise, key, name, 0, points[found]) < 0.0:
        return found
    columns[found, COLUMN_KIND], columns[found, COLUMN_NAME] = CROSSING, name
    columns[found, COLUMN_SCORE] = _score(0.95, distance / max_range, key, name, 0)
    columns[found, COLUMN_SIGMA] = np.hypot(noise.point_sigma_m, noise.point_sigma_per_m * distance)
    style[found, :] = 0.0
    style[found, NO_STYLE] = 1.0
    return found + 1


@njit(cache=True)
def _observe_line(
    scene: TrueMapIndex,
    e: int,
    run: int,
    line: F64x2,
    noise: MapModelNoise,
    key: np.uint64,
    buffers: OutputBuffers,
    found: int,
) -> int:
    """Observe one visible stretch of a line, perhaps with a false line beside it; returns the number of elements so far."""
    points, columns, style = buffers
    max_range = _max_range(noise)
    name, kind = scene.element_name[e], scene.kind[e]
    min_stations = 3 if kind == STOP_LINE else 8
    if len(line) < min_stations:
        return found
    middle = line[len(line) // 2]
    drop = noise.miss_rate * (0.5 + np.hypot(middle[0], middle[1]) / max_range)
    if hash_uniform(key, name, run, _DROP) >= drop:
        parts = 1
        cut = gap = 0
        if kind != STOP_LINE and hash_uniform(key, name, run, _FRAGMENT) < noise.fragment_rate:
            parts = 2
            cut = int(len(line) * (0.25 + 0.5 * hash_uniform(key, name, run, _CUT)))
            gap = int(3.0 * hash_uniform(key, name, run, _GAP) / STATION_M)
        observed_kind = kind
        if hash_uniform(key, name, run, _CONFUSE) < noise.confusion_rate:
            observed_kind = BOUNDARY if kind == DIVIDER else DIVIDER
        for part in range(parts):
            piece = line if parts == 1 else line[:cut] if part == 0 else line[min(cut + gap, len(line)) :]
            if len(piece) < min_stations:
                continue
            distance = _emit_line(piece, noise, key, name, run, part, points[found])
            if distance < 0.0:
                continue
            columns[found, COLUMN_KIND], columns[found, COLUMN_NAME] = observed_kind, name
            columns[found, COLUMN_SCORE] = _score(
                0.95 if observed_kind == kind else 0.6, distance / max_range, key, name, run + 64 * part
            )
            variance = noise.point_sigma_m**2 + (noise.point_sigma_per_m * distance) ** 2 + noise.lateral_bend_m**2 / 2
            columns[found, COLUMN_SIGMA] = np.sqrt(variance)
            _write_style(scene.style[e] if observed_kind == DIVIDER else NO_STYLE, noise, key, name, run, style[found])
            found += 1
    if hash_uniform(key, name, run, _FALSE) < noise.false_positive_rate:
        false_kind, distance = _emit_false(line, noise, key, name, run, points[found])
        if distance >= 0.0:
            columns[found, COLUMN_KIND], columns[found, COLUMN_NAME] = false_kind, -1
            columns[found, COLUMN_SCORE] = _score(0.55, distance / max_range, key, name, run + 128)
            columns[found, COLUMN_SIGMA] = np.sqrt(
                noise.point_sigma_m**2 + (noise.point_sigma_per_m * distance) ** 2 + noise.lateral_bend_m**2 / 2
            )
            _write_style(DASHED if false_kind == DIVIDER else NO_STYLE, noise, key, name, run + 128, style[found])
            found += 1
    return found


@njit(cache=True)
def _score(top: float, far: float, key: np.uint64, element: int, run: int) -> float:
    """Return a confidence that falls with the distance and scatters."""
    return min(0.99, max(0.05, top - 0.25 * far + 0.12 * hash_normal(key, element, run, _SCORE)))


@njit(cache=True)
def _write_style(true: int, noise: MapModelNoise, key: np.uint64, element: int, run: int, out: F64x1) -> None:
    """Probabilities of styles: 0.85 for one, which is a wrong one at the rate style_error_rate."""
    size = len(out)
    if true == NO_STYLE:
        out[:] = 0.0
        out[NO_STYLE] = 1.0
        return
    observed_style = true
    if hash_uniform(key, element, run, _STYLE) < noise.style_error_rate:
        observed_style = (true + 1 + int(2.0 * hash_uniform(key, element, run, _OTHER))) % 3
    out[:] = 0.15 / (size - 1)
    out[observed_style] = 0.85


__all__ = [
    "COLUMN_KIND",
    "COLUMN_NAME",
    "COLUMN_SCORE",
    "COLUMN_SIGMA",
    "MAX_ELEMENTS",
    "MapModelNoise",
    "OutputBuffers",
    "TrueMapIndex",
    "build_map_index",
    "hash_normal",
    "hash_uniform",
    "observe_map",
]
