# SPDX-License-Identifier: Apache-2.0
"""Compute a recorded live run again, and compare: the same packets and boxes, bit for bit, on the same build and machine.

With --what-if the run is computed with other settings: what the agent would have perceived of what it received.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """The recorded run, and how it is computed."""

    run: tyro.conf.Positional[Path]
    """A recording of 'manyeyes live run --record'."""
    check: bool = False
    """Fail where a frame differs from the recorded run."""
    what_if: tuple[str, ...] = ()
    """Settings: security=off|warn|require, strategy=NAME, budget-bytes=N, pose-correction=NAME|none, misbehaviour=NAME|none."""


def main(options: Options) -> None:
    """Replay the run and print how many frames are the same.

    Raises:
        RecordingError: with --check, a frame differs.
    """
    from rich.console import Console

    from manyeyes.datatypes import ConfigError

    if options.check and options.what_if:
        raise ConfigError("--check compares with the recorded run; leave --what-if out.")
    report = (
        describe_changed_run(options.run, options.what_if) if options.what_if else check_run(options.run, options.check)
    )
    Console().print(report, highlight=False, markup=False, soft_wrap=True)


def check_run(path: Path, check: bool = True) -> str:
    """Replay a run; return the result in one line.

    Raises:
        RecordingError: with check, a frame differs, or there is none.
    """
    import torch

    from manyeyes.cli.live.options import make_agent
    from manyeyes.datatypes import RecordingError
    from manyeyes.runtime.replay import read_config, replay_run

    torch.set_num_threads(read_config(path).num_threads)
    ticks = [(tick.same_packets, tick.same_result) for tick in replay_run(path, make_agent)]
    same_packets, same_results = (sum(column) for column in zip(*ticks)) if ticks else (0, 0)
    text = f"{path}: {len(ticks)} frames; the same bit for bit: packets of {same_packets}, boxes of {same_results}"
    if check and not (ticks and same_packets == same_results == len(ticks)):
        raise RecordingError(f"{text}. Another build, processor or number of threads rounds otherwise.")
    return text


def describe_changed_run(path: Path, changes: Sequence[str]) -> str:
    """Replay a run as it was and with other settings; return what differs, a line each."""
    import torch

    from manyeyes.cli.live.options import make_agent
    from manyeyes.runtime.replay import read_config, replay_run
    from manyeyes.runtime.what_if import parse_changes

    change = parse_changes(changes)
    torch.set_num_threads(read_config(path).num_threads)
    lines = [f"{path}: per frame"]
    for name, ticks in (
        ("as recorded", replay_run(path, make_agent)),
        (" ".join(changes), replay_run(path, make_agent, change)),
    ):
        num = num_boxes = num_fused = num_rejected = num_other = 0
        for tick in ticks:
            num, num_boxes = num + 1, num_boxes + len(tick.perception.boxes.score)
            num_fused += len(tick.perception.received)
            num_rejected, num_other = num_rejected + len(tick.perception.rejected), num_other + (not tick.same_result)
        each = max(num, 1)
        lines.append(
            f"  {name}: {num_fused / each:.2f} messages fused, {num_rejected / each:.2f} senders rejected, {num_boxes / each:.1f} "
            f"boxes; other than recorded in {num_other} of {num} frames"
        )
    return "\n".join(lines)
