# SPDX-License-Identifier: Apache-2.0
"""Summary of a live run: bytes, ages of information, missed deadlines, refused packets by reason."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np

from manyeyes.comms.drop_counts import DropCounts
from manyeyes.runtime.live import LiveTick


@dataclass(frozen=True)
class Quantiles:
    """Quantiles in milliseconds; NaN of nothing."""

    p50_ms: float
    p95_ms: float
    p99_ms: float

    @classmethod
    def of(cls, values_ns: list[int]) -> Quantiles:
        """Return quantiles of durations in nanoseconds."""
        if not values_ns:
            return cls(float("nan"), float("nan"), float("nan"))
        return cls(*(round(float(value) / 1e6, 3) for value in np.quantile(values_ns, (0.5, 0.95, 0.99))))


@dataclass(frozen=True)
class RunSummary:
    """One agent's run. rate: of its clock; times are those of the clock. fused: messages that were fused, of all frames.

    level_frames: number of frames at each level of overload. dropped: refused packets by reason, without those of zero. overflows:
    packets that gave way in a bounded buffer. recording: bytes of the file, 0 without one.
    """

    agent_id: int
    rate: float
    frames: int
    skipped: int
    missed: int
    sent_bytes: int
    sent_packets: int
    fused: int
    age: Quantiles
    latency: Quantiles
    share: Quantiles
    wait: Quantiles
    perceive: Quantiles
    level_frames: tuple[int, ...]
    dropped: dict[str, int]
    overflows: int
    notes: tuple[str, ...] = ()
    recording: int = 0


@dataclass
class RunStatistics:
    """Collects the ticks of a run, numbers alone."""

    agent_id: int
    rate: float
    _columns: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in _COLUMNS})
    _levels: list[int] = field(default_factory=lambda: [0] * 5)
    _notes: list[str] = field(default_factory=list[str])
    _last: LiveTick | None = None
    _missed: int = 0
    _sent: tuple[int, int] = (0, 0)

    def add(self, tick: LiveTick) -> None:
        """Count one tick of the run."""
        values = (tick.ages_ns, (tick.latency_ns,), (tick.share_ns,), (tick.wait_ns,), (tick.perceive_ns,))
        for column, new in zip(self._columns.values(), values):
            column += new
        self._levels[tick.level] += 1
        self._missed += tick.missed
        self._sent = self._sent[0] + tick.sent_bytes, self._sent[1] + tick.sent_packets
        self._notes += [tick.note] if tick.note else []
        self._last = tick

    def summary(self, recording_bytes: int = 0, notes: tuple[str, ...] = ()) -> RunSummary:
        """Return the summary so far."""
        last = self._last
        dropped = DropCounts() if last is None else last.dropped
        ages, latency, share, wait, perceive = (Quantiles.of(column) for column in self._columns.values())
        return RunSummary(
            self.agent_id,
            self.rate,
            sum(self._levels),
            0 if last is None else last.skipped,
            self._missed,
            *self._sent,
            len(self._columns["age"]),
            ages,
            latency,
            share,
            wait,
            perceive,
            tuple(self._levels),
            {name: count for name, count in asdict(dropped).items() if count},
            0 if last is None else last.overflows,
            (*self._notes, *notes),
            recording_bytes,
        )


_COLUMNS = ("age", "latency", "share", "wait", "perceive")
