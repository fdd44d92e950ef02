# SPDX-License-Identifier: Apache-2.0
"""How good a map is. This text is the definition of the metrics.

**What is evaluated.** Two tables of map elements in one metric frame, kind by kind (divider, boundary, crossing, stop_line);
kinds never mix. A crossing enters as its closed ring. Elements with fewer than two points or without length are left out.
Nothing is clipped here: the caller clips the truth to the observed area (evaluation.maps.observed_area).

**Average precision** (after MapTR, ICLR 2023; StreamMapNet, WACV 2024). The Chamfer distance of two elements is half the sum
of the two directed mean distances, Euclidean, in the plane. It is measured in three named ways:

- ``maptr``: both are resampled to 100 points of equal arc length and distances go from sample to sample; pairs whose
  flat-capped 2 m buffers do not meet are no pairs.
- ``streammapnet``: the same with 200 points and no buffers.
- ``exact``: samples every 0.5 m (at most 2,000), distances go from each sample to the other *line*. The first two have a floor
  of about a quarter of the sample spacing, 0.76 m on a line of 300 m, which no map can get below; this one has none.

Predictions are walked by descending score; ties by descending length, then by the smallest x, then y, of the element, so that
the order in which a map is stored never matters. Each considers only its nearest truth, and is a true positive when that
distance is at most the threshold and the truth is still free; else it is a false positive: there is no second choice. With
hits cumulated along that walk, r = tp / n_truth, p = tp / (tp + fp), p made non-increasing from the right, AP = sum of
(r_i - r_{i-1}) p_i. The AP of a kind is the mean over the thresholds .5, 1, 1.5 m (or 1, 1.5, 2 m: ``wide``). mAP is the mean
over the kinds asked for that have truth (the CrowdMap paper: crossing and divider); kinds without truth are NaN.

**Length** at d = .3, .5, 1 m. Precision: the share of predicted length within d of any true line of the kind; recall: the
share of true length within d of any predicted line; F their harmonic mean. Length is counted in pieces of at most 0.25 m, by
their middles; distances go to the line itself. These do not depend on where lines are cut.

**Duplication**: predicted length over true length. **Fragmentation**: a predicted element belongs to the true one that most
of its length within 1.5 m is nearest to; the mean number of predicted elements of those true ones that have any.
**Lateral error**: median and 95th percentile of the distance to the nearest true line, over predicted length within 1.5 m.
**Order**: the median discrete Frechet distance (samples every 0.5 m, the better of both directions; rings are left out) of
true positives of the exact way at 1.5 m.

**Topology**, lines only. Endpoint error: the median over true ends of the distance to the nearest predicted end, at most
10 m each. A branch is a place where three or more ends meet within 1 m (single linkage); predicted and true branches match
within 3 m, nearest first, one to one; branch F1, NaN where neither side has one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import njit
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.matching import (
    MATCHING_PROTOCOLS,
    Lines,
    compute_all_point_ap,
    compute_chamfer,
    get_matching_protocol,
    make_lines,
    match_lines,
    rank_lines,
    resample_lines,
)
from manyeyes.ops.nearest_line import find_nearest_line

Floats = NDArray[np.float64]
Thresholds = Literal["narrow", "wide"]

THRESHOLDS: dict[Thresholds, tuple[float, ...]] = {"narrow": (0.5, 1.0, 1.5), "wide": (1.0, 1.5, 2.0)}
PAPER_KINDS = ("crossing", "divider")
LENGTH_DISTANCES_M = (0.3, 0.5, 1.0)
MAX_PIECE_M, MAX_LATERAL_M = 0.25, 1.5
MAX_END_ERROR_M, MAX_BRANCH_SPREAD_M, MAX_BRANCH_DISTANCE_M = 10.0, 1.0, 3.0


@dataclass(frozen=True)
class KindAp:
    """AP of one kind in one way: at each threshold, and their mean; num_true_positives: true positives at the largest threshold."""

    protocol: str
    thresholds: tuple[float, ...]
    ap_at_threshold: tuple[float, ...]
    ap: float
    num_true_positives: int


@dataclass(frozen=True)
class LengthScore:
    """Precision, recall and F by length within a distance; NaN where there is nothing to take a share of."""

    max_distance_m: float
    precision: float
    recall: float
    f1: float


@dataclass(frozen=True)
class KindMetrics:
    """Everything about one kind; the module's text defines each number."""

    kind: str
    n_predicted: int
    n_truth: int
    ap_scores: tuple[KindAp, ...]
    length_scores: tuple[LengthScore, ...]
    duplication: float
    fragmentation: float
    lateral_median_m: float
    lateral_p95_m: float
    frechet_m: float
    endpoint_error_m: float
    branch_f1: float


