# SPDX-License-Identifier: Apache-2.0
"""Replays your own recording, in OPV2V's or DAIR-V2X's layout, with every method: table, pictures, animation, report, JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from manyeyes.studies.replay_options import FileChecks, Playing, excerpt, weights_name


@dataclass(frozen=True)
class Options:
    """Which drive, and how it is played."""

    recording: tyro.conf.Positional[Path]
    """A dataset, a folder of scenarios, or one scenario, in OPV2V's layout; or a root in DAIR-V2X's."""
    split: str | None = None
    """Which split of a dataset: a folder inside it, such as test; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: int = 60
    """At most so many judged frames."""
    frame: int | None = None
    """Index of the instant that is pictured; the middle one by default."""
    out: Path = Path("out/run")
    """Folder for pictures, animation, report and JSON."""
    seed: int = 0
    """Of the channel's losses and jitter."""
    animate: bool = True
    """Draw the animation of the drive."""
    score_min: float = 0.4
    """Detections below this score are not drawn; they count all the same."""
    playing: Playing = field(default_factory=Playing)
    """How agents collaborate."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import check_files, open_recording, played_scenarios, suited_to
    from manyeyes.studies.replay_report import REPORT, Showing, play

    console = Console()
    replay = options.playing.replay_config(options.seed)
    recording = open_recording(options.recording, options.split)
    drive = excerpt(recording, options.scenario, options.frames)
    played = played_scenarios(recording, drive.scenario, options.scenario)
    missing = check_files(recording, options.checks, console, played)
    split = f" --split {options.split}" if options.split else ""
    showing = Showing(
        out=options.out,
        title=f"{options.recording.name}: {drive.scenario}",
        lead="A recording, replayed: every agent shares bytes and perceives, as it would on the road.",
        methods=options.playing.methods,
        replay=suited_to(replay, options.playing, recording),
        weights=weights_name(options.playing.weights),
        frame=options.frame,
        animate=options.animate,
        score_min=options.score_min,
        missing=missing,
        commands=(f"manyeyes run {options.recording}{split} --scenario {drive.scenario}",),
    )
    play(drive, pretrained.load(options.playing.weights), showing, console)
    console.print(
        f"\nPictures, animation and JSON are in {options.out}; open {options.out / REPORT}",
        highlight=False,
        soft_wrap=True,
    )
