# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 3: {local, semi-global} maps of agents x every way to fuse them, on the map of each town; and its Fig. 4.

Every agent sends one frame a scenario, at an index drawn from the seed, as bytes. All rows of a town are evaluated against one
ground truth, the union of all tiles, since a short range is part of a local map; "in own view" evaluates each row in its own view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.metrics import PAPER_KINDS
from manyeyes.evaluation.maps.pooled_ap import (
    Block,
    MapPair,
    assign_to_squares,
    average_samples,
    bootstrap_pooled_ap,
    collect_blocks,
)
from manyeyes.evaluation.maps.registry import check_method
from manyeyes.evaluation.maps.spatial_bootstrap import BLOCK_SIZE_M
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.maps.registry import MAP_MODEL, OURS, VARIANTS, list_map_fusions
from manyeyes.studies.engine.cells import hash_recording
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.model_study import MapModelStudy, prepare_map_study
from manyeyes.studies.maps.recorded_fleet import FleetMap, FleetMapJob
from manyeyes.studies.options import FullMapOptions
from manyeyes.studies.town_maps import group_by_town
from manyeyes.viz.map_figures import MapPanel
from manyeyes.viz.study_table import StudyTable, format_interval, format_number, make_comparison_table

LOCAL, SEMI_GLOBAL = "local", "semi-global"
MAP_MODES = (SEMI_GLOBAL, LOCAL)
FIGURE_HALF_SIZE_M = 150.0
OWN_METHODS = (OURS, *VARIANTS)
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 3: two crossroads of DAIR-V2X; for reference only",
    ("method", "Map-06 AP crossing", "AP divider", "mAP", "Map-13 AP crossing", "AP divider", "mAP"),
    (
        ("MapTR + PolyMerge", "0.148", "0.085", "0.117", "0.618", "0.081", "0.350, printed 0.399"),
        ("MapTR + FDC", "0.202", "0.027", "0.114", "0.516", "0.018", "0.267, printed 0.264"),
        ("MapTR + HBM", "0.159", "0.148", "0.154", "0.575", "0.063", "0.319"),
        ("CrowdMap", "0.332", "0.188", "0.260", "0.818", "0.179", "0.499"),
    ),
)

MapKey = tuple[str, str]
"""A map mode and a method."""


@dataclass(frozen=True)
class FullMapRow:
    """A map mode and a method on one town, maptr; over 64 m squares with all seeds. observations_per_map: agents' observations a
    map.
    """

    town: str
    map_mode: str
    method: str
    ap_by_kind: tuple[Interval, ...]
    mean_ap: Interval
    exact_mean_ap: Interval
    own_view_mean_ap: Interval
    observations_per_map: float
    bytes_per_message: float


@dataclass(frozen=True, eq=False)
class TownResults:
    """All maps of one town, by map mode and method, one a seed."""

    name: str
    maps: dict[MapKey, tuple[FleetMap, ...]]

    @cached_property
    def blocks(self) -> list[Block]:
        """Every square that holds anything."""
        return collect_blocks([self.map_pairs(key, in_own_view) for key in self.maps for in_own_view in (False, True)])

    def map_pairs(self, key: MapKey, in_own_view: bool = False) -> list[MapPair]:
        """Return a row's maps against the truth, seed by seed."""
        truths = self.maps[key] if in_own_view else self.maps[SEMI_GLOBAL, key[1]]
        assign_blocks = assign_to_squares(self.name, BLOCK_SIZE_M)
        return [MapPair(one.fused, other.truth, assign_blocks) for one, other in zip(self.maps[key], truths)]


def run(options: FullMapOptions, context: StudyContext) -> None:
    """Run the study of full maps and write its report."""
    for method in options.methods:
        check_method(method)
    study = prepare_map_study(options, context)
    if len(study.models) > 1:
        raise ConfigError(f"The study 'full-map' takes one model: name it with --weights; got {len(study.models)}.")
    methods = options.methods or list_map_fusions()
    town_results = _build_town_results(study, methods, options.seeds)
    means = {town.name: {key: _bootstrap_mean_ap(town, key, town.blocks) for key in town.maps} for town in town_results}
    rows = [_make_row(town, key, means[town.name][key]) for town in town_results for key in town.maps]
    comparisons = _make_comparisons(means, methods)
    tables = [_make_table(town.name, rows) for town in town_results]
    tables += [make_comparison_table(comparisons, "squares of 64 m"), PAPER_TABLE]
    payload: dict[str, object] = {"rows": rows, "comparisons": comparisons}
    study.write_report(payload, tables, _make_panels(town_results, means), 3)


