# SPDX-License-Identifier: Apache-2.0
"""Run one agent on a network, in real time: its frames are those of a recording, played as they were taken.

Ctrl-C or SIGTERM end the run after the current frame; files are finished.
"""

from __future__ import annotations

import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manyeyes._bounds import AgentId, DurationMs, OutputFile, PlaybackRate, PositiveInt, WorkerCount
from manyeyes.cli.live.options import MethodOptions, NetworkOptions, SecurityOptions
from manyeyes.datatypes.errors import ConfigError

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent
    from manyeyes.datatypes import AgentFrame
    from manyeyes.runtime.clock import LiveClock
    from manyeyes.runtime.live import LiveRun
    from manyeyes.runtime.summary import RunSummary

READY = "ready"
START_DELAY_NS = 200_000_000


@dataclass(frozen=True)
class Options:
    """Which agent of which drive."""

    recording: tyro.conf.Positional[Path]
    """A data set, a folder of scenarios, or one scenario, in the layout of any reader."""
    agent: AgentId = 0
    """Id of the agent in the recording."""
    split: str | None = None
    """Which split of a data set, such as test."""
    scenario: str | None = None
    """Which scenario; the first by default."""
    frames: PositiveInt | None = None
    """At most so many instants of it."""
    rate: PlaybackRate = 1.0
    """Speed of the clock; below 1 everything is slow, deadlines too, for machines that several agents share."""
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
    from manyeyes.cli.live.table import print_summaries, save_summary
    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import pretrained
    from manyeyes.runtime.live import LiveConfig, LiveRun
    from manyeyes.runtime.recorder import Recorder
    from manyeyes.runtime.sources import play_recording
    from manyeyes.studies.replay_options import make_excerpt

    torch.set_num_threads(options.threads)
    security = options.security.load(options.agent)
    recording = open_recording(options.recording, options.split)
    scenario = make_excerpt(recording, options.scenario).scenario
    config = options.method.describe(pretrained.load(options.method.weights).fingerprint, security.mode)
    deadlines = LiveConfig(round(options.perceive_after_ms * 1e6), round(options.deadline_ms * 1e6))
    agent = make_agent(config)
    first = next(play_recording(recording, scenario, options.agent, 0, 1))
    clock = _wait_for_start(options, agent, first)
    frames = play_recording(recording, scenario, options.agent, clock.start_ns, options.frames)
    network = options.network.open(options.agent, clock.now_ns)
    try:
        x, y, _ = first.world_from_agent.translation.tolist()
        network.join((x, y))
        recorder = None if options.record is None else Recorder(options.record, config)
        summary = _collect(LiveRun(frames, agent, network, clock, deadlines, security, recorder), options.agent, clock)
    finally:
        network.close()
    if options.out is not None:
        save_summary(options.out, summary)
    print_summaries((summary,), Console())


def _wait_for_start(options: Options, agent: Agent, first: AgentFrame) -> LiveClock:
    """Warm up with the first frame, and return the clock, whose start is when the others start too."""
    from manyeyes.agents.agent import Agent
    from manyeyes.runtime.clock import LiveClock, read_tai_ns

    took = 0.0
    # The first of two frames compiles and allocates.
    for _ in range(2):
        began = time.perf_counter()
        probe = Agent(agent.perception_cache.detector, agent.strategy, budget_bytes=agent.budget_bytes)
        probe.perceive(first, probe.share(first))
        took = time.perf_counter() - began
    if not options.await_start:
        return LiveClock(read_tai_ns() + START_DELAY_NS, options.rate)
    sys.stdout.write(f"{READY} {took:.4f}\n")
    sys.stdout.flush()
    words = sys.stdin.readline().split()
    if len(words) != 2:
        raise ConfigError("--await-start reads the time of the start and the rate from the input; the input ended.")
    start_ns, rate = words
    return LiveClock(int(start_ns), float(rate))


def _collect(run: LiveRun, agent_id: int, clock: LiveClock) -> RunSummary:
    """Run to the end; a signal ends it after the current frame, a second one at once."""
    from manyeyes.runtime.summary import RunStatistics

    def stop(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        run.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    statistics, recorder = RunStatistics(agent_id, clock.rate), run.recorder
    for tick in run:
        statistics.add(tick)
    if recorder is None:
        return statistics.summary()
    note = recorder.close()
    return statistics.summary(0 if note else recorder.path.stat().st_size, (note,) if note else ())
