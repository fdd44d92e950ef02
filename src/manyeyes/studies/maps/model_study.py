# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model have in common: models, recording, tables by sensors, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from manyeyes._text import count_noun
from manyeyes.datasets.base import Recording
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.tile_metrics import TABLE_KINDS, TABLE_PROTOCOLS, TileRow, TileTable
from manyeyes.evaluation.maps.tile_prediction import ScenarioPredictions
from manyeyes.evaluation.maps.tiles import check_town_split
from manyeyes.models import pretrained
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.map_recordings import has_images, load_true_maps, open_sensor_recording
from manyeyes.studies.maps.tile_cells import RecordingSource, TilePredictor, make_tile_jobs
from manyeyes.studies.options import MapModelOptions
from manyeyes.studies.recordings import check_files
from manyeyes.viz.map_figures import MapPanel, save_figure
from manyeyes.viz.study_table import StudyTable, format_interval, format_number
from manyeyes.viz.table import AP_BOUNDARY, AP_CROSSING, AP_DIVIDER, NOT_RUN

SENSORS = {("lidar",): "LiDAR", ("camera",): "camera", ("lidar", "camera"): "both"}
"""The rows of a table, whether there are weights for them or not."""
HEADINGS = (
    "sensors", "row", AP_CROSSING, AP_DIVIDER, "mAP", "mAP exact", AP_BOUNDARY, "frames per tile", "bytes/frame", "bytes/tile",
)  # fmt: skip
"""AP and mAP by the protocol maptr, mAP over crossings and dividers; exact: mAP by that protocol."""


@dataclass(frozen=True)
class OpenRecording:
    """Opens the recording with what these sensors took, in this process or another."""

    data: Path
    split: str
    sensors: tuple[str, ...]

    def __call__(self) -> Recording:
        """Return the recording."""
        return open_sensor_recording(self.data, self.split, self.sensors)


@dataclass(frozen=True)
class StudyModel:
    """Weights by name, the sensors that they are for, and where they are evaluated."""

    weights: str
    sensors: str
    source: RecordingSource


@dataclass(frozen=True)
class MapModelStudy:
    """A study of map models on one recording."""

    context: StudyContext
    options: MapModelOptions
    models: tuple[StudyModel, ...]

    @property
    def title(self) -> str:
        """Weights, data, and how much of it."""
        options = self.options
        scenarios = self.models[0].source.open_recording().scenarios[:: options.scenario_stride]
        names = ", ".join(Path(model.weights).stem for model in self.models)
        held = count_noun(len(scenarios), "scenario")
        return f"{names} on {options.data.name}/{options.split}: {held}, {count_noun(options.seeds, 'seed')}"

    def predict_tables(self, predictor: TilePredictor) -> dict[str, TileTable]:
        """Predict the tiles of each model, by its sensors."""
        options, out = self.options, {}
        for model in self.models:
            seeds, store = range(options.seeds), self.context.store
            jobs = make_tile_jobs(model.source, model.weights, predictor, seeds, store, options.scenario_stride)
            out[model.sensors] = TileTable(self.context.run_jobs(jobs, options.workers, f"Tiles, {model.sensors}"))
        return out

    def write_report(
        self, payload: dict[str, object], tables: Sequence[StudyTable], panels: Sequence[MapPanel], columns: int
    ) -> None:
        """Write the report, with map panels in so many columns as its picture."""
        self.context.write_report(self.title, payload, tables, partial(save_figure, panels, columns=columns))


def prepare_map_study(options: MapModelOptions, context: StudyContext) -> MapModelStudy:
    """Check the files of the recording, and load the models."""
    missing = check_files(open_recording(options.data, options.split), options.checks, context.console)
    return MapModelStudy(replace(context, missing=missing), options, resolve_models(options))


def resolve_models(options: MapModelOptions) -> tuple[StudyModel, ...]:
    """Return the models to evaluate: those given, or those that ship; rejected where one was trained on a town of the
    evaluation.
    """
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


def _select_shipped(options: MapModelOptions) -> tuple[str, ...]:
    """Return the shipped models whose sensors the recording has."""
    if not pretrained.list_map_models():
        return ()
    recording = open_recording(options.data, options.split)
    has_camera = recording.reads_images and has_images(open_recording(options.data, options.split, images=True))
    return tuple(
        name
        for name in pretrained.list_map_models()
        if has_camera or "camera" not in pretrained.load_map_model(name).config.bev.sensors
    )


def make_rows_table(title: str, rows: Mapping[str, Sequence[TileRow]]) -> StudyTable:
    """Return a line for each row of each set of sensors; sets without weights read "not run"."""
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


def select_for_figure(
    results: Sequence[ScenarioPredictions], size_of: Callable[[ScenarioPredictions], int], max_results: int = 3
) -> list[ScenarioPredictions]:
    """Select results of the first seed for a figure, evenly spaced in the order of size, not by quality."""
    first_seed = sorted((c for c in results if c.seed == results[0].seed), key=lambda c: (size_of(c), c.scenario))
    indices = np.unique(np.linspace(0, len(first_seed) - 1, max_results + 2)[1:-1].round().astype(int))
    return [first_seed[index] for index in indices.tolist()]


def make_tile_panels(
    result: ScenarioPredictions, rows: Mapping[str, str], area: tuple[float, float, float, float]
) -> list[MapPanel]:
    """Return the truth of a cell's tile, and the drawings of some rows on it; rows: their titles by name."""
    by_name = {one.row_name: one for one in result.predictions}
    truth = by_name[next(iter(rows))].truth
    confident = {name: by_name[name].predicted.take(by_name[name].predicted.score >= 0.3) for name in rows}
    return [
        MapPanel(f"{result.scenario}: truth", truth, area=area),
        *(MapPanel(f"{result.scenario}: {title}", confident[name], truth, area=area) for name, title in rows.items()),
    ]