@dataclass(frozen=True)
class MapMetrics:
    """A map evaluated against the truth, one entry a kind in the order of KINDS."""

    kinds: tuple[KindMetrics, ...]

    def get_kind(self, kind: str) -> KindMetrics:
        """Return the numbers of one kind."""
        return next(k for k in self.kinds if k.kind == kind)

    def get_ap(self, kind: str, protocol: str = "exact", thresholds: Thresholds = "narrow") -> float:
        """Return the AP of one kind, mean over the thresholds."""
        distances_m = THRESHOLDS[thresholds]
        return next(
            p.ap for p in self.get_kind(kind).ap_scores if p.protocol == protocol and p.thresholds == distances_m
        )

    def mean_ap(
        self, protocol: str = "exact", thresholds: Thresholds = "narrow", kinds: Sequence[str] = PAPER_KINDS
    ) -> float:
        """mAP: the mean over those of the kinds that have truth."""
        ap_values = [self.get_ap(kind, protocol, thresholds) for kind in kinds if self.get_kind(kind).n_truth > 0]
        return sum(ap_values) / len(ap_values) if ap_values else math.nan

    def get_length_score(self, kind: str, max_distance_m: float = 0.5) -> LengthScore:
        """Return the length score of one kind."""
        return next(s for s in self.get_kind(kind).length_scores if s.max_distance_m == max_distance_m)


def evaluate_map(
    predicted: MapElements,
    truth: MapElements,
    protocols: Sequence[str] = tuple(MATCHING_PROTOCOLS),
    kinds: Sequence[str] = KINDS,
) -> MapMetrics:
    """Return all numbers of a map (elements with scores) against the truth, both in one metric frame."""
    for name in protocols:
        get_matching_protocol(name)
    return MapMetrics(
        tuple(_evaluate_kind(k, select_lines(predicted, k), select_lines(truth, k), protocols) for k in kinds)
    )


def _evaluate_kind(kind: str, predicted: Lines, truth: Lines, protocols: Sequence[str]) -> KindMetrics:
    order = rank_lines(predicted)
    ap_scores: list[KindAp] = []
    frechet_m = math.nan
    max_distance_m = max(max(t) for t in THRESHOLDS.values())
    for name in protocols:
        table = compute_chamfer(predicted, truth, MATCHING_PROTOCOLS[name], max_distance_m)
        for thresholds in THRESHOLDS.values():
            matches = [match_lines(table, order, threshold) for threshold in thresholds]
            ap_at_threshold = tuple(
                compute_all_point_ap(matched_row[order] >= 0, len(truth)) for matched_row in matches
            )
            ap_scores.append(
                KindAp(
                    name,
                    thresholds,
                    ap_at_threshold,
                    sum(ap_at_threshold) / len(ap_at_threshold),
                    int((matches[-1] >= 0).sum()),
                )
            )
        if name == "exact" and kind != "crossing":
            frechet_m = _median_frechet(predicted, truth, match_lines(table, order, THRESHOLDS["narrow"][-1]))
    predicted_pieces, truth_pieces = split_into_pieces(predicted), split_into_pieces(truth)
    near_truth = find_nearest_line(predicted_pieces.center, truth.points, truth.offsets, MAX_LATERAL_M)
    near_predicted = find_nearest_line(
        truth_pieces.center, predicted.points, predicted.offsets, max(LENGTH_DISTANCES_M)
    )
    lateral = _quantiles(near_truth.distance, predicted_pieces.length, (0.5, 0.95))
    ends = (math.nan, math.nan) if kind == "crossing" else compute_topology(predicted, truth)
    return KindMetrics(
        kind=kind,
        n_predicted=len(predicted),
        n_truth=len(truth),
        ap_scores=tuple(ap_scores),
        length_scores=tuple(
            _length_score(d, near_truth.distance, predicted_pieces.length, near_predicted.distance, truth_pieces.length)
            for d in LENGTH_DISTANCES_M
        ),
        duplication=_ratio(predicted_pieces.length.sum(), truth_pieces.length.sum()),
        fragmentation=_fragmentation(predicted_pieces, near_truth.line, len(truth)),
        lateral_median_m=lateral[0],
        lateral_p95_m=lateral[1],
        frechet_m=frechet_m,
        endpoint_error_m=ends[0],
        branch_f1=ends[1],
    )


