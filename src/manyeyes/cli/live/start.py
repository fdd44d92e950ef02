# SPDX-License-Identifier: Apache-2.0
"""Common start of the processes of a team: each reports that it is ready, and reads the time of the start."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from manyeyes.datatypes.errors import ConfigError

if TYPE_CHECKING:
    from manyeyes.runtime.clock import LiveClock

READY = "ready"
START_DELAY_NS = 200_000_000


def announce_ready(await_start: bool, frame_s: float = 0.0, rate: float = 1.0) -> LiveClock:
    """Return the clock of a run. await_start: print "ready" and the seconds of a frame, and read its start and rate; else it
    starts at once, at a rate.
    """
    from manyeyes.runtime.clock import LiveClock, read_tai_ns

    if not await_start:
        return LiveClock(read_tai_ns() + START_DELAY_NS, rate)
    sys.stdout.write(f"{READY} {frame_s:.4f}\n")
    sys.stdout.flush()
    words = sys.stdin.readline().split()
    if len(words) != 2:
        raise ConfigError("--await-start reads the time of the start and the rate from the input; the input ended.")
    return LiveClock(int(words[0]), float(words[1]))
