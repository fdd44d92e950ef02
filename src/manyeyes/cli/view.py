# SPDX-License-Identifier: Apache-2.0
"""Draws a frame of a recording from above (.png), or animates a drive (.gif, .webp), with or without detections."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, Snapshot
from manyeyes.studies.replay_options import Playing, excerpt

if TYPE_CHECKING:
    from PIL.Image import Image

    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.studies.replay_options import Excerpt

SUFFIXES = (".png", ".gif", ".webp")


@dataclass(frozen=True)
class Options:
    """What to draw."""

    recording: tyro.conf.Positional[Path]
    """A dataset, a folder of scenarios, or one scenario, in OPV2V's layout; or a root in DAIR-V2X's."""
    split: str | None = None
    """Which split of a dataset: a folder inside it, such as test; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frame: int | None = None
    """Index of the frame; the first judged one by default. An animation starts there."""
    frames: int = 60
    """At most so many frames of an animation."""
    out: Path = Path("out/view.png")
    """The file: .png for a frame, .gif or .webp for the drive."""
    reach_m: tuple[float, float] = (70.4, 38.4)
    """How far the picture reaches ahead and aside, metres; with --detect the detector's range counts."""
    width: int = 1280
    """Of the picture, pixels."""
    detect: str | None = None
    """Also draw what one method finds: alone, late, intermediate or early."""
    score_min: float = 0.4
    """Detections below this score are not drawn."""
    playing: Playing = field(default_factory=Playing)
    """How agents collaborate, with --detect."""


def main(options: Options) -> None:
    """The verb."""
    from rich.console import Console

    from manyeyes.studies.recordings import open_recording
    from manyeyes.viz.animation import save_animation
    from manyeyes.viz.birds_eye import save_png

    if options.out.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--out ends in {', '.join(SUFFIXES)}; got {options.out.name}.")
    recording = open_recording(options.recording, options.split)
    drive = excerpt(recording, options.scenario)
    single = options.out.suffix.lower() == ".png"
    first = drive.judged(drive.scenario).start if options.frame is None else options.frame
    last = min(drive.length(drive.scenario), first + (1 if single else options.frames))
    console = Console()
    for problem in recording.problems:
        console.print(f"note: {problem}", highlight=False, markup=False, soft_wrap=True)
    images = _images(options, drive, range(first, last))
    if single:
        save_png(images[0], options.out)
    else:
        save_animation(images, options.out)
    console.print(f"{options.out}: {drive.scenario}, frames {first} to {last - 1}", highlight=False, soft_wrap=True)


def _images(options: Options, drive: Excerpt, indices: range) -> list[Image]:
    from manyeyes.viz.birds_eye import draw, scene_of

    snapshots = [drive.snapshot(drive.scenario, i) for i in (indices or (indices.start,))]
    grid = BevGrid(-options.reach_m[0], -options.reach_m[1], -5.0, *options.reach_m, 6.0)
    found = [Boxes.empty()] * len(snapshots)
    if options.detect is not None:
        grid, found = _detections(options, drive, snapshots)
    images = []
    for snapshot, boxes in zip(snapshots, found):
        caption = f"frame {snapshot.index} · {len(snapshot.frames)} agents"
        caption += f" · {options.detect} with {options.playing.weights}" if options.detect else ""
        scene = scene_of(snapshot, boxes)
        images.append(draw(scene, grid, drive.scenario, caption, options.width, options.score_min))
    return images


def _detections(options: Options, drive: Excerpt, snapshots: list[Snapshot]) -> tuple[BevGrid, list[Boxes]]:
    """The detector's range, and what the ego finds at each instant."""
    from dataclasses import replace

    from manyeyes.agents.replay import Team
    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import suited_to

    playing = replace(options.playing, methods=(str(options.detect),))
    config: ReplayConfig = suited_to(playing.replay_config(0), playing, drive.recording)
    detector = pretrained.load(playing.weights)
    team = Team(playing.methods[0], detector, config)
    return detector.config.range, [step.boxes for snapshot in snapshots for step in team.step(snapshot)]
