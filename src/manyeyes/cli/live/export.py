# SPDX-License-Identifier: Apache-2.0
"""Write a recorded live run, computed again, as a file for the viewer Foxglove."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from manyeyes._bounds import Fraction, OutputFile


@dataclass(frozen=True)
class Options:
    """The recorded run, and the file."""

    run: tyro.conf.Positional[Path]
    """A recording of 'manyeyes live run --record'."""
    foxglove: OutputFile = Path("out/foxglove.mcap")
    """The file to write: poses, clouds, boxes, messages, map, numbers and events, with Foxglove's schemas."""
    min_score: Fraction = 0.0
    """Boxes of at least this score."""


def main(options: Options) -> None:
    """Compute the run again, and write its frames.

    Raises:
        RecordingError: the file is no whole recording of a live run.
    """
    import torch
    from rich.console import Console

    from manyeyes.cli.live.options import make_agent
    from manyeyes.datatypes import ConfigError
    from manyeyes.runtime.recorder import count_ticks
    from manyeyes.runtime.replay import read_config
    from manyeyes.studies.spatial_views import log_frames, show_run
    from manyeyes.viz.foxglove_log import FoxgloveLog
    from manyeyes.viz.progress import make_progress_bars

    if options.foxglove.resolve() == options.run.resolve():
        raise ConfigError(f"--foxglove {options.foxglove} is the recording itself; choose another file.")
    torch.set_num_threads(read_config(options.run).num_threads)
    console = Console()
    frames = show_run(options.run, make_agent, options.min_score)
    with FoxgloveLog(options.foxglove) as log, make_progress_bars(console) as progress:
        task = progress.add_task("Logging", total=count_ticks(options.run))
        num = log_frames(frames, (log,), lambda: progress.advance(task))
    console.print(f"{options.foxglove}: {num} frames; open it with Foxglove", highlight=False, soft_wrap=True)