def select_lines(elements: MapElements, kind: str) -> Lines:
    """Return the elements of one kind that have length, rings closed."""
    parts, scores = [], []
    for row in np.flatnonzero(elements.kind == KINDS.index(kind)):
        points = elements.polyline(int(row))
        if len(points) > 1 and np.ptp(points, axis=0).any():
            parts.append(np.vstack((points, points[:1])) if kind == "crossing" else points)
            scores.append(float(elements.score[row]))
    return make_lines(parts, np.array(scores))


@dataclass(frozen=True)
class Pieces:
    """Lines in short pieces: middle (P, 2), length (P,), owner (P,) row of the line."""

    center: Floats
    length: Floats
    line_of_piece: NDArray[np.int64]


def split_into_pieces(lines: Lines) -> Pieces:
    """Return every segment in equal pieces of at most PIECE_M."""
    start = (
        np.delete(np.arange(len(lines.points)), lines.offsets[1:] - 1) if len(lines) else np.zeros(0, dtype=np.int64)
    )
    owner = np.repeat(np.arange(len(lines)), np.diff(lines.offsets) - 1)
    step = lines.points[start + 1] - lines.points[start] if len(start) else np.zeros((0, 2))
    length = np.hypot(step[:, 0], step[:, 1])
    count = np.maximum(np.ceil(length / MAX_PIECE_M - 1e-9).astype(np.int64), 1)
    segment = np.repeat(np.arange(len(start)), count)
    within = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    share = ((within + 0.5) / count[segment])[:, None]
    return Pieces(lines.points[start[segment]] + share * step[segment], (length / count)[segment], owner[segment])


def _length_score(
    max_distance_m: float,
    predicted_distance: Floats,
    predicted_length: Floats,
    truth_distance: Floats,
    truth_length: Floats,
) -> LengthScore:
    precision = _ratio(predicted_length[predicted_distance <= max_distance_m].sum(), predicted_length.sum())
    recall = _ratio(truth_length[truth_distance <= max_distance_m].sum(), truth_length.sum())
    if math.isnan(recall):
        return LengthScore(max_distance_m, precision, recall, math.nan)
    # Without a prediction there is no precision, but F is plainly 0.
    total = (0.0 if math.isnan(precision) else precision) + recall
    return LengthScore(max_distance_m, precision, recall, 2 * precision * recall / total if total > 0 else 0.0)


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else math.nan


def _quantiles(distance: Floats, weight: Floats, levels: Sequence[float]) -> list[float]:
    """Weighted quantiles of the finite distances; NaN where there are none."""
    kept = np.isfinite(distance)
    if not kept.any():
        return [math.nan] * len(levels)
    order = np.argsort(distance[kept], kind="stable")
    values, mass = distance[kept][order], np.cumsum(weight[kept][order])
    return [float(values[min(np.searchsorted(mass, level * mass[-1]), len(values) - 1)]) for level in levels]


def _fragmentation(pieces: Pieces, nearest: NDArray[np.int64], n_truth: int) -> float:
    """Return the mean number of predicted elements on those true ones that have any."""
    near = nearest >= 0
    if n_truth == 0 or not near.any():
        return math.nan
    shared = np.zeros((int(pieces.line_of_piece.max()) + 1, n_truth))
    np.add.at(shared, (pieces.line_of_piece[near], nearest[near]), pieces.length[near])
    truth_row = shared.argmax(1)[shared.sum(1) > 0]
    count = np.bincount(truth_row, minlength=n_truth)
    return float(count[count > 0].mean())


