# SPDX-License-Identifier: Apache-2.0
"""Clock of a live run: nanoseconds since 1970 that advance with the monotonic clock, or in slow motion."""

from __future__ import annotations

import time


class LiveClock:
    """Time that is start_ns at the beginning and advances at a rate; steps of the system clock do not change it.

    In slow motion (rate below 1) everything of a run is slow, its deadlines too: ages and displacements are those of the scene.
    """

    def __init__(self, start_ns: int | None = None, rate: float = 1.0) -> None:
        self.rate = rate
        self._monotonic_ns = time.monotonic_ns()
        now_ns = time.time_ns()
        self.start_ns = now_ns if start_ns is None else start_ns
        # A start in the future, or in the past, is where the clock reads start_ns.
        self._monotonic_ns += self.start_ns - now_ns

    def now_ns(self) -> int:
        """Return the time, nanoseconds; before the start, an earlier one."""
        return self.start_ns + round((time.monotonic_ns() - self._monotonic_ns) * self.rate)

    def sleep(self, duration_ns: int) -> None:
        """Sleep for a duration of this clock."""
        if duration_ns > 0:
            time.sleep(duration_ns / 1e9 / self.rate)
