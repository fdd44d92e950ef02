# SPDX-License-Identifier: Apache-2.0
"""Differences of two maps as pieces of lines: parts of one map without an element of the same kind in the other nearby.

Lines are sampled every 0.5 m; neighbouring samples beyond the distance form a piece, and pieces below 1.5 m are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.matching import MATCHING_PROTOCOLS, resample_lines
from manyeyes.evaluation.maps.metrics import select_lines
from manyeyes.ops.nearest_line import find_nearest_line

Floats = NDArray[np.float64]
MIN_SEGMENT_LENGTH_M = 1.5


@dataclass(frozen=True)
class MapDiscrepancy:
    """Pieces of lines (each (n, 2) metres, map frame) on which sources disagree.

    false_positives: fused and not true. false_negatives: true and not fused. unsupported: observed and not fused.
    """

    false_positives: Sequence[Floats] = ()
    false_negatives: Sequence[Floats] = ()
    unsupported: Sequence[Floats] = ()


def find_discrepancies(
    fused: MapElements,
    truth: MapElements | None = None,
    observed: MapElements | None = None,
    max_distance_m: float = 1.0,
) -> MapDiscrepancy:
    """Where a fused map, the truth and the observations (all in the map's frame) are farther apart than max_distance_m."""
    return MapDiscrepancy(
        false_positives=[] if truth is None else find_unmatched_segments(fused, truth, max_distance_m),
        false_negatives=[] if truth is None else find_unmatched_segments(truth, fused, max_distance_m),
        unsupported=[] if observed is None else find_unmatched_segments(observed, fused, max_distance_m),
    )


def find_unmatched_segments(elements: MapElements, others: MapElements, max_distance_m: float) -> list[Floats]:
    """Return the pieces of elements that have no line of their kind among others within the distance."""
    out = []
    for kind in KINDS:
        lines, other_lines = select_lines(elements, kind), select_lines(others, kind)
        samples = resample_lines(lines, MATCHING_PROTOCOLS["exact"])
        beyond = find_nearest_line(samples.points, other_lines.points, other_lines.offsets, max_distance_m).line < 0
        for row in range(len(lines)):
            own = slice(samples.offsets[row], samples.offsets[row + 1])
            line, flags = samples.points[own], beyond[own]
            edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
            for start, stop in zip(edges[::2], edges[1::2]):
                piece = line[start:stop]
                if len(piece) > 1 and np.hypot(*np.diff(piece, axis=0).T).sum() >= MIN_SEGMENT_LENGTH_M:
                    out.append(piece)
    return out
