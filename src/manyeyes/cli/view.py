# SPDX-License-Identifier: Apache-2.0
"""Draws a frame of a recording from above (.png), or animates a drive (.gif, .webp), with or without detections.

With --rerun or --mcap it logs the drive, or a recorded live run (.mcap), in three dimensions for the viewers rerun and Foxglove.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from manyeyes._bounds import ExtentM, Fraction, InputMap, NonNegativeInt, OutputFile, PixelCount, PositiveInt
from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import ReplayOptions, make_excerpt

if TYPE_CHECKING:
    from collections.abc import Iterator

    from PIL.Image import Image
    from rich.console import Console

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
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader. With
    --rerun or --mcap also a recorded live run (.mcap)."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frame: NonNegativeInt | None = None
    """Index of the frame; the first evaluated one by default. An animation starts there."""
    frames: PositiveInt = 60
    """At most so many frames of an animation, or of what is logged."""
    out: OutputFile = Path("out/view.png")
    """The file: .png for a frame, .gif or .webp for the drive."""
    rerun: str | None = None
    """Log the drive for the viewer rerun, instead of drawing: a file .rrd; web or web:PORT, to serve the web viewer on this machine
    until Ctrl-C; or the address of a viewer that runs, rerun+http://HOST:PORT/proxy."""
    mcap: OutputFile | None = None
    """Log the drive for the viewer Foxglove, instead of drawing: a file .mcap."""
    cloud_color: Literal["agent", "intensity"] = "agent"
    """With --rerun or --mcap: points in a colour of their agent, darker where the intensity is low, or in colours of intensity."""
    map: InputMap | None = None
    """With --rerun or --mcap: a map of the drive, to log its elements by kind: the folder of 'map build' or 'map fuse', or a store
    in a folder or at a URL."""
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

    if options.rerun is not None or options.mcap is not None:
        _log_drive(options)
        return
    for name in ("cloud_color", "map"):
        if getattr(options, name) != getattr(Options(options.recording), name):
            raise ConfigError(f"--{name.replace('_', '-')} needs --rerun or --mcap.")
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
    indices = _select_frames(options, drive, 1 if single else options.frames)
    console = Console()
    print_notes(recording, console, {drive.scenario})
    config: ReplayConfig | None = None
    if options.detect is not None:
        replay_options = replace(options.replay_options, methods=(options.detect,))
        config = adapt_to_dataset(replay_options.make_replay_config(0), replay_options, recording)
        print_sensor_note(drive, drive.scenario, pretrained.load(replay_options.weights), console)
    images = _draw_images(options, drive, indices, config)
    if single:
        save_png(images[0], options.out)
    else:
        save_animation(images, options.out)
    where = f"frames {indices.start} to {indices[-1]}"
    console.print(f"{options.out}: {drive.scenario}, {where}", highlight=False, soft_wrap=True)


def _select_frames(options: Options, drive: Excerpt, max_frames: int) -> range:
    """Return the indices of the frames from the chosen one on, or the first evaluated one.

    Raises:
        ConfigError: the drive has no such frame.
    """
    length = drive.length(drive.scenario)
    first = drive.eval_indices(drive.scenario).start if options.frame is None else options.frame
    if first >= length:
        raise ConfigError(f"{drive.scenario} has no frame {first}; choose one of 0 to {length - 1}.")
    return range(first, min(length, first + max_frames))


