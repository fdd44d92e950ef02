# SPDX-License-Identifier: Apache-2.0
"""Rows of the map model's studies: AP of the drawings that bear one name, over all scenarios and seeds, with intervals.

mAP is that of the CrowdMap paper, over crossings and dividers, where they have truth; boundaries stand beside it. Intervals are
over scenarios, each with all its seeds; scenarios of one town share streets, so they are a little too narrow for other towns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from manyeyes.evaluation.maps.curvature import is_curved
from manyeyes.evaluation.maps.metrics import PAPER_KINDS
from manyeyes.evaluation.maps.pooled_ap import (
    MapPair,
    assign_to_scenario,
    average_samples,
    bootstrap_pooled_ap,
    collect_blocks,
)
from manyeyes.evaluation.maps.tile_prediction import ScenarioPredictions, TilePrediction
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval
from manyeyes.evaluation.statistics.comparison import Comparison

TABLE_KINDS = ("crossing", "divider", "boundary")
TABLE_PROTOCOLS = ("maptr", "exact")


@dataclass(frozen=True)
class TileRow:
    """One row. ap, by kind as in KINDS, and mean: in the ways of WAYS; mean_ap_by_seed: mAP (maptr) of each seed by itself.

    frames_per_tile: that a tile was drawn from, mean; bytes_per_frame, bytes_per_tile: packets with their headers.
    """

    name: str
    num_tiles: int
    ap: tuple[tuple[Interval, ...], ...]
    mean_ap: tuple[Interval, ...]
    mean_ap_by_seed: tuple[float, ...]
    frames_per_tile: float
    bytes_per_frame: float
    bytes_per_tile: float


class TileTable:
    """The cells of a study by row; each number is made once and kept, since differences ask for it again."""

    def __init__(self, results: Sequence[ScenarioPredictions]) -> None:
        self.results = tuple(results)
        self.names = tuple(dict.fromkeys(one.row_name for result in results for one in result.predictions))
        self.blocks = collect_blocks([self._map_pairs(name) for name in self.names])
        self._bootstraps: dict[tuple[str, str, str], BootstrapSamples] = {}

    def make_row(self, name: str) -> TileRow:
        """Return all numbers of one row."""
        predictions = [one for result in self.results for one in result.predictions if one.row_name == name]
        frame_bytes = [size for one in predictions for size in one.frame_bytes]
        return TileRow(
            name,
            len(predictions),
            tuple(
                tuple(self.bootstrap_ap(name, kind, protocol).interval() for kind in TABLE_KINDS)
                for protocol in TABLE_PROTOCOLS
            ),
            tuple(self.bootstrap_mean_ap(name, protocol).interval() for protocol in TABLE_PROTOCOLS),
            tuple(self._mean_ap_of_seed(name, seed) for seed in sorted({result.seed for result in self.results})),
            len(frame_bytes) / max(1, len(predictions)),
            float(np.mean(frame_bytes)) if frame_bytes else 0.0,
            sum(frame_bytes) / max(1, len(predictions)),
        )

    def bootstrap_ap(self, name: str, kind: str, protocol: str) -> BootstrapSamples:
        """Return the AP of one kind of a row, over draws of scenarios."""
        key = name, kind, protocol
        if key not in self._bootstraps:
            self._bootstraps[key] = bootstrap_pooled_ap(self._map_pairs(name), kind, protocol, all_blocks=self.blocks)
        return self._bootstraps[key]

    def bootstrap_mean_ap(self, name: str, protocol: str = TABLE_PROTOCOLS[0]) -> BootstrapSamples:
        """mAP of a row, over draws of scenarios."""
        return average_samples([self.bootstrap_ap(name, kind, protocol) for kind in PAPER_KINDS])

    def compare(self, description: str, name: str, baseline: str) -> Comparison:
        """Compare mAP of one row with that of another."""
        gain = self.bootstrap_mean_ap(name).paired_difference(self.bootstrap_mean_ap(baseline))
        return Comparison(description, "mAP", gain)

    def _mean_ap_of_seed(self, name: str, seed: int) -> float:
        pairs = self._map_pairs(name, seed)
        return average_samples(
            [bootstrap_pooled_ap(pairs, kind, all_blocks=self.blocks, num_resamples=0) for kind in PAPER_KINDS]
        ).value

    def _map_pairs(self, name: str, seed: int | None = None) -> list[MapPair]:
        return [
            _make_map_pair(result.scenario, one)
            for result in self.results
            for one in result.predictions
            if one.row_name == name and seed in (None, result.seed)
        ]


def split_by_curvature(results: Sequence[ScenarioPredictions]) -> dict[str, list[ScenarioPredictions]]:
    """Return the predictions of tiles with straight and with curved dividers apart; a side without any is left out."""
    sides = {"straight": False, "curved": True}
    split = {
        name: [
            replace(result, predictions=kept)
            for result in results
            if (kept := tuple(one for one in result.predictions if is_curved(one.truth) is side))
        ]
        for name, side in sides.items()
    }
    return {name: part for name, part in split.items() if part}


def _make_map_pair(scenario: str, prediction: TilePrediction) -> MapPair:
    return MapPair(prediction.predicted, prediction.truth, assign_to_scenario(scenario))