def _median_frechet(predicted: Lines, truth: Lines, matched_row: NDArray[np.int64]) -> float:
    """Return the median discrete Frechet distance of matched lines."""
    a, b = resample_lines(predicted, MATCHING_PROTOCOLS["exact"]), resample_lines(truth, MATCHING_PROTOCOLS["exact"])
    distances = [
        min(
            frechet(a.line(int(row)), b.line(int(matched_row[row]))),
            frechet(a.line(int(row))[::-1], b.line(int(matched_row[row]))),
        )
        for row in np.flatnonzero(matched_row >= 0)
    ]
    return float(np.median(distances)) if distances else math.nan


@njit(cache=True)
def frechet(a: Floats, b: Floats) -> float:
    """Return the discrete Frechet distance of two sampled lines (n, 2), (m, 2), row by row (Eiter and Mannila, 1994)."""
    row = np.empty(len(b))
    for i in range(len(a)):
        diagonal = 0.0
        for j in range(len(b)):
            above = row[j]
            if i == 0:
                reached = row[j - 1] if j > 0 else 0.0
            elif j == 0:
                reached = above
            else:
                reached = min(above, diagonal, row[j - 1])
            row[j] = max(reached, np.hypot(a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]))
            diagonal = above
    return row[-1]


def compute_topology(predicted: Lines, truth: Lines) -> tuple[float, float]:
    """Return the endpoint error, and F1 of branches."""
    predicted_ends, truth_ends = _line_ends(predicted), _line_ends(truth)
    end_error = math.nan
    if len(truth_ends):
        gap = np.full(len(truth_ends), MAX_END_ERROR_M)
        if len(predicted_ends):
            gap = np.hypot(
                truth_ends[:, None, 0] - predicted_ends[None, :, 0], truth_ends[:, None, 1] - predicted_ends[None, :, 1]
            ).min(1)
        end_error = float(np.median(np.minimum(gap, MAX_END_ERROR_M)))
    predicted_branches, truth_branches = find_branches(predicted_ends), find_branches(truth_ends)
    if len(predicted_branches) + len(truth_branches) == 0:
        return end_error, math.nan
    hits = _count_matches(predicted_branches, truth_branches, MAX_BRANCH_DISTANCE_M)
    return end_error, 2 * hits / (len(predicted_branches) + len(truth_branches))


def _line_ends(lines: Lines) -> Floats:
    """Return (2 N, 2): both ends of every line."""
    return (
        np.vstack((lines.points[lines.offsets[:-1]], lines.points[lines.offsets[1:] - 1]))
        if len(lines)
        else np.zeros((0, 2))
    )


def find_branches(ends: Floats) -> Floats:
    """Return (B, 2) centres of groups of three or more ends, joined within 1 m; by x, then y."""
    ordered = ends[np.lexsort((ends[:, 1], ends[:, 0]))] if len(ends) else ends
    names, label, count = np.unique(
        _group_points(ordered, MAX_BRANCH_SPREAD_M), return_inverse=True, return_counts=True
    )
    total = np.zeros((len(names), 2))
    np.add.at(total, label, ordered)
    centres = (total / count[:, None])[count >= 3]
    return centres[np.lexsort((centres[:, 1], centres[:, 0]))]


@njit(cache=True)
def _group_points(ordered: Floats, max_gap_m: float) -> NDArray[np.int64]:
    """Return (N,) single-linkage groups of points (N, 2) sorted by x: each is named after one of its members."""
    parent = np.arange(len(ordered))
    for i in range(len(ordered)):
        for j in range(i + 1, len(ordered)):
            if ordered[j, 0] - ordered[i, 0] > max_gap_m:
                break
            if np.hypot(ordered[j, 0] - ordered[i, 0], ordered[j, 1] - ordered[i, 1]) <= max_gap_m:
                a, b = i, j
                while parent[a] != a:
                    a = parent[a]
                while parent[b] != b:
                    b = parent[b]
                parent[max(a, b)] = min(a, b)
    for i in range(len(ordered)):
        a = i
        while parent[a] != a:
            a = parent[a]
        parent[i] = a
    return parent


def _count_matches(a: Floats, b: Floats, max_distance_m: float) -> int:
    """Return how many pairs match one to one, nearest first."""
    gap = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    hits = 0
    while gap.size and gap.min() <= max_distance_m:
        row, column = np.unravel_index(int(gap.argmin()), gap.shape)
        gap[row, :], gap[:, column] = np.inf, np.inf
        hits += 1
    return hits
