# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model have in common: whose weights, which recording, tables by sensors, claims, pictures, files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from manyeyes._io import atomic_write_text
from manyeyes.datasets.base import Recording
from manyeyes.datasets.missing import MissingFiles
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.pooled_ap import MapMarginTest
from manyeyes.evaluation.maps.tile_cells import RecordingSource, TilePredictor, TileStudyResult, run_tile_study
from manyeyes.evaluation.maps.tile_metrics import TABLE_KINDS, TABLE_PROTOCOLS, TileRow, TileTable
from manyeyes.evaluation.maps.tiles import check_town_split
from manyeyes.models import pretrained
from manyeyes.studies import provenance
from manyeyes.studies.map_recordings import has_images, load_true_maps, open_sensor_recording
from manyeyes.studies.maps.fleet import choose_executor
from manyeyes.studies.recordings import check_files, choose_results_folder
from manyeyes.viz.map_figures import MapPanel, save_figure
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import (
    StudyTable,
    format_difference,
    format_interval,
    format_markdown,
    format_number,
    make_terminal_table,
)
from manyeyes.viz.table import NOT_RUN, missing_footer

if TYPE_CHECKING:
    from manyeyes.studies.maps.options import Options

SENSORS = {("lidar",): "LiDAR", ("camera",): "camera", ("lidar", "camera"): "both"}
"""The rows of a table, whether there are weights for them or not."""
HEADINGS = ("sensors", "row", "AP ped", "AP div", "mAP", "exact", "AP edge", "frames", "B/frame", "B/tile")
"""AP and mAP in the way maptr, over crossings and dividers; exact: mAP in that way; edge: boundaries; B: bytes."""


@dataclass(frozen=True)
class OpenRecording:
    """Opens the recording with what these sensors took, in this process or another."""

    data: Path
    split: str
    sensors: tuple[str, ...]

    def __call__(self) -> Recording:
        """The recording."""
        return open_sensor_recording(self.data, self.split, self.sensors)


@dataclass(frozen=True)
class StudyModel:
    """Weights by name, the sensors that they are for, and where they are judged."""

    weights: str
    sensors: str
    source: RecordingSource


def find_missing_files(options: Options, console: Console) -> MissingFiles:
    """The files that the recording of a study lacks; an error unless they are allowed."""
    assert options.data is not None
    return check_files(open_recording(options.data, options.split), options.checks, console)


def get_results_folder(options: Options) -> Path:
    """The folder for the kept results of this study."""
    return choose_results_folder(options.out, find_missing_files(options, Console(quiet=True)))


def resolve_models(options: Options) -> tuple[StudyModel, ...]:
    """The models that are judged: those given, or those that ship; refused where one was taught by a town that would judge it."""
    assert options.data is not None
    names = options.weights or _select_shipped(options)
    if not names:
        raise ConfigError(
            "No map model ships with this version: give --weights FILE of 'manyeyes train --preset map-small-lidar'."
        )
    resolved = []
    for name in names:
        sensors = pretrained.load_map_model(name).config.bev.sensors
        source = RecordingSource(OpenRecording(options.data, options.split, sensors), load_true_maps)
        check_town_split(
            pretrained.read_training_towns(name),
            [scenario.rpartition("_")[0] for scenario in source.open_recording().scenarios],
        )
        resolved.append(StudyModel(str(name), SENSORS[tuple(sorted(sensors, reverse=True))], source))
    if len({model.sensors for model in resolved}) < len(resolved):
        raise ConfigError(f"One model a set of sensors; got {', '.join(m.sensors for m in resolved)}.")
    return tuple(resolved)


def _select_shipped(options: Options) -> tuple[str, ...]:
    """The shipped models whose sensors the recording has."""
    assert options.data is not None
    if not pretrained.list_map_models():
        return ()
    recording = open_recording(options.data, options.split)
    has_camera = recording.reads_images and has_images(open_recording(options.data, options.split, images=True))
    return tuple(
        name
        for name in pretrained.list_map_models()
        if has_camera or "camera" not in pretrained.load_map_model(name).config.bev.sensors
    )


def predict_tables(
    options: Options, console: Console, models_used: Sequence[StudyModel], predictor: TilePredictor
) -> dict[str, TileTable]:
    """What each model draws, by its sensors."""
    return {model.sensors: TileTable(_predict(options, console, model, predictor)) for model in models_used}


