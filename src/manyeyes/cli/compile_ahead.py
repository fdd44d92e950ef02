# SPDX-License-Identifier: Apache-2.0
"""Compile what the demo and the viewers run before they are needed: a short drive and a map, in a process each.

They call what the demo calls, so that loops are compiled for just the types of arguments that it has; there is no list of loops
that could be out of date.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numba.core import event

from manyeyes._jit import find_cache_folder
from manyeyes._workers import start_worker
from manyeyes.cli import demo

NUM_FRAMES = 9
"""Of the drive: six of history, and three that are evaluated."""
_POLL_S = 0.5


@dataclass(frozen=True)
class CompiledAhead:
    """How many loops were compiled, 0 where all were before, and the folder where those of this module's package lie."""

    num_loops: int
    folder: Path


def compile_ahead(progress: Callable[[int], None]) -> CompiledAhead | None:
    """Compile the demo's loops, and keep them on disk; None where no folder can be written, which compiles nothing.

    Args:
        progress: receives the number of loops compiled so far, about twice a second.
    """
    folder = find_cache_folder()
    if folder is None:
        return None
    context = multiprocessing.get_context("spawn")
    count = context.Value("q")
    with TemporaryDirectory() as out, ProcessPoolExecutor(2, context, _start, (count,)) as pool:
        futures = [pool.submit(part, Path(out)) for part in (compile_drive, compile_map)]
        try:
            while wait(futures, _POLL_S).not_done:
                progress(count.value)
            for future in futures:
                future.result()
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return CompiledAhead(count.value, folder)


def compile_drive(out: Path) -> None:
    """Simulate the start of a drive as the demo does, and play its methods on it."""
    from rich.console import Console

    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.simulator.presets import make_jobs, simulation_preset
    from manyeyes.simulator.record import record
    from manyeyes.studies.replay_options import make_excerpt
    from manyeyes.studies.replay_report import ReportSpec, replay_and_report

    options = demo.Options().replay_options
    record(make_jobs(replace(simulation_preset(demo.PRESET), frames=NUM_FRAMES), 0), out / "recording")
    spec = ReportSpec(
        out=out / "replay",
        title="",
        lead="",
        methods=options.methods,
        replay=options.make_replay_config(0),
        weights=options.weights,
        animate=False,
    )
    drive = make_excerpt(open_recording(out / "recording", "test"), None)
    replay_and_report(drive, pretrained.load(options.weights), spec, Console(quiet=True))


def compile_map(out: Path) -> None:
    """Map the demo's crossroads."""
    from manyeyes.cli.demo_map import map_crossing

    map_crossing(out / "map")


class _Counter(event.Listener):
    """Counts the loops of this process that are compiled to be kept; those that are linked into them are parts of them."""

    def __init__(self, count: Synchronized[int]) -> None:
        self._count, self._depth = count, 0

    def on_start(self, event: Any) -> None:
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            with self._count.get_lock():
                self._count.value += 1


def _start(count: Synchronized[int]) -> None:
    # The process of the command ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start_worker()
    event.register("numba:compile", _Counter(count))
