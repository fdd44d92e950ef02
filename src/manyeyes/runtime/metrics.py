# SPDX-License-Identifier: Apache-2.0
"""Metrics of a live agent for Prometheus (https://prometheus.io), and its health. No label names a sender: ids are claims."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from manyeyes.datatypes.extras import import_extra
from manyeyes.runtime.live import LiveTick

MAX_TICK_AGE_S = 0.5
"""An agent without a tick for longer is not healthy."""
_SECONDS = (0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
_TRUST = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
_STATM = Path("/proc/self/statm")


class LiveMetrics:
    """Metrics of the ticks of one run. rate: of its clock; monotonic: seconds.

    Raises:
        MissingExtraError: prometheus_client is not installed.
    """

    def __init__(self, rate: float = 1.0, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._client = import_extra("prometheus_client", "metrics", "Serving metrics")
        self._core = import_extra("prometheus_client.core", "metrics", "Serving metrics")
        self._rate, self._monotonic = rate, monotonic
        self._tick: LiveTick | None = None
        self._tick_s, self._neighbours = -1.0, 0
        self._totals = dict.fromkeys(("frames", "missed", "sent_packets", "sent_bytes", "clock_steps"), 0)
        self.registry = self._client.CollectorRegistry()
        histogram = self._client.Histogram
        self._age = histogram(
            "manyeyes_age_seconds",
            "Age of fused messages when the boxes are there",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._stages = histogram(
            "manyeyes_stage_seconds", "Time of a stage of a frame", ("stage",), buckets=_SECONDS, registry=self.registry
        )
        self._trust = histogram(
            "manyeyes_sender_trust", "Trust of received senders, each frame", buckets=_TRUST, registry=self.registry
        )
        self.registry.register(self)

    def add(self, tick: LiveTick, num_neighbours: int) -> None:
        """Count one tick with its packets and neighbours."""
        self._tick, self._tick_s, self._neighbours = tick, self._monotonic(), num_neighbours
        new = (1, int(tick.missed), tick.sent_packets, tick.sent_bytes, int(tick.note.startswith("clock_step")))
        self._totals = {name: total + more for (name, total), more in zip(self._totals.items(), new)}
        for age_ns in tick.ages_ns:
            self._age.observe(age_ns / 1e9)
        for stage in ("share", "wait", "perceive", "latency"):
            self._stages.labels(stage).observe(getattr(tick, f"{stage}_ns") / 1e9)
        assessment = tick.perception.assessment
        for sender in () if assessment is None else assessment.senders:
            self._trust.observe(sender.trust)

    def collect(self) -> Iterator[Any]:
        """Yield counters and gauges, as a collector of prometheus_client."""
        counter, gauge, tick = self._core.CounterMetricFamily, self._core.GaugeMetricFamily, self._tick
        for name, total in self._totals.items():
            yield counter(f"manyeyes_{name}", f"Number of {name.replace('_', ' ')}", value=total)
        values = {
            "neighbours": ("Links from which something arrived within a second", self._neighbours),
            "resident_bytes": ("Memory of the process", _resident_bytes()),
            "overload_level": ("Level of overload, 0 to 4", 0 if tick is None else tick.level),
            "fused_messages": ("Messages that the last frame fused", 0 if tick is None else len(tick.ages_ns)),
            "malicious_senders": (
                "Senders that the last frame named malicious",
                0 if tick is None else _malicious(tick),
            ),
            "clock_offset_seconds": (
                "Median clock of others less the own one",
                0.0 if tick is None else tick.clock_offset_ns / 1e9,
            ),
        }
        for name, (text, value) in values.items():
            yield gauge(f"manyeyes_{name}", text, value=value)
        if tick is None:
            return
        yield counter("manyeyes_skipped_frames", "Frames of the source that were skipped", value=tick.skipped)
        yield counter(
            "manyeyes_overflows", "Received packets that gave way before they were read", value=tick.overflows
        )
        yield counter("manyeyes_received_packets", "Received packets", value=tick.received_packets)
        yield counter("manyeyes_received_bytes", "Bytes of received packets", value=tick.received_bytes)
        refused = counter("manyeyes_refused_packets", "Received packets that were refused", labels=("reason",))
        for reason, count in asdict(tick.dropped).items():
            refused.add_metric((reason,), count)
        yield refused
        rejected = gauge("manyeyes_rejected_senders", "Senders rejected in the last frame", labels=("reason",))
        reasons = [one.reason for one in tick.perception.rejected]
        for reason in sorted(set(reasons)):
            rejected.add_metric((reason,), reasons.count(reason))
        yield rejected

    def text(self) -> bytes:
        """Return all metrics in the text format of Prometheus."""
        return self._client.generate_latest(self.registry)

    def fault(self) -> str:
        """Return why the agent is not healthy; empty where it is."""
        if self._tick is None:
            return "no frame yet"
        age_s = (self._monotonic() - self._tick_s) * self._rate
        if age_s > MAX_TICK_AGE_S:
            return f"the last frame is {age_s:.1f} s old"
        return "" if not self._tick.unsynchronised else "the clock stepped less than a second ago"


def _malicious(tick: LiveTick) -> int:
    assessment = tick.perception.assessment
    return 0 if assessment is None else sum(sender.status.name == "MALICIOUS" for sender in assessment.senders)


def _resident_bytes() -> int:
    """Return the memory of this process; 0 where the system does not state it."""
    try:
        return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
