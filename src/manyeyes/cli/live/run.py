# SPDX-License-Identifier: Apache-2.0
"""Run one agent on a network, in real time: its frames are those of a recording, played as they were taken, or of a function.

Ctrl-C or SIGTERM end the run after the current frame; files are finished.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes._bounds import AgentId, DurationMs, OutputFile, PlaybackRate, PositiveInt, WorkerCount
from manyeyes.cli.live.options import MethodOptions, NetworkOptions, SecurityOptions

if TYPE_CHECKING:
    from manyeyes.datatypes import AgentFrame
    from manyeyes.runtime.clock import LiveClock
    from manyeyes.runtime.live import LiveRun
    from manyeyes.runtime.recorder import RunConfig
    from manyeyes.runtime.summary import RunSummary


@dataclass(frozen=True)
class Options:
    """Which agent of which drive."""

    recording: tyro.conf.Positional[Path | None] = None
    """A data set, a folder of scenarios, or one scenario, in the layout of any reader."""
    source: str | None = None
    """In place of a recording, module:function of your own; called with the agent's id and the clock (a function that returns TAI,
    ns since 1970), it yields AgentFrames whose timestamp_ns are of that clock."""
    agent: AgentId = 0
    """Id of the agent in the recording."""
    split: str | None = None
    """Which split of a data set, such as test."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: PositiveInt | None = None
    """At most so many instants."""
    start: str | None = None
    """When the drive begins: a time of today such as 18:05:00, or a date and time, local if it states no zone. Agents with one
    start play one scene together; a late one joins in the middle. By default each begins at once."""
    rate: PlaybackRate = 1.0
    """Speed of the clock; below 1 everything is slow, deadlines too, for machines that several agents share: give them one
    --start."""
    perceive_after_ms: DurationMs = 70.0
    """How long after the sweep the agent waits for messages; it perceives earlier where all are complete."""
    deadline_ms: DurationMs = 100.0
    """Boxes that come later after the sweep are counted as missed; misses reduce the work."""
    threads: WorkerCount = 1
    """Threads of torch."""
    record: OutputFile | None = None
    """Record the run to this file (.mcap): 'manyeyes live replay' computes it again."""
    out: OutputFile | None = None
    """Write the summary as JSON."""
    metrics: str | None = None
    """Serve /metrics (Prometheus) and /healthz at this address, such as 127.0.0.1:9464."""
    json_log: bool = False
    """Write events as JSON lines to the standard error."""
    await_start: bool = False
    """Print "ready" and the seconds of a frame, then read the time of the start (TAI, ns since 1970) and the rate."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
    """The network."""
    security: SecurityOptions = field(default_factory=SecurityOptions)
    """Signatures."""
    method: MethodOptions = field(default_factory=MethodOptions)
    """What is sent and fused."""


def main(options: Options) -> None:
    """Run the agent to the end of the drive, or until it is stopped."""
    import torch
    from rich.console import Console

    from manyeyes.cli.live.options import make_agent
    from manyeyes.cli.live.start import parse_start
    from manyeyes.cli.live.table import print_summaries, save_summary
    from manyeyes.models import pretrained
    from manyeyes.runtime.live import LiveConfig, LiveRun
    from manyeyes.runtime.recorder import Recorder

    torch.set_num_threads(options.threads)
    start_ns = None if options.start is None else parse_start(options.start)
    security = options.security.load(options.agent)
    first, start_frames = _open_frames(options)
    config = options.method.describe(pretrained.load(options.method.weights).fingerprint, security.mode)
    deadlines = LiveConfig(round(options.perceive_after_ms * 1e6), round(options.deadline_ms * 1e6))
    agent = make_agent(config)
    clock = _wait_for_start(options, config, first, start_ns)
    frames = start_frames(clock)
    network = options.network.open(options.agent, clock.now_ns)
    try:
        x, y, _ = first.world_from_agent.translation.tolist()
        network.join((x, y))
        recorder = None if options.record is None else Recorder(options.record, config)
        run = LiveRun(frames, agent, network, clock, deadlines, security, recorder)
        summary = _collect(run, options, clock)
    finally:
        network.close()
    if options.out is not None:
        save_summary(options.out, summary)
    print_summaries((summary,), Console())


def _open_frames(options: Options) -> tuple[AgentFrame, Callable[[LiveClock], Iterator[AgentFrame]]]:
    """Return the first frame, and a function that starts the frames by a clock."""
    from manyeyes.datatypes import ConfigError

    if (options.recording is None) == (options.source is None):
        raise ConfigError("Give a recording, or --source module:function, and not both.")
    if options.source is not None:
        return _open_source(options, options.source)
    from manyeyes.datasets.registry import open_recording
    from manyeyes.runtime.sources import play_recording
    from manyeyes.studies.replay_options import make_excerpt

    assert options.recording is not None
    recording = open_recording(options.recording, options.split)
    scenario = make_excerpt(recording, options.scenario).scenario
    first = next(play_recording(recording, scenario, options.agent, 0, 1))
    return first, lambda clock: play_recording(recording, scenario, options.agent, clock.start_ns, options.frames)


def _open_source(options: Options, source: str) -> tuple[AgentFrame, Callable[[LiveClock], Iterator[AgentFrame]]]:
    """Do the same with a function of the user's own, which is called once."""
    from manyeyes.datatypes import AgentFrame, ConfigError
    from manyeyes.runtime.clock import read_tai_ns
    from manyeyes.runtime.sources import DeferredClock, load_source

    deferred = DeferredClock(read_tai_ns)
    frames = iter(load_source(source)(options.agent, deferred))
    first = next(frames, None)
    if not isinstance(first, AgentFrame):
        raise ConfigError(f"Source {source} must yield AgentFrames; the first is {type(first).__name__}.")

    def start(clock: LiveClock) -> Iterator[AgentFrame]:
        deferred.now_ns = clock.now_ns
        return islice(frames, options.frames)

    return first, start


def _wait_for_start(options: Options, config: RunConfig, first: AgentFrame, start_ns: int | None) -> LiveClock:
    """Warm up with the first frame, and return the clock, whose start is when the others start too."""
    from manyeyes.cli.live.options import make_agent
    from manyeyes.cli.live.start import announce_ready

    took, probe = 0.0, make_agent(config)
    # The first frames compile and allocate; in each, a local map is due.
    for number in range(3):
        frame = replace(first, timestamp_ns=first.timestamp_ns + number * 100 * 10**9)
        began = time.process_time()
        probe.perceive(frame, probe.share(frame))
        took = time.process_time() - began
    return announce_ready(options.await_start, took, options.rate, start_ns)


def _collect(run: LiveRun, options: Options, clock: LiveClock) -> RunSummary:
    """Run to the end; a signal ends it after the current frame, a second one at once."""
    from manyeyes.runtime.run_monitors import RunMonitors
    from manyeyes.runtime.summary import RunStatistics

    def stop(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        run.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    statistics, recorder = RunStatistics(options.agent, clock.rate), run.recorder
    with RunMonitors.open(options.agent, clock, options.metrics, sys.stderr if options.json_log else None) as monitors:
        for tick in run:
            statistics.add(tick)
            monitors.add(tick, run.neighbours())
    if recorder is None:
        return statistics.summary()
    note = recorder.close()
    return statistics.summary(0 if note else recorder.path.stat().st_size, (note,) if note else ())
