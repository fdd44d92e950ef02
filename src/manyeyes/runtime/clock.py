# SPDX-License-Identifier: Apache-2.0
"""Clocks of a live run. Stamps on the network are TAI: nanoseconds since 1970 that no leap second moves.

Time advances with the monotonic clock, and follows a disciplined system clock (PTP, GNSS, NTP) between frames: slowly where it
drifts, at once where it steps. Deadlines within a frame are therefore those of the monotonic clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

NS_PER_S = 1_000_000_000
TAI_UTC_NS = 37 * NS_PER_S
"""TAI less UTC since 2017, where the kernel does not state it."""
MAX_SLEW = 500e-6
"""Fraction by which time runs faster or slower while it follows the system clock."""
MIN_STEP_NS = 20_000_000
"""A larger difference from the system clock is a step of it."""
_MIN_KERNEL_TAI_NS = 10 * NS_PER_S
_MAX_READING_NS, _NUM_READINGS = 2_000_000, 4


class Clock(Protocol):
    """What the loop of an agent asks of its clock."""

    def now_ns(self) -> int:
        """Return the time, nanoseconds."""
        ...

    def sleep(self, duration_ns: int) -> None:
        """Sleep for a duration of this clock."""
        ...

    def discipline(self) -> int:
        """Follow the system clock; return by how much time stepped, nanoseconds, 0 if it did not."""
        ...


def read_tai_ns() -> int:
    """Return TAI by the system clock, nanoseconds since 1970."""
    utc_ns = time.time_ns()
    kernel = getattr(time, "CLOCK_TAI", None)
    if kernel is not None:
        tai_ns = time.clock_gettime_ns(kernel)
        # A kernel whose offset is not set returns UTC.
        if tai_ns - utc_ns > _MIN_KERNEL_TAI_NS:
            return tai_ns
    return utc_ns + TAI_UTC_NS


def tai_from_utc_ns(utc_ns: int) -> int:
    """Return the TAI of a stamp in UTC, such as that of a driver's message, nanoseconds since 1970."""
    return utc_ns + TAI_UTC_NS


class LiveClock:
    """Time that is start_ns at the beginning and advances at a rate. Without start_ns it begins now.

    In slow motion (rate below 1) everything of a run is slow, its deadlines too: ages and displacements are those of the scene, and
    steps of the system clock change nothing. reference: the system clock; monotonic: a clock that never steps.
    """

    def __init__(
        self,
        start_ns: int | None = None,
        rate: float = 1.0,
        reference: Callable[[], int] = read_tai_ns,
        monotonic: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.rate, self._reference, self._monotonic = rate, reference, monotonic
        begin_ns, now_ns = monotonic(), reference()
        self.start_ns = now_ns if start_ns is None else start_ns
        # A start in the future, or in the past, is where the clock reads start_ns. One tuple, since other threads read it.
        self._mapping = (begin_ns + self.start_ns - now_ns, self.start_ns, rate - 1.0)

    def now_ns(self) -> int:
        """Return the time, nanoseconds; before the start, an earlier one."""
        return self._at(self._monotonic())

    def sleep(self, duration_ns: int) -> None:
        """Sleep for a duration of this clock."""
        if duration_ns > 0:
            time.sleep(duration_ns / NS_PER_S / self.rate)

    def discipline(self) -> int:
        """Follow the system clock; return by how much time stepped, nanoseconds, 0 if it did not."""
        if self.rate != 1.0:
            return 0
        for _ in range(_NUM_READINGS):
            before_ns, reference_ns, after_ns = self._monotonic(), self._reference(), self._monotonic()
            # Where the process was interrupted between the readings, their difference is no measure.
            if after_ns - before_ns <= _MAX_READING_NS:
                return self._follow((before_ns + after_ns) // 2, reference_ns)
        return 0

    def _follow(self, monotonic_ns: int, reference_ns: int) -> int:
        own_ns = self._at(monotonic_ns)
        error_ns = reference_ns - own_ns
        if abs(error_ns) > MIN_STEP_NS:
            self._mapping = (monotonic_ns, reference_ns, 0.0)
            return error_ns
        slew = max(-MAX_SLEW, min(MAX_SLEW, error_ns / NS_PER_S))
        self._mapping = (monotonic_ns, own_ns, slew)
        return 0

    def _at(self, monotonic_ns: int) -> int:
        begin_ns, start_ns, excess = self._mapping
        elapsed_ns = monotonic_ns - begin_ns
        return start_ns + elapsed_ns + round(elapsed_ns * excess)
