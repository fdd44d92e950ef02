# SPDX-License-Identifier: Apache-2.0
"""Replays a recording with every method: table, pictures, animation, report, JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from manyeyes._bounds import Fraction, NonNegativeInt, OutputFolder, PositiveInt, Seed
from manyeyes.studies.replay_options import FileChecks, ReplayOptions, display_name, make_excerpt


@dataclass(frozen=True)
class Options:
    """Which drive, and how it is played."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: PositiveInt = 60
    """At most so many evaluated frames."""
    frame: NonNegativeInt | None = None
    """Index of the instant that is pictured; the middle one by default."""
    out: OutputFolder = Path("out/replay")
    """Folder for pictures, animation, report and JSON."""
    seed: Seed = 0
    """Of the channel's losses and jitter."""
    animate: bool = True
    """Draw the animation of the drive."""
    min_score: Fraction | None = None
    """Detections below this score are not drawn; they count all the same. By default that of the weights; 0.4 if uncalibrated."""
    replay_options: ReplayOptions = field(default_factory=ReplayOptions)
    """How agents collaborate."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Replay a drive and write a report."""
    from manyeyes._lock import hold_folder

    with hold_folder(options.out):
        _replay(options)


def _replay(options: Options) -> None:
    from rich.console import Console

    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import (
        adapt_to_dataset,
        check_evaluated_frames,
        check_files,
        select_checked_scenarios,
    )
    from manyeyes.studies.replay_report import REPORT, ReportSpec, replay_and_report
    from manyeyes.studies.sensor_notes import print_sensor_note

    console = Console()
    replay = options.replay_options.make_replay_config(options.seed)
    recording = open_recording(options.recording, options.split)
    drive = make_excerpt(recording, options.scenario, options.frames)
    check_evaluated_frames(drive, drive.scenarios)
    scenarios = select_checked_scenarios(recording, drive.scenario, options.scenario)
    missing = check_files(recording, options.checks, console, scenarios)
    split = f" --split {options.split}" if options.split else ""
    spec = ReportSpec(
        out=options.out,
        title=f"{options.recording.name}: {drive.scenario}",
        lead="A recording, replayed: every agent shares bytes and perceives, as it would on the road.",
        methods=options.replay_options.methods,
        replay=adapt_to_dataset(replay, options.replay_options, recording),
        weights=display_name(options.replay_options.weights),
        frame=options.frame,
        animate=options.animate,
        min_score=options.min_score,
        missing=missing,
        commands=(f"manyeyes replay {options.recording}{split} --scenario {drive.scenario}",),
    )
    detector = pretrained.load(options.replay_options.weights)
    print_sensor_note(recording, drive.scenario, detector, console)
    replay_and_report(drive, detector, spec, console)
    console.print(
        f"\nPictures, animation and JSON are in {options.out}; open {options.out / REPORT}",
        highlight=False,
        soft_wrap=True,
    )
