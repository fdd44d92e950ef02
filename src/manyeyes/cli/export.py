# SPDX-License-Identifier: Apache-2.0
"""Exports what methods detect in a recording: KITTI's result files, or nuScenes' result JSON.

KITTI: boxes in the camera of the frame; of recordings without KITTI's calibrations in a forward camera at the ego's LiDAR,
which is written beside them. nuScenes: boxes in the recording's world.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from manyeyes._bounds import Fraction, OutputFolder, PositiveInt, Seed
from manyeyes.studies.replay_options import FileChecks, ReplayOptions

if TYPE_CHECKING:
    from manyeyes.datasets.base import Recording
    from manyeyes.studies.detection_export import KittiExport, NuscenesExport


def _make_replay_options() -> ReplayOptions:
    return ReplayOptions(methods=("intermediate",))


@dataclass(frozen=True)
class Options:
    """Which recording, which format, where to."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario, in the layout of any registered reader; labels are not needed."""
    format: Literal["kitti", "nuscenes"] = "kitti"
    """kitti: a text file a frame, and its calibration; nuscenes: one JSON of all frames."""
    split: str | None = None
    """Which split of a data set: a folder inside it; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; by default all."""
    out: OutputFolder = Path("out/export")
    """Folder for the results, one folder a method."""
    min_score: Fraction = 0.05
    """Detections below this score are left out."""
    frame_stride: PositiveInt = 1
    """Export every n-th of the frames that the recording evaluates."""
    seed: Seed = 0
    """Of the channel's losses and jitter."""
    replay_options: ReplayOptions = field(default_factory=_make_replay_options)
    """How agents collaborate."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Replay a recording and write the detections of the ego."""
    from manyeyes._lock import hold_folder

    with hold_folder(options.out):
        _export(options)


def _export(options: Options) -> None:
    from rich.console import Console

    from manyeyes.agents.replay import replay
    from manyeyes.datasets.registry import open_recording
    from manyeyes.evaluation.detection.recording_filters import FrameStride
    from manyeyes.models import pretrained
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import adapt_to_dataset, check_files
    from manyeyes.studies.replay_options import make_excerpt
    from manyeyes.studies.sensor_notes import print_sensor_note
    from manyeyes.viz.progress import track

    console, chosen = Console(), options.replay_options
    recording = open_recording(options.recording, options.split)
    scenarios = recording.scenarios
    if options.scenario is not None:
        scenarios = (make_excerpt(recording, options.scenario).scenario,)
    missing = check_files(recording, options.checks, console, scenarios)
    config = adapt_to_dataset(chosen.make_replay_config(options.seed), chosen, recording)
    detector = pretrained.load(chosen.weights)
    print_sensor_note(recording, scenarios[0], detector, console)
    exporter, played = _make_exporter(options, recording), FrameStride(recording, options.frame_stride)
    with track(console, "Exporting", len(scenarios)) as report:
        for done, scenario in enumerate(scenarios, 1):
            for step in replay(played, scenario, detector, chosen.methods, config):
                exporter.add(step, step.boxes[step.boxes.score >= options.min_score])
            report(done, len(scenarios))
    exporter.close()
    payload = {"boxes": exporter.counts, "scenarios": len(scenarios), "missing": missing}
    provenance.write_json(options.out / "export.json", payload, {"options": options, "replay": config}, options.seed)
    text = ", ".join(f"{name}: {count} boxes" for name, count in exporter.counts.items())
    console.print(f"{text}; in {options.out}", highlight=False, soft_wrap=True)


def _make_exporter(options: Options, recording: Recording) -> KittiExport | NuscenesExport:
    from manyeyes.studies.detection_export import KittiExport, NuscenesExport

    methods = options.replay_options.methods
    return (
        KittiExport(options.out, methods, recording)
        if options.format == "kitti"
        else NuscenesExport(options.out, methods)
    )
