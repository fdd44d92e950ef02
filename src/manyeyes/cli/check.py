# SPDX-License-Identifier: Apache-2.0
"""Checks a recording: what it is, what is missing, its sensors, and how far they are from what weights were trained on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes._bounds import OutputFile, PositiveInt
from manyeyes._text import count_noun

if TYPE_CHECKING:
    from manyeyes.datasets.missing import MissingFiles
    from manyeyes.datasets.recording_check import ReadSensor, RecordingCheck
    from manyeyes.ops.lidar.sweep_statistics import SensorDomain

_MAX_LINES = 8


@dataclass(frozen=True)
class Options:
    """Which recording, and which weights it is compared with."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario, in the layout of any registered reader."""
    split: str | None = None
    """Which split of a data set: a folder inside it; with DAIR-V2X one of its split file."""
    weights: str = "costr-small"
    """Shipped weights by name, or a .safetensors file: sensors are compared with those of their training."""
    scenarios: PositiveInt = 10
    """At most so many scenarios are read, spread evenly; files of all are searched."""
    out: OutputFile | None = None
    """A file for the result as JSON."""


def main(options: Options) -> None:
    """Check a recording and print what was found; problems are counted and named, and none of them is an error."""
    from rich.console import Console

    from manyeyes.datasets.recording_check import check_recording
    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.studies import provenance
    from manyeyes.viz.progress import track

    console = Console()
    recording = open_recording(options.recording, options.split)
    domain = getattr(pretrained.load(options.weights), "sensor_domain", None)
    with track(console, "Files", len(recording.scenarios)) as report:
        missing = recording.verify(None, report)
    with track(console, "Sensors", min(options.scenarios, len(recording.scenarios))) as report:
        found = check_recording(recording, options.scenarios, report)
    lines = [
        f"{options.recording}: {type(recording).layout}",
        *_describe(found, missing, recording.missing_summary),
        *_compare(found, domain, options.weights),
    ]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if options.out is not None:
        result = {"layout": type(recording).layout, "check": found, "missing": missing, "lines": lines}
        provenance.write_json(options.out, result, {"options": options}, None)


def _describe(found: RecordingCheck, missing: MissingFiles, summary: tuple[str, ...]) -> Iterator[str]:
    """Yield what the recording is and lacks."""
    yield (
        f"{count_noun(found.num_scenarios, 'scenario')}, {count_noun(found.num_snapshots, 'snapshot')}; "
        f"{found.num_read} of them read"
    )
    yield from summary
    yield f"missing or mismatched files: {missing.count:,}" if missing.count else "no file is missing"
    yield from (str(problem) for problem in missing.files[:_MAX_LINES])
    yield from found.disorder[:_MAX_LINES]
    if not found.has_truth:
        yield "no labels: view, pose, live and Python take it; replay, evaluate and train need labels"
    else:
        labels = ", ".join(f"{count} {label}" for label, count in sorted(found.num_boxes.items()))
        yield f"labels: {labels or 'no box'}"
        yield f"listed boxes without a point of the agent: {found.num_empty} of {found.num_listed}"
        if found.num_listed and found.num_empty > found.num_listed / 2:
            yield "most listed boxes hold no point: a sign, a unit or a pose is probably wrong"
    for infrastructure in (False, True):
        sensors = [sensor for sensor in found.sensors if sensor.is_infrastructure is infrastructure]
        if sensors:
            yield _describe_sensors(sensors, "roadside units" if infrastructure else "vehicles")
    if found.sensors and all(s.sweep.num_intensity_levels <= 1 for s in found.sensors):
        yield "all intensities are equal: the clouds store none, and the shipped weights then find much less"


def _describe_sensors(sensors: list[ReadSensor], kind: str) -> str:
    sweeps = [sensor.sweep for sensor in sensors]
    periods = [sensor.period_s for sensor in sensors if sensor.period_s is not None]
    parts = [
        _span("points a sweep", [s.num_points for s in sweeps], ",.0f"),
        _span("beams", [s.num_beams for s in sweeps], ".0f"),
        _span("median intensity", [s.intensity_median for s in sweeps], ".3f"),
        _span("intensity levels", [s.num_intensity_levels for s in sweeps], ",.0f"),
        _span("sensor height [m]", [s.sensor_height_m for s in sweeps], ".2f"),
        _span("period [s]", periods, ".3f") if periods else "period [s] unknown",
    ]
    return f"{kind}: {'; '.join(parts)}"


def _span(name: str, values: list[int] | list[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return f"{name} {low}" if low == high else f"{name} {low} to {high}"


def _compare(found: RecordingCheck, domain: SensorDomain | None, weights: str) -> Iterator[str]:
    """Yield how the sensors differ from those that the weights were trained on."""
    from manyeyes.studies.sensor_notes import REMEDY, describe_deviations

    if domain is None:
        yield f"{weights} does not state the sensors that it was trained on"
        return
    differing = describe_deviations(found.sensors, domain)
    if not differing:
        yield f"sensors are within those that {weights} was trained on"
        return
    yield from (f"outside of the training of {weights}: {text}" for text in differing)
    yield f"outside of the training of {weights}: {REMEDY}"
