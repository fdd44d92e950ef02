# SPDX-License-Identifier: Apache-2.0
"""Average precision of many maps as one list, its interval over what they are maps of.

A block is what is drawn with replacement: a scenario with all its tiles and seeds, or a square of a town. Matching is within each
map; the ranking is one over all of them, by the rule of ``metrics``. A true positive belongs to the block of the truth it hit, so
that no draw has a hit without its truth; a false one to its own. Differences are paired: both sides see the same draws.
Source: Efron and Tibshirani 1993, ch. 13, as in bootstrap.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.matching import (
    MATCHING_PROTOCOLS,
    Lines,
    compute_chamfer,
    make_lines,
    match_lines,
    rank_lines,
)
from manyeyes.evaluation.maps.metrics import PAPER_KINDS, THRESHOLDS, Thresholds, select_lines
from manyeyes.evaluation.maps.tiles import MAP_SPACING_M
from manyeyes.evaluation.statistics.bootstrap import (
    BootstrapSamples,
    PooledMatches,
    draw_resamples,
    weighted_ap,
)

Floats = NDArray[np.float64]
Block = tuple[str, int, int]
BlockAssignment = Callable[[Floats], list[Block]]
"""From the middles (N, 2) of lines to the block of each."""


@dataclass(frozen=True, eq=False)
class MapPair:
    """One map and its truth in one frame, and how their lines fall into blocks."""

    predicted: MapElements
    truth: MapElements
    assign_blocks: BlockAssignment


def assign_to_scenario(name: str) -> BlockAssignment:
    """Everything belongs to the scenario of that name."""
    return lambda middles: [(name, 0, 0)] * len(middles)


def assign_to_squares(name: str, square_size_m: float) -> BlockAssignment:
    """Assign lines to the square, of so many metres a side, in which their middles lie."""

    def assign(middles: Floats) -> list[Block]:
        return [(name, *cell) for cell in np.floor(middles / square_size_m).astype(np.int64).tolist()]

    return assign


def bootstrap_pooled_ap(
    pairs: Sequence[MapPair],
    kind: str,
    protocol: str = "maptr",
    thresholds: Thresholds = "narrow",
    all_blocks: Sequence[Block] | None = None,
    num_resamples: int = 1000,
    seed: int = 0,
    confidence_level: float = 0.95,
) -> BootstrapSamples:
    """Return the AP of one kind, mean over the thresholds, of all maps as one list, and on n draws of the blocks.

    all_blocks: all blocks, where other lists are to be compared that may have some more; otherwise those that have a line.
    """
    line_pairs = [(select_lines(one.predicted, kind), select_lines(one.truth, kind)) for one in pairs]
    predicted_blocks = [one.assign_blocks(_line_centers(predicted)) for one, (predicted, _) in zip(pairs, line_pairs)]
    truth_blocks = [one.assign_blocks(_line_centers(truth)) for one, (_, truth) in zip(pairs, line_pairs)]
    names = tuple(
        all_blocks
        if all_blocks is not None
        else sorted({block for part in (*predicted_blocks, *truth_blocks) for block in part})
    )
    row = {block: k for k, block in enumerate(names)}
    predicted_rows, truth_rows = (
        [np.array([row[b] for b in part], np.int64) for part in side] for side in (predicted_blocks, truth_blocks)
    )
    n_gt = np.bincount(np.concatenate([np.zeros(0, np.int64), *truth_rows]), minlength=len(names))
    order = _rank_pooled([predicted for predicted, _ in line_pairs])
    rankings_and_distances = [
        (
            rank_lines(predicted),
            compute_chamfer(predicted, truth, MATCHING_PROTOCOLS[protocol], max(THRESHOLDS[thresholds])),
        )
        for predicted, truth in line_pairs
    ]
    weights = np.vstack((np.ones((1, len(names)), np.int64), draw_resamples(len(names), num_resamples, seed)))
    ap_by_threshold = []
    for threshold in THRESHOLDS[thresholds]:
        hit, block_parts = [np.zeros(0, bool)], [np.zeros(0, np.int64)]
        for (ranks, table), predicted, truth in zip(rankings_and_distances, predicted_rows, truth_rows):
            taken = match_lines(table, ranks, threshold)
            hit.append(taken >= 0)
            block_parts.append(np.where(taken >= 0, truth[taken], predicted) if len(truth) else predicted)
        tp, block = np.concatenate(hit)[order], np.concatenate(block_parts)[order]
        ap_by_threshold.append(weighted_ap(PooledMatches((), tp, block, n_gt, False), weights))
    values = np.mean(ap_by_threshold, axis=0)
    return BootstrapSamples(
        tuple("/".join(map(str, b)) for b in names), n_gt, float(values[0]), values[1:], confidence_level, True
    )


def bootstrap_pooled_mean_ap(
    pairs: Sequence[MapPair],
    protocol: str = "maptr",
    kinds: Sequence[str] = PAPER_KINDS,
    all_blocks: Sequence[Block] | None = None,
    num_resamples: int = 1000,
) -> BootstrapSamples:
    """mAP: the mean over those kinds that have truth, draw by draw."""
    blocks = all_blocks if all_blocks is not None else collect_blocks([pairs])
    return average_samples(
        [bootstrap_pooled_ap(pairs, kind, protocol, all_blocks=blocks, num_resamples=num_resamples) for kind in kinds]
    )


def collect_blocks(pair_lists: Sequence[Sequence[MapPair]]) -> list[Block]:
    """Return all blocks that have an element on any side of several lists."""
    found: set[Block] = set()
    for pairs in pair_lists:
        for one in pairs:
            for elements in (one.predicted, one.truth):
                found.update(
                    one.assign_blocks(np.array([_bounds_center(elements.polyline(k)) for k in range(len(elements))]))
                )
    return sorted(found)


def average_samples(bootstraps: Sequence[BootstrapSamples]) -> BootstrapSamples:
    """Return the mean of those that have truth, draw by draw; of lists over other blocks each is drawn by itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a draw in which nothing has truth stays NaN
        value = float(np.nanmean([one.value for one in bootstraps]))
        samples = np.nanmean([one.samples for one in bootstraps], axis=0)
    names = tuple(dict.fromkeys(name for one in bootstraps for name in one.names))
    return BootstrapSamples(
        names, np.zeros(len(names), np.int64), value, samples, bootstraps[0].confidence_level, False
    )


def _rank_pooled(lines_of_maps: Sequence[Lines]) -> NDArray[np.int64]:
    """Return the ranking of the lines of all maps as one list, ties as if the maps lay side by side."""
    parts = [
        lines.line(row) + [MAP_SPACING_M * k, 0.0] for k, lines in enumerate(lines_of_maps) for row in range(len(lines))
    ]
    return rank_lines(make_lines(parts, np.concatenate([np.zeros(0), *(lines.score for lines in lines_of_maps)])))


def _line_centers(lines: Lines) -> Floats:
    """Return (N, 2) the middle of each line's bounding box."""
    bounds = lines.bounds()
    return (bounds[:, :2] + bounds[:, 2:]) / 2


def _bounds_center(points: Floats) -> Floats:
    return (points.min(0) + points.max(0)) / 2
