# SPDX-License-Identifier: Apache-2.0
"""Methods on a recording: every scenario replayed, matched and counted, in any number of processes with one result."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch

from manyeyes.agents.replay import ReplayConfig, Step, replay
from manyeyes.datasets.disturb import PoseNoise
from manyeyes.datasets.recording import Recording
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.bootstrap import Interval, paired_difference, scenario_interval
from manyeyes.evaluation.communication import Communication, MessageRecord, summarise
from manyeyes.evaluation.detection import (
    ApResult,
    FrameMatch,
    FrameResult,
    Protocol,
    ap_of_matches,
    ego_truth,
    match_frame,
    overlap_frame,
    protocol_named,
)
from manyeyes.models import zoo

IOUS = (0.5, 0.7)


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is compared, and how it is judged. weights: a name or a path. protocol: by name, over the detector's own range."""

    weights: str = zoo.DEFAULT
    methods: tuple[str, ...] = ("alone", "late", "intermediate", "early")
    protocol: str = "manyeyes"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    noise: PoseNoise | None = None


@dataclass(frozen=True)
class ScenarioResult:
    """One method on one scenario. matches: one list of frames an IoU threshold, in the order of IOUS."""

    scenario: str
    method: str
    matches: tuple[tuple[FrameMatch, ...], ...]
    messages: tuple[MessageRecord, ...]
    ages_s: tuple[float, ...]
    share_seconds: tuple[float, ...]
    perceive_seconds: tuple[float, ...]


@dataclass(frozen=True)
class MethodResult:
    """One method over all scenarios. ap and intervals: one an IoU threshold, in the order of IOUS."""

    method: str
    ap: tuple[ApResult, ...]
    intervals: tuple[Interval, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float

    def less(self, other: MethodResult, iou: int, protocol: Protocol) -> Interval:
        """AP of this method minus that of another, paired over scenarios. iou: index into IOUS."""
        return paired_difference(self.ap[iou].frames, other.ap[iou].frames, protocol=protocol)


def judging_protocol(config: BenchmarkConfig) -> Protocol:
    """The named protocol; our own one judges over the range that the detector sees."""
    protocol, grid = protocol_named(config.protocol), zoo.load(config.weights).config.grid
    if config.protocol != "manyeyes":
        return protocol
    return protocol.within((grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max))


def run_scenario(
    open_recording: Callable[[], Recording], config: BenchmarkConfig, scenario: str
) -> list[ScenarioResult]:
    """All methods on one scenario; a function of its arguments alone."""
    torch.set_num_threads(1)
    detector, protocol = zoo.load(config.weights), judging_protocol(config)
    recording = open_recording()
    found: dict[str, list[Step]] = {name: [] for name in config.methods}
    matches: dict[str, list[tuple[FrameMatch, ...]]] = {name: [] for name in config.methods}
    for step in replay(
        recording, scenario, detector, config.methods, config.replay, partial(_disturb, config.noise), share_eyes=True
    ):
        truth = ego_truth(step.snapshot, step.ego, protocol)
        index = step.snapshot.index * 100 + step.ego if config.replay.all_egos else step.snapshot.index
        overlap = overlap_frame(FrameResult(scenario, index, step.boxes, truth), protocol)
        matches[step.method].append(tuple(match_frame(overlap, iou, protocol) for iou in IOUS))
        found[step.method].append(step)
    return [_scenario_result(scenario, name, found[name], matches[name], detector.channels) for name in config.methods]


def _disturb(noise: PoseNoise | None, snapshot: Snapshot) -> Snapshot:
    return noise.apply(snapshot, 0) if noise else snapshot


def _scenario_result(
    scenario: str, name: str, steps: Sequence[Step], matches: Sequence[tuple[FrameMatch, ...]], channels: int
) -> ScenarioResult:
    messages = []
    for step in steps:
        ego = step.snapshot.frames[step.ego].agent_id
        tokens = {
            h.message.agent_id: len(h.message.tokens.sites)
            for h in step.perception.heard
            if h.message.tokens is not None
        }
        messages += [
            MessageRecord(
                scenario, step.snapshot.index, s.agent_id, s.bytes, tokens.get(s.agent_id, 0), channels, ego=ego
            )
            for s in step.sent
            if s.agent_id != ego and s.packets
        ]
    return ScenarioResult(
        scenario,
        name,
        tuple(zip(*matches)) if matches else tuple(() for _ in IOUS),
        tuple(messages),
        tuple(age for step in steps for age in step.ages_s),
        tuple(s.seconds for step in steps for s in step.sent),
        tuple(step.perceive_seconds for step in steps),
    )


def benchmark(
    open_recording: Callable[[], Recording],
    config: BenchmarkConfig,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[MethodResult, ...]:
    """Every method on every scenario. open_recording must be picklable when workers > 1; results do not depend on workers."""
    scenarios = open_recording().scenarios
    work = partial(run_scenario, open_recording, config)
    results: list[list[ScenarioResult]] = []
    if workers > 1:
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            for result in pool.imap(work, scenarios):
                results.append(result)
                progress(len(results), len(scenarios))
    else:
        for scenario in scenarios:
            results.append(work(scenario))
            progress(len(results), len(scenarios))
    protocol = judging_protocol(config)
    return tuple(_method_result([r[i] for r in results], protocol) for i in range(len(config.methods)))


def _method_result(results: Sequence[ScenarioResult], protocol: Protocol) -> MethodResult:
    frames = [[m for r in results for m in r.matches[i]] for i in range(len(IOUS))]
    messages = [m for r in results for m in r.messages]
    return MethodResult(
        results[0].method,
        tuple(ap_of_matches(f, protocol) for f in frames),
        tuple(scenario_interval(f, protocol=protocol) for f in frames),
        summarise(messages, sum(len(r.perceive_seconds) for r in results)),
        _mean_ms([v for r in results for v in r.ages_s]),
        _mean_ms([v for r in results for v in r.share_seconds]),
        _mean_ms([v for r in results for v in r.perceive_seconds]),
    )


def _mean_ms(seconds: Sequence[float]) -> float:
    return 1000 * sum(seconds) / len(seconds) if seconds else float("nan")
