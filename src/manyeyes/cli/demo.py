# SPDX-License-Identifier: Apache-2.0
"""Simulate a drive in a town outside the training data, replay it with every fusion method, and evaluate the result.

Three connected vehicles and a roadside unit meet at a crossing with traffic, buildings and occlusion. Detections of no fusion,
late, intermediate and early fusion, all with the same memory of two frames, are compared on the same channel; --methods selects
others. The report plays the drive with every method, and shows what the ego alone misses and which agent supplied it. A map of a
crossroads is fused too, from the local maps of a simulated fleet, in a process beside that of the drive.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._bounds import Fraction, InputPath, OutputFolder, PositiveInt, Seed
from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import WITH_MEMORY, ReplayOptions, display_name, make_excerpt

if TYPE_CHECKING:
    from manyeyes.cli.demo_map import DemoMapStats
    from manyeyes.viz.report import Chapter

PRESET = "demo"


@dataclass(frozen=True)
class Options:
    """Where the drive goes and how it is played."""

    out: OutputFolder = Path("out/demo")
    """Folder for the recording, pictures, animation, report and JSON."""
    seed: Seed = 0
    """Another seed, another drive."""
    towns: InputPath | None = None
    """A folder, a wheel of py123d or a CARLA installation with the towns' .xodr files; else the usual places."""
    frames: PositiveInt | None = None
    """At most so many evaluated frames, instead of all."""
    animate: bool = True
    """Draw the animation of the drive."""
    min_score: Fraction | None = None
    """Detections below this score are not drawn; they count all the same. By default that of the weights; 0.4 if uncalibrated."""
    replay_options: ReplayOptions = field(
        default_factory=lambda: ReplayOptions(methods=WITH_MEMORY, channel="its-g5-27mbps")
    )
    """How agents collaborate."""


def main(options: Options) -> None:
    """Simulate a drive, evaluate the methods on it, and write a report."""
    from manyeyes._lock import hold_folder

    with hold_folder(options.out), _start_map(options.out / "map", options.seed) as take_map:
        _run_demo(options, take_map)


def _run_demo(options: Options, take_map: Callable[[], tuple[DemoMapStats, Chapter]]) -> None:
    from rich.console import Console

    from manyeyes.cli.demo_map import describe_crossing_map
    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.simulator.presets import simulate
    from manyeyes.simulator.record import RecordingProgress
    from manyeyes.studies.replay_report import REPORT, ReportSpec, replay_and_report
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.report import save_report

    console = Console()
    replay = options.replay_options.make_replay_config(options.seed)
    detector = pretrained.load(options.replay_options.weights)
    folder = options.out / "recording" / f"seed-{options.seed}"
    with make_progress_bars(console) as progress:
        task = progress.add_task("Simulating", total=1)

        def report_scene(at: RecordingProgress) -> None:
            progress.update(task, completed=at.done)

        simulate(PRESET, folder, options.seed, 1, report_scene, options.towns)
    drive = make_excerpt(open_recording(folder, "test"), None, options.frames)
    town = drive.scenario.rpartition("_")[0]
    if len(drive.eval_indices(drive.scenario)) == 0:
        raise ConfigError(f"{folder}: the drive has no evaluated frame; remove the folder and run the demo again.")
    spec = ReportSpec(
        out=options.out,
        title=f"manyeyes demo: one drive, {len(options.replay_options.methods)} methods",
        lead=f"Three vehicles and a roadside unit in {town}, which the shipped weights never saw: what the ego alone misses, "
        "which agent supplies it, and what it costs in bytes and milliseconds. All that passes between agents is bytes.",
        methods=options.replay_options.methods,
        replay=replay,
        weights=display_name(options.replay_options.weights),
        animate=options.animate,
        min_score=options.min_score,
        facts=(("Town", town),),
        commands=(
            f"manyeyes demo --seed {options.seed}",
            f"manyeyes replay {folder} --split test --channel {options.replay_options.channel} --methods "
            + " ".join(options.replay_options.methods),
            f"manyeyes view {folder} --split test --out drive.gif",
            f"manyeyes view {folder} --split test --detect intermediate-temporal --rerun drive.rrd",
            f"manyeyes map fuse {options.out / 'map'}",
        ),
    )
    report, report_path = replay_and_report(drive, detector, spec, console), options.out / REPORT
    # The report of the detections is on disk before the map is taken, so that nothing of it is lost where the map failed.
    with console.status("Mapping a crossroads"):
        stats, chapter = take_map()
    save_report(replace(report, chapters=(chapter, *report.chapters)), report_path)
    console.print(f"\n{describe_crossing_map(stats)}", highlight=False, soft_wrap=True)
    console.print(
        f"\nPictures, animation and JSON are in {options.out}; open {report_path}", highlight=False, soft_wrap=True
    )


@contextmanager
def _start_map(out: Path, seed: int) -> Iterator[Callable[[], tuple[DemoMapStats, Chapter]]]:
    """Map the crossroads in a process of its own; yield a function that waits for the map, or raises what ended it.

    A fork where no thread could hold a lock in it: it imports nothing anew. The process ends with the block.
    """
    from manyeyes.cli.demo_map import map_crossing

    is_safe = sys.platform == "linux" and threading.active_count() == 1
    context = multiprocessing.get_context("fork" if is_safe else "spawn")
    with ProcessPoolExecutor(1, context, _start_map_process) as pool:
        future = pool.submit(map_crossing, out, seed)
        try:
            yield future.result
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _start_map_process() -> None:
    from manyeyes._workers import start_worker

    # The process of the drive ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start_worker()
