# SPDX-License-Identifier: Apache-2.0
"""Methods on a recording: every scenario replayed, matched and counted, in any number of processes with one result."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, groupby, islice
from pathlib import Path

import torch

from manyeyes.agents.replay import ReplayConfig, Step, Views, replay
from manyeyes.datasets.base import Recording
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.detection.accumulator import MethodResult, Tally
from manyeyes.evaluation.detection.average_precision import Protocol, protocol_named
from manyeyes.evaluation.detection.recording_filters import EveryKth, KeptSnapshots, NearestAgents
from manyeyes.models import pretrained
from manyeyes.models.detector.detector import Detector

TOGETHER = 8
"""Conditions that are played side by side: more of them see each sweep once, fewer of them are lost when a study is stopped."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is compared, and how it is judged. weights: a name or a path. protocol: by name, over the detector's own range.

    every: judge each so many-th frame. agents: the nearest so many, in scenarios that have them; None: all of all scenarios.
    """

    weights: str = pretrained.DEFAULT
    methods: tuple[str, ...] = ("alone", "late", "intermediate", "early")
    protocol: str = "manyeyes"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    noise: PoseNoise | None = None
    every: int = 1
    agents: int | None = None

    def view(self, recording: Recording) -> Recording:
        """What is judged of a recording."""
        seen = recording if self.agents is None else NearestAgents(recording, self.agents)
        return seen if self.every == 1 else EveryKth(seen, self.every)


def judging_protocol(config: BenchmarkConfig) -> Protocol:
    """The named protocol; our own one judges over the range that the detector answers for."""
    protocol, grid = protocol_named(config.protocol), loaded(config.weights).config.range
    if config.protocol != "manyeyes":
        return protocol
    return protocol.within((grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max))


def loaded(weights: str) -> Detector:
    """The weights of that name or path, read once by each process for as long as the file stays as it is."""
    path = Path(weights)
    return _load(weights, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _load(weights: str, changed_ns: int) -> Detector:
    return pretrained.load(weights)


def run_scenario(
    open_recording: Callable[[], Recording], configs: Sequence[BenchmarkConfig], scenario: str
) -> list[list[Tally]]:
    """All methods of each configuration on one scenario; a function of its arguments alone.

    The configurations have the same weights, view and history: each sweep is read and looked at once between them.
    """
    torch.set_num_threads(1)
    first = configs[0]
    detector, known = loaded(first.weights), {}
    apart = 2 * first.every + first.replay.history + 1
    recording = KeptSnapshots(first.view(open_recording()), apart)
    tallies = [{name: Tally(name, judging_protocol(config)) for name in config.methods} for config in configs]
    plays = [_instants(recording, scenario, detector, config, known) for config in configs]
    for instants in zip(*plays):
        for (_, steps), counts in zip(instants, tallies):
            for step in steps:
                counts[step.method].add(step)
    return [list(counts.values()) for counts in tallies]


def _instants(
    recording: Recording, scenario: str, detector: Detector, config: BenchmarkConfig, known: Views
) -> Iterator[tuple[int, Iterator[Step]]]:
    """The steps of one configuration, judged snapshot by judged snapshot."""
    disturb = partial(_disturb, config.noise)
    steps = replay(recording, scenario, detector, config.methods, config.replay, disturb, known)
    return groupby(steps, lambda step: step.snapshot.index)


def _disturb(noise: PoseNoise | None, snapshot: Snapshot) -> Snapshot:
    return noise.apply(snapshot, 0) if noise else snapshot


def played(
    open_recording: Callable[[], Recording],
    configs: Sequence[BenchmarkConfig],
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Generator[tuple[Tally, ...]]:
    """The tallies of each configuration in turn, as soon as they are there.

    open_recording must be picklable when workers > 1; results do not depend on workers. progress counts scenarios played by
    a configuration.
    """
    recording, groups = open_recording(), _together(configs)
    jobs = [(group, name) for group in groups for name in group[0].view(recording).scenarios]
    work, total = partial(_job, open_recording), sum(len(group) for group, _ in jobs)

    def report(done: int) -> None:
        progress(done, total)

    if workers == 1:
        yield from _gathered(map(work, jobs), groups, jobs, report)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from _gathered(pool.imap(work, jobs), groups, jobs, report)


def _together(configs: Sequence[BenchmarkConfig]) -> list[tuple[BenchmarkConfig, ...]]:
    """Neighbours that can be played together, at most TOGETHER of them: what is finished is handed out group by group."""
    alike = groupby(configs, lambda c: (c.weights, c.every, c.agents, c.replay.history))
    runs = [tuple(run) for _, run in alike]
    return [run[k : k + TOGETHER] for run in runs for k in range(0, len(run), TOGETHER)]


def _job(open_recording: Callable[[], Recording], job: tuple[tuple[BenchmarkConfig, ...], str]) -> bytes:
    """As bytes: between processes, torch would hand over every tensor as an open file, and a study has more than may be open."""
    return pickle.dumps(run_scenario(open_recording, *job))


def _gathered(
    found: Iterable[bytes],
    groups: Sequence[tuple[BenchmarkConfig, ...]],
    jobs: Sequence[tuple[tuple[BenchmarkConfig, ...], str]],
    progress: Callable[[int], None],
) -> Generator[tuple[Tally, ...]]:
    """The tallies of jobs, added up over the scenarios of each group."""
    results, done = iter(found), 0
    for group in groups:
        whole = [[Tally(name, judging_protocol(config)) for name in config.methods] for config in group]
        for played_one in islice(results, sum(of is group for of, _ in jobs)):
            for all_of_it, one in zip(chain(*whole), chain(*pickle.loads(played_one))):
                all_of_it.extend(one)
            done += len(group)
            progress(done)
        yield from map(tuple, whole)


def benchmark(
    open_recording: Callable[[], Recording],
    config: BenchmarkConfig,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[MethodResult, ...]:
    """Every method on every scenario. open_recording must be picklable when workers > 1; results do not depend on workers."""
    with closing(played(open_recording, [config], workers, progress)) as tallies:
        return tuple(tally.result() for tally in next(tallies))
