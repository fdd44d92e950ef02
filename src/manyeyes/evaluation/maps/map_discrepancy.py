# SPDX-License-Identifier: Apache-2.0
"""Where maps disagree, as pieces of lines: what one says and nothing of the same kind of another lies within a distance of.

Lines are looked at every 0.5 m; neighbouring samples beyond the distance form a piece, and pieces below 1.5 m are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.evaluation.maps.matching import WAYS, spaced
from manyeyes.evaluation.maps.metrics import lines_of_kind
from manyeyes.ops.nearest_line import nearest_line

Floats = NDArray[np.float64]
SHORTEST_PIECE_M = 1.5


@dataclass(frozen=True)
class Disagreement:
    """Pieces of lines (each (n, 2) metres, map frame) on which sources disagree.

    invented: fused and not true. missed: true and not fused. unexplained: observed and not fused.
    """

    invented: Sequence[Floats] = ()
    missed: Sequence[Floats] = ()
    unexplained: Sequence[Floats] = ()


def disagreement(
    fused: MapElements, truth: MapElements | None = None, observed: MapElements | None = None, within_m: float = 1.0
) -> Disagreement:
    """Where a fused map, the truth and the observations (all in the map's frame) are farther apart than within_m."""
    return Disagreement(
        invented=[] if truth is None else away(fused, truth, within_m),
        missed=[] if truth is None else away(truth, fused, within_m),
        unexplained=[] if observed is None else away(observed, fused, within_m),
    )


def away(elements: MapElements, others: MapElements, within_m: float) -> list[Floats]:
    """The pieces of elements that have no line of their kind among others within the distance."""
    out = []
    for kind in KINDS:
        mine, theirs = lines_of_kind(elements, kind), lines_of_kind(others, kind)
        samples = spaced(mine, WAYS["exact"])
        beyond = nearest_line(samples.points, theirs.points, theirs.first, within_m).line < 0
        for row in range(len(mine)):
            own = slice(samples.first[row], samples.first[row + 1])
            line, flags = samples.points[own], beyond[own]
            edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
            for start, stop in zip(edges[::2], edges[1::2]):
                piece = line[start:stop]
                if len(piece) > 1 and np.hypot(*np.diff(piece, axis=0).T).sum() >= SHORTEST_PIECE_M:
                    out.append(piece)
    return out
