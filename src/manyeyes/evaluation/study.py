# SPDX-License-Identifier: Apache-2.0
"""Sweeps: methods played in many conditions, every cell kept, so that a sweep that was stopped goes on where it was.

A cell is a method in a condition. Its file's name holds a digest of the whole configuration, of the weights, of the recording
and of the sources that its numbers follow from: a change of any of them makes the cell anew. Cells are judged over scenarios;
differences are paired: all cells are resampled alike, and the unit draws of noise, loss and jitter are the same at every level.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

from manyeyes._source import source_digest
from manyeyes.datasets.base import Recording
from manyeyes.evaluation.detection.average_precision import DetectionProtocol
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector, resolve_protocol, run_benchmarks
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval, bootstrap
from manyeyes.evaluation.study_result import SpeedRange, StudyResult, make_study_result, read_result, write_result
from manyeyes.models.checkpoint import fingerprint

COMPUTED_BY = "manyeyes.evaluation.detection.benchmark"
"""The module whose import closure the numbers of a cell follow from."""


@dataclass(frozen=True)
class Condition:
    """One setting of the world in which methods are played. name: how tables call it, and how it is found again."""

    name: str
    config: BenchmarkConfig


ResultKey = tuple[str, str]
"""The names of a condition and of a method."""


@dataclass(frozen=True)
class ResultGrid:
    """The cells of a sweep by condition and method, and what follows from them. iou counts the thresholds of tally.IOUS."""

    results: dict[ResultKey, StudyResult]
    protocol: DetectionProtocol
    _bootstraps: dict[object, BootstrapSamples] = field(default_factory=dict, repr=False, compare=False)

    def bootstrap_ap(
        self, key: ResultKey, iou: int, speeds: SpeedRange | None = None, scenarios: Collection[str] | None = None
    ) -> Interval:
        """AP of a cell with its interval, over some scenarios or one class of speeds alone."""
        return self._bootstrap(key, iou, speeds, scenarios).interval()

    def paired_difference(
        self, key: ResultKey, other: ResultKey, iou: int, scenarios: Collection[str] | None = None
    ) -> Interval:
        """AP of a cell minus that of another, paired over scenarios."""
        return self._bootstrap(key, iou, None, scenarios).paired_difference(
            self._bootstrap(other, iou, None, scenarios)
        )

    def scenarios_of(self, key: ResultKey) -> frozenset[str]:
        """Those that a cell was played on."""
        return frozenset(match.scenario for match in self.results[key].matches[0])

    def _bootstrap(
        self, key: ResultKey, iou: int, speeds: SpeedRange | None, scenarios: Collection[str] | None
    ) -> BootstrapSamples:
        cache_key = (key, iou, speeds, None if scenarios is None else frozenset(scenarios))
        if cache_key not in self._bootstraps:
            frames = self.results[key].select_matches(iou, scenarios, speeds)
            self._bootstraps[cache_key] = bootstrap(frames, protocol=self.protocol)
        return self._bootstraps[cache_key]


def run_conditions(
    open_recording: Callable[[], Recording],
    conditions: Sequence[Condition],
    folder: Path,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResultGrid:
    """Every method of every condition: the cell kept in the folder, or played now and kept.

    progress counts scenarios of conditions that are still to be played. Conditions of one configuration but for its methods
    should be one: methods of one condition process each cloud once.
    """
    recording_hash = hash_recording(open_recording())
    paths = {
        (c.name, method): result_path(folder, c.config, method, recording_hash)
        for c in conditions
        for method in c.config.methods
    }
    stored = {key: result for key, path in paths.items() if (result := read_result(path)) is not None}
    remaining = [(c, tuple(m for m in c.config.methods if (c.name, m) not in stored)) for c in conditions]
    pending = [Condition(c.name, replace(c.config, methods=methods)) for c, methods in remaining if methods]
    with closing(run_benchmarks(open_recording, [c.config for c in pending], workers, progress)) as results:
        for condition, metrics_by_method in zip(pending, results):
            for metrics in metrics_by_method:
                result = make_study_result(metrics)
                write_result(paths[condition.name, metrics.method], result)
                stored[condition.name, metrics.method] = result
    return ResultGrid({key: stored[key] for key in paths}, resolve_protocol(conditions[0].config))


def result_path(folder: Path, config: BenchmarkConfig, method: str, recording_hash: str) -> Path:
    """The file of a cell, named by all that its numbers depend on. recording_hash: the recording's digest."""
    method_config = replace(config, methods=(method,), weights=load_detector(config.weights).fingerprint.hex())
    net = config.replay.pose_correction.net if config.replay.pose_correction is not None else None
    corrector_fingerprint = "" if net is None else fingerprint(net).hex()
    digest = hashlib.blake2b(
        repr((method_config, corrector_fingerprint, recording_hash, source_digest(COMPUTED_BY))).encode(), digest_size=8
    )
    return folder / f"{method}-{digest.hexdigest()}.npz"


def hash_recording(recording: Recording) -> str:
    """Hash the first evaluated snapshot of each scenario: agents, poses, clouds, truth."""
    digest = hashlib.blake2b(digest_size=8)
    for scenario in recording.scenarios:
        eval_indices = recording.eval_indices(scenario)
        digest.update(repr((scenario, recording.length(scenario), eval_indices, recording.agents(scenario))).encode())
        first = recording.snapshot(scenario, eval_indices.start)
        for frame in first.frames:
            digest.update(frame.points.xyz.numpy().tobytes())
            digest.update(frame.world_from_agent.matrix().numpy().tobytes())
        if first.truth is not None:
            digest.update(first.truth.boxes.center.numpy().tobytes())
    return digest.hexdigest()
