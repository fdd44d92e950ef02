# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance between map elements in three named ways, and the matching by it. evaluation.maps.metrics defines both."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import njit
from manyeyes.datatypes import ConfigError, MissingExtraError
from manyeyes.ops.nearest_line import segments_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BUFFER_M = 2.0
MAX_SAMPLES = 2000


@dataclass(frozen=True)
class MatchingProtocol:
    """How two elements are held against each other.

    num_samples: points a line at equal arc length, or None: as many as keep spacing_m. buffered: pairs whose flat-capped
    2 m buffers do not meet are no pairs. measure_to_segments: distances go to the other line itself, not to its samples.
    """

    name: str
    num_samples: int | None = None
    spacing_m: float = 0.5
    buffered: bool = False
    measure_to_segments: bool = False


MATCHING_PROTOCOLS = {
    way.name: way
    for way in (
        MatchingProtocol("maptr", num_samples=100, buffered=True),
        MatchingProtocol("streammapnet", num_samples=200),
        MatchingProtocol("exact", measure_to_segments=True),
    )
}


def get_matching_protocol(name: str) -> MatchingProtocol:
    """Return the matching protocol of that name."""
    if name not in MATCHING_PROTOCOLS:
        raise ConfigError(
            f"No way to measure a Chamfer distance is called {name!r}; known: {', '.join(MATCHING_PROTOCOLS)}."
        )
    return MATCHING_PROTOCOLS[name]


@dataclass(frozen=True)
class Lines:
    """Polylines as columns, rings closed: points (P, 2) metres, first (N+1,); score (N,). All of one kind."""

    points: Floats
    offsets: Ints
    score: Floats

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def line(self, row: int) -> Floats:
        """Return (n, 2) points of one line."""
        return self.points[self.offsets[row] : self.offsets[row + 1]]

    def lengths(self) -> Floats:
        """Return the length of each line, (N,) metres."""
        step = np.hypot(*np.diff(self.points, axis=0).T) if len(self.points) > 1 else np.zeros(0)
        line, start = segments_of(self.offsets)
        return np.bincount(line, weights=step[start], minlength=len(self)).astype(np.float64)

    def bounds(self) -> Floats:
        """Return (N, 4) x_min, y_min, x_max, y_max."""
        if len(self) == 0:
            return np.zeros((0, 4))
        low = np.minimum.reduceat(self.points, self.offsets[:-1], axis=0)
        return np.hstack((low, np.maximum.reduceat(self.points, self.offsets[:-1], axis=0)))


def make_lines(parts: list[Floats], score: Floats | None = None) -> Lines:
    """Return lines of a list of (n, 2) arrays; scores are 1 where none are given."""
    offsets = np.concatenate(([0], np.cumsum([len(p) for p in parts], dtype=np.int64))).astype(np.int64)
    points = np.concatenate(parts).astype(np.float64) if parts else np.zeros((0, 2))
    return Lines(points, offsets, np.ones(len(parts)) if score is None else np.asarray(score, dtype=np.float64))


def resample_lines(lines: Lines, protocol: MatchingProtocol) -> Lines:
    """Return the samples of each line: equal arc length, both ends included."""
    lengths = lines.lengths()
    if protocol.num_samples is not None:
        num_samples = np.full(len(lines), protocol.num_samples, dtype=np.int64)
    else:
        num_samples = np.clip(np.ceil(lengths / protocol.spacing_m - 1e-9).astype(np.int64) + 1, 2, MAX_SAMPLES)
    offsets = np.concatenate(([0], np.cumsum(num_samples))).astype(np.int64)
    return Lines(_resample(lines.points, lines.offsets, offsets), offsets, lines.score)


def compute_chamfer(predicted: Lines, truth: Lines, protocol: MatchingProtocol, max_distance_m: float) -> Floats:
    """Return (N, M) Chamfer distances; inf where the boxes are farther apart than max_distance_m, or the protocol leaves the
    pair out.

    No Chamfer distance is below the gap between the boxes, so that thresholds up to max_distance_m are evaluated exactly.
    """
    table = np.full((len(predicted), len(truth)), np.inf)
    if table.size == 0:
        return table
    predicted_samples, truth_samples = resample_lines(predicted, protocol), resample_lines(truth, protocol)
    pairs = _find_nearby_pairs(predicted.bounds(), truth.bounds(), max_distance_m)
    if protocol.buffered:
        pairs = pairs[_buffers_intersect(predicted_samples, truth_samples, pairs)]
    if protocol.measure_to_segments:
        predicted_to_truth = _directed_to_segments(
            predicted_samples.points, predicted_samples.offsets, truth.points, truth.offsets, pairs
        )
        truth_to_predicted = _directed_to_segments(
            truth_samples.points, truth_samples.offsets, predicted.points, predicted.offsets, pairs[:, ::-1]
        )
        table[pairs[:, 0], pairs[:, 1]] = 0.5 * (predicted_to_truth + truth_to_predicted)
    else:
        table[pairs[:, 0], pairs[:, 1]] = _point_chamfer(
            predicted_samples.points,
            predicted_samples.offsets,
            truth_samples.points,
            truth_samples.offsets,
            np.ascontiguousarray(pairs),
        )
    return table


def rank_lines(lines: Lines) -> Ints:
    """Return rows by descending score; ties by descending length, then by the smallest x, then y, of the element."""
    low = lines.bounds()[:, :2].reshape(-1, 2)
    # Lengths that differ by rounding alone must not decide before the place does.
    return np.lexsort((low[:, 1], low[:, 0], -np.round(lines.lengths(), 6), -lines.score)).astype(np.int64)


