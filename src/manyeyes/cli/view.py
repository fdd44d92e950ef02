# SPDX-License-Identifier: Apache-2.0
"""Draws a frame of a recording from above (.png), or animates a drive (.gif, .webp), with or without detections.

With --rerun it logs the drive, or a recorded live run (.mcap), in three dimensions for the viewer rerun.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes._bounds import ExtentM, Fraction, NonNegativeInt, OutputFile, PixelCount, PositiveInt
from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import ReplayOptions, make_excerpt

if TYPE_CHECKING:
    from collections.abc import Iterator

    from PIL.Image import Image

    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datatypes import BevGrid, Boxes, Snapshot
    from manyeyes.studies.replay_options import Excerpt
    from manyeyes.viz.spatial_frame import SpatialFrame

SUFFIXES = (".png", ".gif", ".webp")
MAX_PIXELS = 50_000_000


@dataclass(frozen=True)
class Options:
    """The frame to draw, and the output file."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frame: NonNegativeInt | None = None
    """Index of the frame; the first evaluated one by default. An animation starts there."""
    frames: PositiveInt = 60
    """At most so many frames of an animation."""
    out: OutputFile = Path("out/view.png")
    """The file: .png for a frame, .gif or .webp for the drive."""
    rerun: str | None = None
    """Log the drive for the viewer rerun, instead of drawing: a file .rrd, or the address of a viewer, rerun+http://HOST:PORT/proxy."""
    half_extent_m: tuple[ExtentM, ExtentM] = (70.4, 38.4)
    """How far the picture reaches ahead and aside, metres; with --detect the detector's range counts."""
    width: PixelCount = 1280
    """Of the picture, pixels."""
    detect: str | None = None
    """Also draw what one method finds: no-fusion, late, intermediate, early, or NAME-temporal."""
    min_score: Fraction | None = None
    """Detections below this score are not drawn; by default that of the weights, 0.4 if they are uncalibrated."""
    replay_options: ReplayOptions = field(default_factory=ReplayOptions)
    """How agents collaborate, with --detect."""


def main(options: Options) -> None:
    """Draw a frame or an animation."""
    from rich.console import Console

    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import adapt_to_dataset, print_notes
    from manyeyes.studies.sensor_notes import print_sensor_note
    from manyeyes.viz.animation import save_animation
    from manyeyes.viz.birds_eye import save_png

    if options.rerun is not None:
        _log_for_rerun(options, options.rerun)
        return
    if options.out.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--out ends in {', '.join(SUFFIXES)}; got {options.out.name}.")
    height = options.width * options.half_extent_m[1] / options.half_extent_m[0]
    if options.width * height > MAX_PIXELS:
        raise ConfigError(
            f"--width {options.width} and --half-extent-m {options.half_extent_m} make a picture of {options.width} x {height:.0f} "
            f"pixels; at most {MAX_PIXELS:,} in all: choose a smaller one."
        )
    recording = open_recording(options.recording, options.split)
    drive = make_excerpt(recording, options.scenario)
    single = options.out.suffix.lower() == ".png"
    first = drive.eval_indices(drive.scenario).start if options.frame is None else options.frame
    last = min(drive.length(drive.scenario), first + (1 if single else options.frames))
    console = Console()
    print_notes(recording, console, {drive.scenario})
    config: ReplayConfig | None = None
    if options.detect is not None:
        replay_options = replace(options.replay_options, methods=(options.detect,))
        config = adapt_to_dataset(replay_options.make_replay_config(0), replay_options, recording)
        print_sensor_note(drive, drive.scenario, pretrained.load(replay_options.weights), console)
    images = _draw_images(options, drive, range(first, last), config)
    if single:
        save_png(images[0], options.out)
    else:
        save_animation(images, options.out)
    console.print(f"{options.out}: {drive.scenario}, frames {first} to {last - 1}", highlight=False, soft_wrap=True)


def _log_for_rerun(options: Options, target: str) -> None:
    """Log a drive, or a recorded live run (.mcap)."""
    from itertools import islice

    from rich.console import Console

    from manyeyes.viz.rerun_log import RerunLog

    num = 0
    with RerunLog(target, options.recording.name) as log:
        for frame in islice(_make_spatial_frames(options), options.frames):
            log.add(frame)
            num += 1
    Console().print(f"{target}: {num} frames; open it with 'rerun'", highlight=False, soft_wrap=True)


def _make_spatial_frames(options: Options) -> Iterator[SpatialFrame]:
    from manyeyes.agents.replay import DetectionReplay
    from manyeyes.cli.live.options import make_agent
    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import adapt_to_dataset
    from manyeyes.studies.replay_report import find_min_score
    from manyeyes.studies.spatial_views import show_run, show_snapshot, show_step

    if options.recording.suffix == ".mcap" and options.recording.is_file():
        yield from show_run(options.recording, make_agent, options.min_score or 0.0)
        return
    recording = open_recording(options.recording, options.split)
    drive = make_excerpt(recording, options.scenario)
    first = drive.eval_indices(drive.scenario).start if options.frame is None else options.frame
    snapshots = (drive.snapshot(drive.scenario, index) for index in range(first, drive.length(drive.scenario)))
    if options.detect is None:
        yield from map(show_snapshot, snapshots)
        return
    replay_options = replace(options.replay_options, methods=(options.detect,))
    config = adapt_to_dataset(replay_options.make_replay_config(0), replay_options, recording)
    detector = pretrained.load(replay_options.weights)
    min_score = find_min_score(detector, options.detect, options.min_score)
    player = DetectionReplay(options.detect, detector, config)
    for snapshot in snapshots:
        for step in player.step(snapshot):
            yield show_step(step, min_score)


def _draw_images(options: Options, drive: Excerpt, indices: range, config: ReplayConfig | None) -> list[Image]:
    from manyeyes.datatypes import BevGrid, Boxes
    from manyeyes.viz.birds_eye import draw_scene, make_scene

    snapshots = [drive.snapshot(drive.scenario, i) for i in (indices or (indices.start,))]
    grid = BevGrid(-options.half_extent_m[0], -options.half_extent_m[1], -5.0, *options.half_extent_m, 6.0)
    detections, min_score = [Boxes.empty()] * len(snapshots), options.min_score or 0.0
    if config is not None:
        grid, min_score, detections = _run_detector(options, config, snapshots)
    images = []
    for snapshot, boxes in zip(snapshots, detections):
        caption = f"frame {snapshot.index} · {len(snapshot.frames)} agents"
        caption += f" · {options.detect} with {options.replay_options.weights}" if options.detect else ""
        scene = make_scene(snapshot, boxes)
        images.append(draw_scene(scene, grid, drive.scenario, caption, options.width, min_score))
    return images


def _run_detector(
    options: Options, config: ReplayConfig, snapshots: list[Snapshot]
) -> tuple[BevGrid, float, list[Boxes]]:
    """Return the detector's range, the minimum score of drawn boxes, and what the ego finds at each instant."""
    from manyeyes.agents.replay import DetectionReplay
    from manyeyes.models import pretrained
    from manyeyes.studies.replay_report import find_min_score

    detector = pretrained.load(options.replay_options.weights)
    player = DetectionReplay(str(options.detect), detector, config)
    boxes = [step.boxes for snapshot in snapshots for step in player.step(snapshot)]
    return detector.detection_range, find_min_score(detector, str(options.detect), options.min_score), boxes