def _log_drive(options: Options) -> None:
    """Log a drive, or a recorded live run (.mcap), for one viewer or both; frames are computed once."""
    import signal

    from rich.console import Console

    from manyeyes.studies.spatial_views import SpatialLog, log_frames
    from manyeyes.viz.foxglove_log import FoxgloveLog
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.rerun_log import RerunLog

    console = Console()
    if options.mcap is not None and options.mcap.suffix.lower() != ".mcap":
        raise ConfigError(f"--mcap ends in .mcap; got {options.mcap.name}.")
    if options.mcap is not None and options.mcap.resolve() == options.recording.resolve():
        raise ConfigError(f"--mcap {options.mcap} is the recording itself; choose another file.")
    frames, total = _open_frames(options, console)
    with ExitStack() as files:
        logs, openings, viewer = list[SpatialLog](), list[tuple[str, str]](), None
        if options.rerun is not None:
            viewer = files.enter_context(RerunLog(options.rerun, options.recording.name, options.cloud_color))
            logs.append(viewer)
            openings.append((options.rerun, _describe_opening(options.rerun)))
        # Finished first: a viewer that has gone does not spoil the file.
        if options.mcap is not None:
            logs.append(files.enter_context(FoxgloveLog(options.mcap, options.cloud_color)))
            openings.append((str(options.mcap), "open it with Foxglove"))
        if viewer is not None and viewer.server is not None:
            # Not every system has SIGHUP, the end of a terminal.
            for number in {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}:
                before = signal.signal(number, signal.default_int_handler)
                files.callback(signal.signal, number, before)
            console.print(f"Open {viewer.server.page}", highlight=False, soft_wrap=True)
        with make_progress_bars(console) as progress:
            task = progress.add_task("Logging", total=total)
            num = log_frames(frames, logs, lambda: progress.advance(task))
        if viewer is not None and viewer.server is not None:
            viewer.flush()
            with suppress(KeyboardInterrupt):
                console.print("All frames are logged; Ctrl-C ends the viewer", highlight=False, soft_wrap=True)
                viewer.server.wait()
    for target, opening in openings:
        console.print(f"{target}: {num} frames; {opening}", highlight=False, soft_wrap=True, markup=False)


def _describe_opening(target: str) -> str:
    return "open it with 'rerun'" if target.endswith(".rrd") else "the viewer shows them"


def _open_frames(options: Options, console: Console) -> tuple[Iterator[SpatialFrame], int | None]:
    """Return the frames that are logged, and their number if it is known before."""
    from itertools import islice

    import torch

    from manyeyes.cli.live.options import make_agent
    from manyeyes.runtime.recorder import count_ticks
    from manyeyes.runtime.replay import read_config
    from manyeyes.studies.spatial_views import show_run

    if options.recording.suffix == ".mcap" and options.recording.is_file():
        given = [name for name in ("detect", "map", "frame", "scenario", "split") if getattr(options, name) is not None]
        if given:
            raise ConfigError(
                "A recorded live run is one drive, with detections and local maps of its own, shown from its start: leave out "
                f"{', '.join(f'--{name}' for name in given)}."
            )
        torch.set_num_threads(read_config(options.recording).num_threads)
        total = count_ticks(options.recording)
        if total is not None and total > options.frames:
            console.print(f"The first {options.frames} of {total} frames; --frames {total} logs all", highlight=False)
        frames = show_run(options.recording, make_agent, options.min_score or 0.0)
        return islice(frames, options.frames), None if total is None else min(total, options.frames)
    return _open_drive(options, console)


def _open_drive(options: Options, console: Console) -> tuple[Iterator[SpatialFrame], int]:
    from manyeyes.agents.replay import DetectionReplay
    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.studies.recordings import adapt_to_dataset, print_notes
    from manyeyes.studies.replay_report import find_min_score
    from manyeyes.studies.spatial_views import read_map_lines, show_snapshot, show_step

    recording = open_recording(options.recording, options.split)
    drive = make_excerpt(recording, options.scenario)
    indices = _select_frames(options, drive, options.frames)
    print_notes(recording, console, {drive.scenario})
    map_lines = {} if options.map is None else read_map_lines(recording, drive.scenario, options.map)
    snapshots = (drive.snapshot(drive.scenario, index) for index in indices)
    if options.detect is None:
        frames = map(show_snapshot, snapshots)
    else:
        replay_options = replace(options.replay_options, methods=(options.detect,))
        config = adapt_to_dataset(replay_options.make_replay_config(0), replay_options, recording)
        detector = pretrained.load(replay_options.weights)
        min_score = find_min_score(detector, options.detect, options.min_score)
        player = DetectionReplay(options.detect, detector, config)
        frames = (
            show_step(step, min_score, detector.detection_range)
            for snapshot in snapshots
            for step in player.step(snapshot)
        )
    return (replace(frame, map_lines=map_lines) for frame in frames), len(indices)


def _draw_images(options: Options, drive: Excerpt, indices: range, config: ReplayConfig | None) -> list[Image]:
    from manyeyes.datatypes import BevGrid, Boxes
    from manyeyes.viz.birds_eye import draw_scene, make_scene

    snapshots = [drive.snapshot(drive.scenario, i) for i in indices]
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