def match_lines(table: Floats, order: Ints, threshold_m: float) -> Ints:
    """Return (N,) the truth row that each prediction takes, -1 for a false positive.

    Predictions in their order consider only their nearest truth (of equally near ones the first), and take it when it is
    free and within the threshold; there is no second choice.
    """
    taken = np.full(table.shape[0], -1, dtype=np.int64)
    if table.shape[1] == 0:
        return taken
    nearest = table.argmin(1)
    free = np.ones(table.shape[1], dtype=bool)
    for row in order:
        column = nearest[row]
        if table[row, column] <= threshold_m and free[column]:
            free[column] = False
            taken[row] = column
    return taken


def compute_all_point_ap(ranked: NDArray[np.bool_], n_truth: int) -> float:
    """All-point AP of true positives (N,) in ranked order; NaN without truth."""
    if n_truth == 0:
        return math.nan
    hits = np.cumsum(ranked)
    precision = hits / np.arange(1, len(ranked) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[ranked].sum() / n_truth)


def _find_nearby_pairs(a: Floats, b: Floats, max_distance_m: float) -> Ints:
    """Return (K, 2) pairs of rows whose boxes are at most max_distance_m apart."""
    gap_x = np.maximum(np.maximum(a[:, None, 0] - b[None, :, 2], b[None, :, 0] - a[:, None, 2]), 0.0)
    gap_y = np.maximum(np.maximum(a[:, None, 1] - b[None, :, 3], b[None, :, 1] - a[:, None, 3]), 0.0)
    return np.argwhere(np.hypot(gap_x, gap_y) <= max_distance_m).astype(np.int64)


def _buffers_intersect(predicted: Lines, truth: Lines, pairs: Ints) -> NDArray[np.bool_]:
    """Return (K,) whether the buffers of each pair meet."""
    try:
        import shapely
    except ImportError as error:
        raise MissingExtraError("map", "the Chamfer distance 'maptr'") from error

    def make_buffers(lines: Lines) -> NDArray[np.object_]:
        rows = np.repeat(np.arange(len(lines)), np.diff(lines.offsets))
        strings = shapely.linestrings(lines.points, indices=rows)
        return np.asarray(shapely.buffer(strings, BUFFER_M, cap_style="flat", join_style="mitre"), dtype=object)

    return shapely.intersects(make_buffers(predicted)[pairs[:, 0]], make_buffers(truth)[pairs[:, 1]])


@njit(cache=True)
def _resample(points: Floats, offsets: Ints, target_offsets: Ints) -> Floats:
    """Return each line at target[i + 1] - target[i] points of equal arc length."""
    out = np.empty((target_offsets[-1], 2))
    for row in range(len(offsets) - 1):
        begin, end = offsets[row], offsets[row + 1]
        total = 0.0
        for k in range(begin, end - 1):
            total += np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
        count = target_offsets[row + 1] - target_offsets[row]
        k, walked = begin, 0.0
        step = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]) if end - begin > 1 else 0.0
        for j in range(count):
            at = total * j / (count - 1)
            while k < end - 2 and walked + step < at:
                walked += step
                k += 1
                step = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
            share = min(1.0, max(0.0, (at - walked) / step)) if step > 0 else 0.0
            after = min(k + 1, end - 1)
            out[target_offsets[row] + j, 0] = points[k, 0] + share * (points[after, 0] - points[k, 0])
            out[target_offsets[row] + j, 1] = points[k, 1] + share * (points[after, 1] - points[k, 1])
    return out


@njit(cache=True)
def _point_chamfer(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints) -> Floats:
    """Return half the sum of both mean distances from samples to the nearest samples, for pairs (K, 2)."""
    out = np.empty(len(pairs))
    for p in range(len(pairs)):
        i0, i1 = a_offsets[pairs[p, 0]], a_offsets[pairs[p, 0] + 1]
        j0, j1 = b_offsets[pairs[p, 1]], b_offsets[pairs[p, 1] + 1]
        back = np.full(j1 - j0, np.inf)
        there = 0.0
        for i in range(i0, i1):
            best = np.inf
            for j in range(j0, j1):
                square = (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2
                best = min(best, square)
                back[j - j0] = min(back[j - j0], square)
            there += np.sqrt(best)
        out[p] = 0.5 * (there / (i1 - i0) + np.sqrt(back).sum() / (j1 - j0))
    return out


@njit(cache=True)
def _directed_to_segments(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints) -> Floats:
    """Return the mean distance from the samples of a to the line b itself, for pairs (K, 2)."""
    out = np.empty(len(pairs))
    for p in range(len(pairs)):
        i0, i1 = a_offsets[pairs[p, 0]], a_offsets[pairs[p, 0] + 1]
        j0, j1 = b_offsets[pairs[p, 1]], b_offsets[pairs[p, 1] + 1]
        total = 0.0
        for i in range(i0, i1):
            best = np.inf
            for j in range(j0, j1 - 1):
                dx, dy = b[j + 1, 0] - b[j, 0], b[j + 1, 1] - b[j, 1]
                square = dx * dx + dy * dy
                t = ((a[i, 0] - b[j, 0]) * dx + (a[i, 1] - b[j, 1]) * dy) / square if square > 0 else 0.0
                t = min(1.0, max(0.0, t))
                best = min(best, (a[i, 0] - b[j, 0] - t * dx) ** 2 + (a[i, 1] - b[j, 1] - t * dy) ** 2)
            total += np.sqrt(best)
        out[p] = total / (i1 - i0)
    return out