def _predict(
    options: Options, console: Console, model: StudyModel, predictor: TilePredictor
) -> tuple[TileStudyResult, ...]:
    with make_progress_bars(console) as progress:
        task = progress.add_task(f"Tiles, {model.sensors}", total=None)
        return run_tile_study(
            model.source,
            model.weights,
            predictor,
            range(options.seeds),
            get_results_folder(options),
            choose_executor(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
            options.scenario_stride,
        )


def make_rows_table(title: str, rows: Mapping[str, Sequence[TileRow]]) -> StudyTable:
    """A line for each row of each set of sensors; sets without weights read "not run"."""
    lines: list[tuple[str, ...]] = []
    for sensors in SENSORS.values():
        lines += [(sensors, row.name, *_format_cells(row)) for row in rows.get(sensors, ())]
        if sensors not in rows:
            lines.append((sensors, NOT_RUN, *[""] * (len(HEADINGS) - 2)))
    return StudyTable(title, HEADINGS, tuple(lines))


def _format_cells(row: TileRow) -> tuple[str, ...]:
    ap = dict(zip(TABLE_KINDS, row.ap[TABLE_PROTOCOLS.index("maptr")]))
    means = [format_interval(row.mean_ap[TABLE_PROTOCOLS.index(way)]) for way in TABLE_PROTOCOLS]
    sizes = (
        format_number(row.frames_per_tile, 1),
        format_number(row.bytes_per_frame),
        format_number(row.bytes_per_tile),
    )
    return (
        format_interval(ap["crossing"]),
        format_interval(ap["divider"]),
        *means,
        format_interval(ap["boundary"]),
        *sizes,
    )


def make_margin_table(margin_tests: Sequence[MapMarginTest], resampled_unit: str) -> StudyTable:
    """The claims as a table; resampled_unit: what is drawn with replacement."""
    lines = tuple((c.description, format_difference(c.difference), f"{c.margin:+.3f}", c.verdict) for c in margin_tests)
    return StudyTable(
        f"Claims, mAP paired over {resampled_unit}",
        ("claim", "difference, 95 % interval", "at least", "verdict"),
        lines,
    )


def select_for_figure(
    results: Sequence[TileStudyResult], size_of: Callable[[TileStudyResult], int], max_results: int = 3
) -> list[TileStudyResult]:
    """Select results of the first seed for a figure, evenly spaced in the order of size, not by quality."""
    first_seed = sorted((c for c in results if c.seed == results[0].seed), key=lambda c: (size_of(c), c.scenario))
    indices = np.unique(np.linspace(0, len(first_seed) - 1, max_results + 2)[1:-1].round().astype(int))
    return [first_seed[index] for index in indices.tolist()]


def make_tile_panels(
    result: TileStudyResult, rows: Mapping[str, str], area: tuple[float, float, float, float]
) -> list[MapPanel]:
    """The truth of a cell's tile, and the drawings of some rows on it; rows: their titles by name."""
    by_name = {one.row_name: one for one in result.predictions}
    truth = by_name[next(iter(rows))].truth
    confident = {name: by_name[name].predicted.take(by_name[name].predicted.score >= 0.3) for name in rows}
    return [
        MapPanel(f"{result.scenario}: truth", truth, area=area),
        *(MapPanel(f"{result.scenario}: {title}", confident[name], truth, area=area) for name, title in rows.items()),
    ]


def write_study_report(
    options: Options,
    console: Console,
    title: str,
    payload: dict[str, object],
    study_tables: Sequence[StudyTable],
    panels: Sequence[MapPanel],
    columns: int,
    notes: Sequence[str] = (),
) -> None:
    """Tables in the terminal; STUDY.json, STUDY.md and STUDY.png in the folder --out."""
    name = str(options.study)
    missing = find_missing_files(options, Console(quiet=True))
    footer = missing_footer(missing.count, f"{name}.json")
    notes = (*notes, footer) if footer else notes
    console.print(f"{title}\n", highlight=False, soft_wrap=True)
    for study_table in study_tables:
        console.print(make_terminal_table(study_table))
        console.print()
    if footer:
        console.print(footer, highlight=False, soft_wrap=True)
    provenance.write_json(
        options.out / f"{name}.json", {"title": title, "missing": missing, **payload}, {"options": options}, 0
    )
    save_figure(panels, options.out / f"{name}.png", columns)
    picture = f"![{name}]({name}.png)\n"
    text = "\n".join(
        [f"# {name}\n\n{title}\n", *map(format_markdown, study_tables), *(f"{note}\n" for note in notes), picture]
    )
    atomic_write_text(options.out / f"{name}.md", text)
    console.print(
        f"Intervals, numbers and picture are in {options.out / name}.md, .json and .png",
        highlight=False,
        soft_wrap=True,
    )


def make_title(options: Options, models_used: Sequence[StudyModel]) -> str:
    """Weights, data, and how much of it."""
    assert options.data is not None
    scenarios = models_used[0].source.open_recording().scenarios[:: options.scenario_stride]
    names = ", ".join(Path(model.weights).stem for model in models_used)
    return f"{names} on {options.data.name}/{options.split}: {len(scenarios)} scenarios, {options.seeds} seeds"
