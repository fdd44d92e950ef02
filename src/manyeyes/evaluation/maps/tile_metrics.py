# SPDX-License-Identifier: Apache-2.0
"""Rows of the map model's studies: AP of the drawings that bear one name, over all scenarios and seeds, with intervals.

mAP is that of the CrowdMap paper, over crossings and dividers, where they have truth; boundaries stand beside it. Intervals are
over scenarios, each with all its seeds; scenarios of one town share streets, so they are a little too narrow for other towns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.evaluation.maps.metrics import PAPER_KINDS
from manyeyes.evaluation.maps.pooled_ap import Judged, MapClaim, blocks_of, claimed, mean_of, one_block, pooled_ap
from manyeyes.evaluation.maps.tile_cells import Drawing, TileCell
from manyeyes.evaluation.statistics.bootstrap import Drawn, Interval

KINDS = ("crossing", "divider", "boundary")
WAYS = ("maptr", "exact")


@dataclass(frozen=True)
class TileRow:
    """One row. ap, by kind as in KINDS, and mean: in the ways of WAYS; by_seed: mAP (maptr) of each seed by itself.

    looks: that a tile was drawn from, mean; bytes_per_look, bytes_per_tile: packets with their headers.
    """

    row: str
    tiles: int
    ap: tuple[tuple[Interval, ...], ...]
    mean: tuple[Interval, ...]
    by_seed: tuple[float, ...]
    looks: float
    bytes_per_look: float
    bytes_per_tile: float


class TileTable:
    """The cells of a study by row; each number is made once and kept, since differences ask for it again."""

    def __init__(self, cells: Sequence[TileCell]) -> None:
        self.cells = tuple(cells)
        self.names = tuple(dict.fromkeys(one.row for cell in cells for one in cell.drawings))
        self.known = blocks_of([self._judged(name) for name in self.names])
        self._made: dict[tuple[str, str, str], Drawn] = {}

    def row(self, name: str) -> TileRow:
        """All numbers of one row."""
        own = [one for cell in self.cells for one in cell.drawings if one.row == name]
        sent = [size for one in own for size in one.sent]
        return TileRow(
            name,
            len(own),
            tuple(tuple(self.ap(name, kind, way).interval() for kind in KINDS) for way in WAYS),
            tuple(self.mean(name, way).interval() for way in WAYS),
            tuple(self._of_seed(name, seed) for seed in sorted({cell.seed for cell in self.cells})),
            len(sent) / max(1, len(own)),
            float(np.mean(sent)) if sent else 0.0,
            sum(sent) / max(1, len(own)),
        )

    def ap(self, name: str, kind: str, way: str) -> Drawn:
        """AP of one kind of a row, over draws of scenarios."""
        key = name, kind, way
        if key not in self._made:
            self._made[key] = pooled_ap(self._judged(name), kind, way, known=self.known)
        return self._made[key]

    def mean(self, name: str, way: str = WAYS[0]) -> Drawn:
        """mAP of a row, over draws of scenarios."""
        return mean_of([self.ap(name, kind, way) for kind in PAPER_KINDS])

    def claim(self, what: str, name: str, other: str, bar: float, way: str = WAYS[0]) -> MapClaim:
        """mAP of one row less that of another is at least the bar."""
        return claimed(what, self.mean(name, way).less(self.mean(other, way)), bar)

    def _of_seed(self, name: str, seed: int) -> float:
        judged = self._judged(name, seed)
        return mean_of([pooled_ap(judged, kind, known=self.known, n=0) for kind in PAPER_KINDS]).value

    def _judged(self, name: str, seed: int | None = None) -> list[Judged]:
        return [
            _judged(cell.scenario, one)
            for cell in self.cells
            for one in cell.drawings
            if one.row == name and seed in (None, cell.seed)
        ]


def _judged(scenario: str, drawing: Drawing) -> Judged:
    return Judged(drawing.drawn, drawing.truth, one_block(scenario))
