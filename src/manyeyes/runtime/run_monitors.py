# SPDX-License-Identifier: Apache-2.0
"""What watches a run from outside: metrics, log, and the supervisor of a service. They change nothing of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from manyeyes.runtime.clock import LiveClock
from manyeyes.runtime.event_log import EventLog
from manyeyes.runtime.live import LiveTick
from manyeyes.runtime.metrics import LiveMetrics
from manyeyes.runtime.status_server import StatusServer
from manyeyes.runtime.supervisor import Supervisor


class RunMonitors:
    """Metrics and log of a run, each None where it is not wanted."""

    def __init__(self, metrics: LiveMetrics | None = None, log: EventLog | None = None) -> None:
        self._metrics, self._log, self._supervisor = metrics, log, Supervisor()

    @classmethod
    @contextmanager
    def open(
        cls, agent_id: int, clock: LiveClock, address: str | None = None, log_stream: IO[str] | None = None
    ) -> Iterator[RunMonitors]:
        """Serve metrics at an address and log to a stream until the end of the block."""
        metrics = None if address is None else LiveMetrics(clock.rate)
        server = None if address is None or metrics is None else StatusServer(address, metrics)
        log = None if log_stream is None else EventLog(log_stream, agent_id, clock.now_ns)
        try:
            if log is not None:
                log.write("start", rate=clock.rate)
            monitors = cls(metrics, log)
            yield monitors
            monitors._supervisor.stop()
            if log is not None:
                log.write("stop")
        finally:
            if server is not None:
                server.close()

    def add(self, tick: LiveTick, neighbours: frozenset[str]) -> None:
        """Give a tick to all monitors."""
        self._supervisor.tick()
        if self._metrics is not None:
            self._metrics.add(tick, len(neighbours))
        if self._log is not None:
            self._log.add(tick, neighbours)
