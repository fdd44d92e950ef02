# SPDX-License-Identifier: Apache-2.0
"""Methods on a recording: every scenario replayed, matched and counted, in any number of processes with one result."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

import torch

from manyeyes.agents.replay import ReplayConfig, replay
from manyeyes.datasets.disturb import PoseNoise
from manyeyes.datasets.recording import Recording
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.detection import Protocol, protocol_named
from manyeyes.evaluation.tally import MethodResult, Tally
from manyeyes.models import zoo


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is compared, and how it is judged. weights: a name or a path. protocol: by name, over the detector's own range."""

    weights: str = zoo.DEFAULT
    methods: tuple[str, ...] = ("alone", "late", "intermediate", "early")
    protocol: str = "manyeyes"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    noise: PoseNoise | None = None


def judging_protocol(config: BenchmarkConfig) -> Protocol:
    """The named protocol; our own one judges over the range that the detector answers for."""
    protocol, grid = protocol_named(config.protocol), zoo.load(config.weights).config.range
    if config.protocol != "manyeyes":
        return protocol
    return protocol.within((grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max))


def run_scenario(open_recording: Callable[[], Recording], config: BenchmarkConfig, scenario: str) -> list[Tally]:
    """All methods on one scenario; a function of its arguments alone."""
    torch.set_num_threads(1)
    detector, protocol = zoo.load(config.weights), judging_protocol(config)
    tallies = {name: Tally(name, protocol) for name in config.methods}
    disturb = partial(_disturb, config.noise)
    recording = open_recording()
    for step in replay(recording, scenario, detector, config.methods, config.replay, disturb, share_eyes=True):
        tallies[step.method].add(step)
    return list(tallies.values())


def _disturb(noise: PoseNoise | None, snapshot: Snapshot) -> Snapshot:
    return noise.apply(snapshot, 0) if noise else snapshot


def benchmark(
    open_recording: Callable[[], Recording],
    config: BenchmarkConfig,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[MethodResult, ...]:
    """Every method on every scenario. open_recording must be picklable when workers > 1; results do not depend on workers."""
    scenarios = open_recording().scenarios
    work = partial(run_scenario, open_recording, config)
    if workers == 1:
        return _gather(map(work, scenarios), len(scenarios), config, progress)
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        return _gather(pool.imap(work, scenarios), len(scenarios), config, progress)


def _gather(
    found: Iterable[list[Tally]], total: int, config: BenchmarkConfig, progress: Callable[[int, int], None]
) -> tuple[MethodResult, ...]:
    whole = [Tally(name, judging_protocol(config)) for name in config.methods]
    for done, tallies in enumerate(found, 1):
        for all_of_it, one in zip(whole, tallies):
            all_of_it.extend(one)
        progress(done, total)
    return tuple(tally.result() for tally in whole)
