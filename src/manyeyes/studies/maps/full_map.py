# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 3: {local, semi-global} maps of agents x every way to fuse them, on the map of each town; and its Fig. 4.

Every agent sends one frame a scenario, at an index drawn from the seed, as bytes. All rows of a town are evaluated against one
ground truth, the union of all tiles, since a short range is part of a local map; "in own view" evaluates each row in its own view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.metrics import PAPER_KINDS
from manyeyes.evaluation.maps.pooled_ap import (
    Block,
    MapMarginTest,
    MapPair,
    assign_to_squares,
    average_samples,
    bootstrap_pooled_ap,
    check_map_margin,
    collect_blocks,
)
from manyeyes.evaluation.maps.spatial_bootstrap import BLOCK_SIZE_M
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval
from manyeyes.evaluation.study import hash_recording
from manyeyes.maps.registry import OURS, list_map_fusions
from manyeyes.maps.store.executors import map_blocks
from manyeyes.studies.maps.fleet import choose_executor
from manyeyes.studies.maps.recorded_fleet import FleetMap, FleetMapJob, run_fleet_job
from manyeyes.studies.maps.running import (
    StudyModel,
    get_results_folder,
    make_margin_table,
    make_title,
    resolve_models,
    write_study_report,
)
from manyeyes.studies.town_maps import group_by_town
from manyeyes.viz.map_figures import MapPanel
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_interval, format_number

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

LOCAL, SEMI_GLOBAL = "local", "semi-global"
MAP_MODES = (SEMI_GLOBAL, LOCAL)
TARGET_MARGIN = 0.10
FIGURE_HALF_SIZE_M = 150.0
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 3: two crossroads of DAIR-V2X; for reference only",
    ("method", "Map-06 AP ped", "AP div", "mAP", "Map-13 AP ped", "AP div", "mAP"),
    (
        ("MapTR + PolyMerge", "0.148", "0.085", "0.117", "0.618", "0.081", "0.350, printed 0.399"),
        ("MapTR + FDC", "0.202", "0.027", "0.114", "0.516", "0.018", "0.267, printed 0.264"),
        ("MapTR + HBM", "0.159", "0.148", "0.154", "0.575", "0.063", "0.319"),
        ("CrowdMap", "0.332", "0.188", "0.260", "0.818", "0.179", "0.499"),
    ),
)

MapKey = tuple[str, str]
"""A survey and a method."""


@dataclass(frozen=True)
class FullMapRow:
    """A survey and a method on one town, maptr; over 64 m squares with all seeds. observations_per_map: agents' observations a
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
    """All maps of one town, by survey and method, each once a seed, and the truth in view of anybody's tile."""

    name: str
    maps: dict[MapKey, tuple[FleetMap, ...]]

    @cached_property
    def blocks(self) -> list[Block]:
        """Every square that holds anything."""
        return collect_blocks([self.map_pairs(key, in_own_view) for key in self.maps for in_own_view in (False, True)])

    def map_pairs(self, key: MapKey, in_own_view: bool = False) -> list[MapPair]:
        """A row's maps against the truth, seed by seed."""
        truths = self.maps[key] if in_own_view else self.maps[SEMI_GLOBAL, key[1]]
        assign_blocks = assign_to_squares(self.name, BLOCK_SIZE_M)
        return [MapPair(one.fused, other.truth, assign_blocks) for one, other in zip(self.maps[key], truths)]


def run(options: Options, console: Console) -> None:
    """Run the study of full maps and write its report."""
    model, *others = resolve_models(options)
    if others:
        raise ConfigError(f"The study 'whole' takes one model: name it with --weights; got {1 + len(others)}.")
    methods = options.methods or list_map_fusions()
    town_results = _build_town_results(options, console, model, methods)
    means = {town.name: {key: _bootstrap_mean_ap(town, key, town.blocks) for key in town.maps} for town in town_results}
    rows = [_make_row(town, key, means[town.name][key]) for town in town_results for key in town.maps]
    margin_tests = _check_margins(means, methods)
    study_tables = [_make_table(town.name, rows) for town in town_results] + [
        make_margin_table(margin_tests, "squares of 64 m"),
        PAPER_TABLE,
    ]
    payload: dict[str, object] = {"rows": rows, "margin_tests": margin_tests}
    write_study_report(
        options, console, make_title(options, [model]), payload, study_tables, _make_panels(town_results, means), 3
    )


def _build_town_results(
    options: Options, console: Console, model: StudyModel, methods: Sequence[str]
) -> list[TownResults]:
    recording = model.source.open_recording()
    recording_hash, results_folder = hash_recording(recording), get_results_folder(options)
    town_maps = group_by_town(recording, recording.scenarios[:: options.scenario_stride], "elsewhere")
    jobs = [
        FleetMapJob(
            model.source, model.weights, town_map, map_mode, seed, tuple(methods), results_folder, recording_hash
        )
        for town_map in town_maps
        for map_mode in MAP_MODES
        for seed in range(options.seeds)
    ]
    with make_progress_bars(console) as progress:
        task = progress.add_task("Maps of towns", total=len(jobs))
        with choose_executor(options.workers).open() as session:
            maps_by_job = map_blocks(
                run_fleet_job, jobs, session, lambda at, total: progress.update(task, completed=at)
            )
    map_by_key = {(job.town_map.name, job.map_mode, job.seed): maps for job, maps in zip(jobs, maps_by_job)}
    return [
        TownResults(
            town_map.name,
            {
                (map_mode, method): tuple(map_by_key[town_map.name, map_mode, seed][k] for seed in range(options.seeds))
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


def _check_margins(means: dict[str, dict[MapKey, BootstrapSamples]], methods: Sequence[str]) -> list[MapMarginTest]:
    """Test semi-global maps with our fusion against each local row with a baseline fusion, as the mean over towns."""
    if OURS not in methods:
        return []

    def over_towns(key: MapKey) -> BootstrapSamples:
        return average_samples([bootstraps[key] for bootstraps in means.values()])

    full_map = over_towns((SEMI_GLOBAL, OURS))
    baselines = {method: over_towns((LOCAL, method)) for method in methods if method != OURS}
    out = [
        check_map_margin(f"the whole - local + {method}", full_map.paired_difference(baseline), 0.0)
        for method, baseline in baselines.items()
    ]
    if baselines:
        best = max(baselines, key=lambda method: baselines[method].value)
        out.append(
            check_map_margin(
                f"the whole - local + {best}, the best of them, goal",
                full_map.paired_difference(baselines[best]),
                TARGET_MARGIN,
            )
        )
    out.append(
        check_map_margin(f"the whole - local + {OURS}", full_map.paired_difference(over_towns((LOCAL, OURS))), 0.0)
    )
    return out


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
        "maps",
        "fusion",
        "AP ped",
        "AP div",
        "mAP",
        "mAP exact",
        "in own view",
        "observations",
        "bytes/message",
    )
    return StudyTable(f"The map of {town}", headings, lines)


def _make_panels(
    town_results: Sequence[TownResults], means: dict[str, dict[MapKey, BootstrapSamples]]
) -> list[MapPanel]:
    """Draw for each town the truth, the best local baseline row, and the full map, centred on the truth."""
    out = []
    for town in town_results:
        local_values = {key: d.value for key, d in means[town.name].items() if key[0] == LOCAL and key[1] != OURS}
        best = max(local_values, key=lambda key: local_values[key], default=(LOCAL, OURS))
        keys = [key for key in (best, (SEMI_GLOBAL, OURS)) if key in town.maps]
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
