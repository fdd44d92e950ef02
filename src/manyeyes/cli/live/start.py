# SPDX-License-Identifier: Apache-2.0
"""Common start of the processes of a team: each reports that it is ready, and reads the time of the start."""

from __future__ import annotations

import sys
from datetime import datetime, time
from typing import TYPE_CHECKING

from manyeyes.datatypes.errors import ConfigError

if TYPE_CHECKING:
    from manyeyes.runtime.clock import LiveClock

READY = "ready"
START_DELAY_NS = 200_000_000


def parse_start(text: str) -> int:
    """Return the TAI (ns since 1970) of a time of today, such as 18:05:00, or of a date and time; local, if it states no zone.

    Raises:
        ConfigError: the text is neither.
    """
    from manyeyes.runtime.clock import tai_from_utc_ns

    try:
        stated = datetime.combine(datetime.now().date(), time.fromisoformat(text))
    except ValueError:
        stated = _parse_date_and_time(text)
    return tai_from_utc_ns(round(stated.timestamp() * 1_000_000) * 1_000)


def _parse_date_and_time(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(
            f"--start is a time of today such as 18:05:00, or a date and time such as 2026-11-27T18:05:00Z; got {text!r}."
        ) from error


def announce_ready(
    await_start: bool, frame_s: float = 0.0, rate: float = 1.0, start_ns: int | None = None
) -> LiveClock:
    """Return the clock of a run. await_start: print "ready" and the seconds of a frame, and read its start and rate; else it
    starts at start_ns (TAI), or at once, at a rate.
    """
    from manyeyes.runtime.clock import LiveClock, read_tai_ns

    if not await_start:
        return LiveClock(read_tai_ns() + START_DELAY_NS if start_ns is None else start_ns, rate)
    sys.stdout.write(f"{READY} {frame_s:.4f}\n")
    sys.stdout.flush()
    words = sys.stdin.readline().split()
    if len(words) != 2:
        raise ConfigError("--await-start reads the time of the start and the rate from the input; the input ended.")
    return LiveClock(int(words[0]), float(words[1]))
