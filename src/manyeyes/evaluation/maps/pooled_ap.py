# SPDX-License-Identifier: Apache-2.0
"""Average precision of many maps as one list, its interval over what they are maps of, and claims that compare two such lists.

A block is what is drawn with replacement: a scenario with all its tiles and seeds, or a square of a town. Matching is within each
map; the ranking is one over all of them, by map_quality's rule. A true positive belongs to the block of the truth that it hit, so
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
from manyeyes.evaluation.maps.matching import WAYS, Lines, chamfer, lines_of, match, ranking
from manyeyes.evaluation.maps.metrics import PAPER_KINDS, THRESHOLDS, Thresholds, lines_of_kind
from manyeyes.evaluation.maps.tiles import APART_M
from manyeyes.evaluation.statistics.bootstrap import Drawn, Interval, Pooled, Verdict, resamples, resolved, weighted_ap

Floats = NDArray[np.float64]
Block = tuple[str, int, int]
Blocks = Callable[[Floats], list[Block]]
"""From the middles (N, 2) of lines to the block of each."""


@dataclass(frozen=True, eq=False)
class Judged:
    """One map and its truth in one frame, and how their lines fall into blocks."""

    drawn: MapElements
    truth: MapElements
    blocks: Blocks


def one_block(name: str) -> Blocks:
    """Everything belongs to the scenario of that name."""
    return lambda middles: [(name, 0, 0)] * len(middles)


def squares(name: str, size_m: float) -> Blocks:
    """Lines belong to the square, of so many metres a side, in which their middles lie."""

    def of(middles: Floats) -> list[Block]:
        return [(name, *cell) for cell in np.floor(middles / size_m).astype(np.int64).tolist()]

    return of


def pooled_ap(
    judged: Sequence[Judged],
    kind: str,
    way: str = "maptr",
    thresholds: Thresholds = "narrow",
    known: Sequence[Block] | None = None,
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
) -> Drawn:
    """AP of one kind, mean over the thresholds, of all maps as one list, and on n draws of the blocks.

    known: all blocks, where other lists are to be compared that may have some more; otherwise those that have a line.
    """
    pairs = [(lines_of_kind(one.drawn, kind), lines_of_kind(one.truth, kind)) for one in judged]
    own = [one.blocks(_middles(mine)) for one, (mine, _) in zip(judged, pairs)]
    true = [one.blocks(_middles(theirs)) for one, (_, theirs) in zip(judged, pairs)]
    names = tuple(known if known is not None else sorted({block for part in (*own, *true) for block in part}))
    row = {block: k for k, block in enumerate(names)}
    own_row, true_row = ([np.array([row[b] for b in part], np.int64) for part in side] for side in (own, true))
    n_gt = np.bincount(np.concatenate([np.zeros(0, np.int64), *true_row]), minlength=len(names))
    order = _ranked([mine for mine, _ in pairs])
    within = [(ranking(mine), chamfer(mine, theirs, WAYS[way], max(THRESHOLDS[thresholds]))) for mine, theirs in pairs]
    weights = np.vstack((np.ones((1, len(names)), np.int64), resamples(len(names), n, seed)))
    found = []
    for threshold in THRESHOLDS[thresholds]:
        hit, where = [np.zeros(0, bool)], [np.zeros(0, np.int64)]
        for (ranks, table), mine, theirs in zip(within, own_row, true_row):
            taken = match(table, ranks, threshold)
            hit.append(taken >= 0)
            where.append(np.where(taken >= 0, theirs[taken], mine) if len(theirs) else mine)
        tp, block = np.concatenate(hit)[order], np.concatenate(where)[order]
        found.append(weighted_ap(Pooled((), tp, block, n_gt, False), weights))
    values = np.mean(found, axis=0)
    return Drawn(tuple("/".join(map(str, b)) for b in names), n_gt, float(values[0]), values[1:], level, True)


def pooled_mean_ap(
    judged: Sequence[Judged],
    way: str = "maptr",
    kinds: Sequence[str] = PAPER_KINDS,
    known: Sequence[Block] | None = None,
    n: int = 1000,
) -> Drawn:
    """mAP: the mean over those kinds that have truth, draw by draw."""
    blocks = known if known is not None else blocks_of([judged])
    return mean_of([pooled_ap(judged, kind, way, known=blocks, n=n) for kind in kinds])


def blocks_of(several: Sequence[Sequence[Judged]]) -> list[Block]:
    """All blocks that have an element on any side of several lists."""
    found: set[Block] = set()
    for judged in several:
        for one in judged:
            for elements in (one.drawn, one.truth):
                found.update(one.blocks(np.array([_middle(elements.polyline(k)) for k in range(len(elements))])))
    return sorted(found)


def mean_of(several: Sequence[Drawn]) -> Drawn:
    """The mean of those that have truth, draw by draw; of lists over other blocks each is drawn by itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a draw in which nothing has truth stays NaN
        value = float(np.nanmean([one.value for one in several]))
        draws = np.nanmean([one.draws for one in several], axis=0)
    names = tuple(dict.fromkeys(name for one in several for name in one.names))
    return Drawn(names, np.zeros(len(names), np.int64), value, draws, several[0].level, False)


@dataclass(frozen=True)
class MapClaim:
    """A paired difference of mAP and a bar; the verdict says whether the whole interval is at or above it."""

    what: str
    difference: Interval
    bar: float
    verdict: Verdict


def claimed(what: str, difference: Interval, bar: float) -> MapClaim:
    """The claim that a difference is at least the bar; of a single block nothing is resolved."""
    several = difference.scenarios > 1
    verdict = resolved(bar, difference.low, difference.high) if several else "not resolved"
    return MapClaim(what, difference, bar, verdict)


def _ranked(many: Sequence[Lines]) -> NDArray[np.int64]:
    """The ranking of the lines of all maps as one list, ties as if the maps lay side by side."""
    parts = [lines.line(row) + [APART_M * k, 0.0] for k, lines in enumerate(many) for row in range(len(lines))]
    return ranking(lines_of(parts, np.concatenate([np.zeros(0), *(lines.score for lines in many)])))


def _middles(lines: Lines) -> Floats:
    """(N, 2) the middle of each line's bounding box."""
    bounds = lines.bounds()
    return (bounds[:, :2] + bounds[:, 2:]) / 2


def _middle(points: Floats) -> Floats:
    return (points.min(0) + points.max(0)) / 2
