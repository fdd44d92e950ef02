# SPDX-License-Identifier: Apache-2.0
"""Compute a recorded live run again, and compare: the same packets and boxes, bit for bit, on the same build and machine.

With --security the packets are checked in another mode: what the agent would have perceived.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True)
class Options:
    """The recorded run, and how it is computed."""

    run: tyro.conf.Positional[Path]
    """A recording of 'manyeyes live run --record'."""
    check: bool = False
    """Fail where a frame differs from the recorded run."""
    security: Literal["off", "warn", "require"] | None = None
    """Another mode than that of the run."""


def main(options: Options) -> None:
    """Replay the run and print how many frames are the same.

    Raises:
        RecordingError: with --check, a frame differs.
    """
    from rich.console import Console

    from manyeyes.datatypes import ConfigError

    if options.check and options.security is not None:
        raise ConfigError("--check compares with the recorded run; leave --security out.")
    report = check_run(options.run, options.security, options.check)
    Console().print(report, highlight=False, markup=False, soft_wrap=True)


def check_run(path: Path, security: Literal["off", "warn", "require"] | None = None, check: bool = True) -> str:
    """Replay a run; return the result in one line.

    Raises:
        RecordingError: with check, a frame differs, or there is none.
    """
    import torch

    from manyeyes.cli.live.options import make_agent
    from manyeyes.datatypes import RecordingError
    from manyeyes.runtime.replay import read_config, replay_run

    torch.set_num_threads(read_config(path).num_threads)
    ticks = [(tick.same_packets, tick.same_result) for tick in replay_run(path, make_agent, security)]
    same_packets, same_results = (sum(column) for column in zip(*ticks)) if ticks else (0, 0)
    text = f"{path}: {len(ticks)} frames; the same bit for bit: packets of {same_packets}, boxes of {same_results}"
    if check and not (ticks and same_packets == same_results == len(ticks)):
        raise RecordingError(f"{text}. Another build, processor or number of threads rounds otherwise.")
    return text
