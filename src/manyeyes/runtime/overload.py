# SPDX-License-Identifier: Apache-2.0
"""Overload ladder: a loop that misses its deadlines does less, instead of falling behind."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

MAX_LEVEL = 4
"""0: everything. 1: poses are corrected in every second frame. 2: half the byte budget, at most 4 senders. 3: boxes alone (late
fusion). 4: no fusion, nothing is sent."""
MISSES_UP, WINDOW_UP, TIMELY_DOWN = 3, 10, 30


@dataclass
class OverloadLadder:
    """One level up after MISSES_UP misses among the last WINDOW_UP frames, one down after TIMELY_DOWN timely frames in a row."""

    level: int = 0

    def __post_init__(self) -> None:
        self._missed: deque[bool] = deque(maxlen=WINDOW_UP)
        self._timely = 0

    def update(self, missed: bool) -> int:
        """Record whether a frame missed its deadline; return the level of the next one."""
        self._missed.append(missed)
        self._timely = 0 if missed else self._timely + 1
        if sum(self._missed) >= MISSES_UP and self.level < MAX_LEVEL:
            self.level += 1
            self._missed.clear()
        elif self._timely >= TIMELY_DOWN and self.level > 0:
            self.level -= 1
            self._timely = 0
        return self.level
