# SPDX-License-Identifier: Apache-2.0
"""Structured log of a live run: one JSON object a line, with fixed names of events, at most MAX_LINES_PER_S of each."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import IO, Any, Literal

from manyeyes.runtime.clock import NS_PER_S
from manyeyes.runtime.live import LiveTick

EventName = Literal[
    "start", "stop", "clock_step", "trust_file", "recording_stopped", "level", "missed", "refused", "neighbours", "tick"
]
MAX_LINES_PER_S = 10
REFUSED_PERIOD_NS = NS_PER_S
_NOTES: dict[str, EventName] = {
    "clock_step": "clock_step",
    "the trust file": "trust_file",
    "recording stopped": "recording_stopped",
}


class EventLog:
    """Writes events of one agent. clock: of the run; monotonic: of the machine, nanoseconds both.

    Beyond MAX_LINES_PER_S lines of one event within a second, lines are left out; the next line of the event has their number.
    """

    def __init__(
        self, stream: IO[str], agent_id: int, clock: Callable[[], int], monotonic: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._stream, self._agent_id, self._clock, self._monotonic = stream, agent_id, clock, monotonic
        self._seconds: dict[str, tuple[int, int]] = {}
        self._left_out: dict[str, int] = {}
        self._level, self._neighbours, self._refused_ns, self._refused = 0, frozenset[str](), 0, dict[str, int]()

    def write(self, event: EventName, **values: Any) -> None:
        """Write one event with its values."""
        monotonic_ns = self._monotonic()
        second, count = self._seconds.get(event, (-1, 0))
        count = count + 1 if second == monotonic_ns // NS_PER_S else 1
        self._seconds[event] = monotonic_ns // NS_PER_S, count
        if count > MAX_LINES_PER_S:
            self._left_out[event] = self._left_out.get(event, 0) + 1
            return
        left_out = self._left_out.pop(event, 0)
        line = {
            "event": event,
            "agent": self._agent_id,
            "tai_ns": self._clock(),
            "monotonic_ns": monotonic_ns,
            **values,
        }
        self._stream.write(json.dumps(line | ({"left_out": left_out} if left_out else {})) + "\n")
        self._stream.flush()

    def add(self, tick: LiveTick, neighbours: frozenset[str]) -> None:
        """Write what is new in a tick."""
        for begin, event in _NOTES.items():
            if tick.note.startswith(begin):
                self.write(event, text=tick.note)
        if tick.missed:
            self.write("missed", latency_ms=tick.latency_ns / 1e6, level=tick.level)
        if tick.level != self._level:
            self.write("level", level=tick.level, before=self._level)
            self._level = tick.level
        if neighbours != self._neighbours:
            new, gone = sorted(neighbours - self._neighbours), sorted(self._neighbours - neighbours)
            self.write("neighbours", new=new, gone=gone)
            self._neighbours = neighbours
        refused = {name: count for name, count in asdict(tick.dropped).items() if count}
        now_ns = self._monotonic()
        if refused != self._refused and now_ns - self._refused_ns >= REFUSED_PERIOD_NS:
            self.write("refused", **{name: count - self._refused.get(name, 0) for name, count in refused.items()})
            self._refused, self._refused_ns = refused, now_ns
