# SPDX-License-Identifier: Apache-2.0
"""Methods on a recording: every scenario replayed, matched and counted, in any number of processes with one result."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path

import torch

from manyeyes.agents.replay import ReplayConfig, Views, replay
from manyeyes.datasets.disturb import PoseNoise
from manyeyes.datasets.recording import Recording
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.detection import Protocol, protocol_named
from manyeyes.evaluation.tally import MethodResult, Tally
from manyeyes.evaluation.views import EveryKth, NearestAgents
from manyeyes.models import zoo
from manyeyes.models.detector import Detector


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is compared, and how it is judged. weights: a name or a path. protocol: by name, over the detector's own range.

    every: judge each so many-th frame. agents: the nearest so many, in scenarios that have them; None: all of all scenarios.
    channel_bytes: what all agents of a scenario together may send at an instant, each an equal part of it, instead of
    replay.budget_bytes for each.
    """

    weights: str = zoo.DEFAULT
    methods: tuple[str, ...] = ("alone", "late", "intermediate", "early")
    protocol: str = "manyeyes"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    noise: PoseNoise | None = None
    every: int = 1
    agents: int | None = None
    channel_bytes: int | None = None

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
    return zoo.load(weights)


def run_scenario(open_recording: Callable[[], Recording], config: BenchmarkConfig, scenario: str) -> list[Tally]:
    """All methods on one scenario; a function of its arguments alone."""
    torch.set_num_threads(1)
    detector, protocol = loaded(config.weights), judging_protocol(config)
    tallies = {name: Tally(name, protocol) for name in config.methods}
    recording = config.view(open_recording())
    played = config.replay
    if config.channel_bytes is not None:
        played = replace(played, budget_bytes=config.channel_bytes // len(recording.agents(scenario)))
    disturb = partial(_disturb, config.noise)
    known = _views_of((detector.fingerprint, scenario, max(0, recording.judged(scenario).start - played.history)))
    for step in replay(recording, scenario, detector, config.methods, played, disturb, known):
        tallies[step.method].add(step)
    return list(tallies.values())


MOST_VIEWS = 12_000
"""Of all scenarios together, about 130 kB each, that a process keeps: conditions change what agents hear, never what they see."""
_kept: dict[tuple[bytes, str, int], Views] = {}


def _views_of(key: tuple[bytes, str, int]) -> Views:
    while _kept and sum(map(len, _kept.values())) > MOST_VIEWS:
        del _kept[next(iter(_kept))]
    return _kept.setdefault(key, {})


def _disturb(noise: PoseNoise | None, snapshot: Snapshot) -> Snapshot:
    return noise.apply(snapshot, 0) if noise else snapshot


def played(
    open_recording: Callable[[], Recording],
    configs: Sequence[BenchmarkConfig],
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Generator[tuple[Tally, ...]]:
    """The tallies of each configuration in turn, each as soon as its last scenario is played.

    open_recording must be picklable when workers > 1; results do not depend on workers. progress counts scenarios.
    """
    recording = open_recording()
    _kept.clear()
    scenarios = [config.view(recording).scenarios for config in configs]
    jobs = [(config, name) for config, names in zip(configs, scenarios) for name in names]
    work, counts = partial(_job, open_recording), list(map(len, scenarios))
    if workers == 1:
        yield from _gathered(map(work, jobs), configs, counts, progress)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from _gathered(pool.imap(work, jobs), configs, counts, progress)


def _job(open_recording: Callable[[], Recording], job: tuple[BenchmarkConfig, str]) -> list[Tally]:
    return run_scenario(open_recording, *job)


def _gathered(
    found: Iterable[list[Tally]],
    configs: Sequence[BenchmarkConfig],
    counts: Sequence[int],
    progress: Callable[[int, int], None],
) -> Generator[tuple[Tally, ...]]:
    """Tallies of scenarios, counts of them a configuration, added up."""
    results, done = iter(found), 0
    for config, count in zip(configs, counts):
        protocol = judging_protocol(config)
        whole = tuple(Tally(name, protocol) for name in config.methods)
        for tallies in islice(results, count):
            for all_of_it, one in zip(whole, tallies):
                all_of_it.extend(one)
            done += 1
            progress(done, sum(counts))
        yield whole


def benchmark(
    open_recording: Callable[[], Recording],
    config: BenchmarkConfig,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[MethodResult, ...]:
    """Every method on every scenario. open_recording must be picklable when workers > 1; results do not depend on workers."""
    with closing(played(open_recording, [config], workers, progress)) as tallies:
        return tuple(tally.result() for tally in next(tallies))