def _build_town_results(study: MapModelStudy, methods: Sequence[str], num_seeds: int) -> list[TownResults]:
    (model,) = study.models
    recording, options, seeds = model.source.open_recording(), study.options, range(num_seeds)
    recording_hash, store = hash_recording(recording), study.context.store
    town_maps = group_by_town(recording, recording.scenarios[:: options.scenario_stride], "elsewhere")
    keys = [(town_map, map_mode, seed) for town_map in town_maps for map_mode in MAP_MODES for seed in seeds]
    jobs = [FleetMapJob(model.source, model.weights, *key, tuple(methods), store, recording_hash) for key in keys]
    results = study.context.run_jobs(jobs, options.workers, "Maps of towns")
    maps = {(town_map.name, map_mode, seed): found for (town_map, map_mode, seed), found in zip(keys, results)}
    return [
        TownResults(
            town_map.name,
            {
                (map_mode, method): tuple(maps[town_map.name, map_mode, seed][k] for seed in seeds)
                for map_mode in MAP_MODES
                for k, method in enumerate(methods)
            },
        )
        for town_map in town_maps
    ]


def _bootstrap_mean_ap(
    town: TownResults, key: MapKey, blocks: list[Block], protocol: str = "maptr", in_own_view: bool = False
) -> BootstrapSamples:
    pairs = town.map_pairs(key, in_own_view)
    return average_samples([bootstrap_pooled_ap(pairs, kind, protocol, all_blocks=blocks) for kind in PAPER_KINDS])


def _make_row(town: TownResults, key: MapKey, mean_ap: BootstrapSamples) -> FullMapRow:
    blocks, maps = town.blocks, town.maps[key]
    return FullMapRow(
        town.name,
        *key,
        ap_by_kind=tuple(
            bootstrap_pooled_ap(town.map_pairs(key), kind, all_blocks=blocks).interval() for kind in PAPER_KINDS
        ),
        mean_ap=mean_ap.interval(),
        exact_mean_ap=_bootstrap_mean_ap(town, key, blocks, "exact").interval(),
        own_view_mean_ap=_bootstrap_mean_ap(town, key, blocks, in_own_view=True).interval(),
        observations_per_map=sum(one.num_observations for one in maps) / len(maps),
        bytes_per_message=sum(one.bytes_per_message for one in maps) / len(maps),
    )


def _make_comparisons(means: dict[str, dict[MapKey, BootstrapSamples]], methods: Sequence[str]) -> list[Comparison]:
    """Compare semi-global maps with our fusion with each row of local maps, as the mean over towns."""
    own = select_own_method(methods)
    if own is None:
        return []

    def over_towns(key: MapKey) -> BootstrapSamples:
        return average_samples([bootstraps[key] for bootstraps in means.values()])

    full_map = over_towns((SEMI_GLOBAL, own))
    baselines = {method: over_towns((LOCAL, method)) for method in methods if method not in OWN_METHODS}
    compared = {f"local + {method}": samples for method, samples in baselines.items()}
    if baselines:
        best = max(baselines, key=lambda method: baselines[method].value)
        compared[f"local + {best}, the best baseline"] = baselines[best]
    compared[f"local + {own}"] = over_towns((LOCAL, own))
    return [
        Comparison(f"{SEMI_GLOBAL} + {own} - {name}", "mAP", full_map.paired_difference(samples))
        for name, samples in compared.items()
    ]


def select_own_method(methods: Sequence[str]) -> str | None:
    """Return the row of ours that is compared: the one for observations of map models, else the default."""
    return next((method for method in (MAP_MODEL, OURS) if method in methods), None)


def _make_table(town: str, rows: Sequence[FullMapRow]) -> StudyTable:
    lines = tuple(
        (
            row.map_mode,
            row.method,
            *map(format_interval, row.ap_by_kind),
            format_interval(row.mean_ap),
            format_interval(row.exact_mean_ap),
            format_interval(row.own_view_mean_ap),
            format_number(row.observations_per_map),
            format_number(row.bytes_per_message),
        )
        for row in rows
        if row.town == town
    )
    headings = (
        "maps", "fusion", "AP crossing", "AP divider", "mAP", "mAP exact", "mAP in own view", "observations", "bytes/message",
    )  # fmt: skip
    return StudyTable(f"The map of {town}", headings, lines)


def _make_panels(
    town_results: Sequence[TownResults], means: dict[str, dict[MapKey, BootstrapSamples]]
) -> list[MapPanel]:
    """Draw for each town the truth, the best local baseline row, and the full map, centred on the truth."""
    out, own = [], select_own_method([method for town in town_results for _, method in town.maps]) or MAP_MODEL
    for town in town_results:
        local_values = {
            key: d.value for key, d in means[town.name].items() if key[0] == LOCAL and key[1] not in OWN_METHODS
        }
        best = max(local_values, key=lambda key: local_values[key], default=(LOCAL, own))
        keys = [key for key in (best, (SEMI_GLOBAL, own)) if key in town.maps]
        if not keys:
            continue
        truth = town.maps[SEMI_GLOBAL, keys[-1][1]][0].truth
        x, y = truth.points.mean(0).round().tolist() if len(truth) else (0.0, 0.0)
        area = (x - FIGURE_HALF_SIZE_M, y - FIGURE_HALF_SIZE_M, x + FIGURE_HALF_SIZE_M, y + FIGURE_HALF_SIZE_M)
        out.append(MapPanel(f"{town.name}: truth in view", truth, area=area))
        out += [
            MapPanel(f"{town.name}: {map_mode} + {method}", town.maps[map_mode, method][0].fused, truth, area=area)
            for map_mode, method in keys
        ]
    return out
