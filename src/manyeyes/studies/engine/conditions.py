# SPDX-License-Identifier: Apache-2.0
"""Methods replayed under many conditions: one cell for each method and condition, and the paired statistics over them.

Cells are evaluated over scenarios; differences are paired: all cells are resampled alike, and the unit draws of noise, loss and
jitter are the same at every level. AP of a speed class counts the true boxes of that class; a detection that was matched to a box
of another class is left out, neither right nor wrong; one that matched nothing is false in every class.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datasets.base import Recording
from manyeyes.evaluation.detection.accumulator import DEFAULT_THRESHOLD, IOU_THRESHOLDS, MetricAccumulator
from manyeyes.evaluation.detection.benchmark import (
    BenchmarkConfig,
    find_thresholds,
    load_detector,
    resolve_protocol,
    run_benchmarks,
)
from manyeyes.evaluation.detection.communication import Communication
from manyeyes.evaluation.detection.compute_times import compute_time_s
from manyeyes.evaluation.detection.frame_match import FrameMatch
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import BootstrapSamples, Interval, bootstrap
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.evaluation.statistics.operating_point import (
    OperatingPoint,
    OperatingThreshold,
    compute_operating_point,
)
from manyeyes.models.checkpoint import fingerprint
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.engine.cells import Cell, CellStore, hash_recording, third_party_source

COMPUTED_BY = ("manyeyes.evaluation.detection.benchmark",)
"""The modules whose import closure the numbers of a cell follow from."""

SpeedRange = tuple[float, float]
"""A class of speeds, m/s: from the first, below the second."""
ResultKey = tuple[str, str]
"""The names of a condition and of a method."""


@dataclass(frozen=True)
class BusVolume:
    """Bytes handed to the bus. max_message_bytes: one agent's at one instant; snapshot: of all senders together, mean and maximum.

    Where the first agent alone is evaluated, its own message is not received by it and is not counted.
    """

    max_message_bytes: int
    mean_snapshot_bytes: float
    max_snapshot_bytes: int


@dataclass(frozen=True)
class MethodMatches:
    """A method in a condition. matches: every evaluated frame, of every class, at each of IOU_THRESHOLDS; speeds: (G,) m/s of the
    true boxes of each of them. num_frames: evaluated, whatever the number of classes. answer_matches: the same frames at
    the time of the answer, which comes answer_ms after the sweep on average.
    """

    method: str
    matches: tuple[tuple[FrameMatch, ...], ...]
    speeds: tuple[Tensor, ...]
    communication: Communication
    volume: BusVolume
    age_ms: float
    num_frames: int
    answer_matches: tuple[tuple[FrameMatch, ...], ...] = ()
    answer_ms: float = math.nan

    @property
    def bytes_per_message(self) -> float:
        """The mean length of another agent's message for an ego's frame; 0 without messages."""
        return self.communication.bytes_per_message if self.communication.num_messages else 0.0

    def select_matches(
        self,
        iou: int,
        class_name: str,
        scenarios: Collection[str] | None = None,
        speed_range: SpeedRange | None = None,
    ) -> list[FrameMatch]:
        """Select the frames of a class matched at IOU_THRESHOLDS[iou]: of these scenarios alone, of one class of speeds alone."""
        pairs = [(match, v) for match, v in zip(self.matches[iou], self.speeds) if match.class_name == class_name]
        kept = [(match, v) for match, v in pairs if scenarios is None or match.scenario in scenarios]
        return [match if speed_range is None else filter_by_speed(match, v, speed_range) for match, v in kept]


def filter_by_speed(match: FrameMatch, speed: Tensor, speed_range: SpeedRange) -> FrameMatch:
    """Restrict a frame to the true boxes of one class of speeds; speed (G,)."""
    inside = (speed >= speed_range[0]) & (speed < speed_range[1])
    # Row -1 indexes the last entry, which is kept: a false positive stays one.
    mask = torch.cat((inside, torch.ones(1, dtype=torch.bool)))[match.truth_row]
    return replace(
        match,
        score=match.score[mask],
        truth_row=match.truth_row[mask],
        n_gt=int(inside.sum()),
        overlap_row=None if match.overlap_row is None else match.overlap_row[mask],
    )


def summarize_metrics(metrics: MetricAccumulator) -> MethodMatches:
    """Reduce an accumulator to what studies need."""
    sent = {(m.scenario, m.index, m.sender): m.num_bytes for m in metrics.messages}
    snapshot_bytes: dict[tuple[str, int], int] = {}
    for (scenario, index, _), size in sent.items():
        snapshot_bytes[scenario, index] = snapshot_bytes.get((scenario, index), 0) + size
    num_snapshots = len({(frame.scenario, frame.index) for frame in metrics.frames})
    volume = BusVolume(
        max(sent.values(), default=0),
        sum(snapshot_bytes.values()) / num_snapshots if num_snapshots else math.nan,
        max(snapshot_bytes.values(), default=0),
    )
    communication, speeds = metrics.summarize_communication(), tuple(metrics.speeds)
    return MethodMatches(
        metrics.method,
        metrics.match_frames(),
        speeds,
        communication,
        volume,
        metrics.mean_age_ms(),
        len(metrics.perceive_s),
        metrics.match_answers(),
        metrics.mean_answer_ms(),
    )


@dataclass(frozen=True)
class Condition:
    """One setting of the world in which methods are played. name: how tables call it, and how it is found again."""

    name: str
    config: BenchmarkConfig


@dataclass(frozen=True)
class ResultGrid:
    """The cells of a study by condition and method, and what follows from them. iou: row of IOU_THRESHOLDS.

    protocol: of the one class that the numbers are of. thresholds: of each cell's operating point.
    """

    results: dict[ResultKey, MethodMatches]
    protocol: DetectionProtocol
    thresholds: dict[ResultKey, OperatingThreshold] = field(default_factory=dict)
    _bootstraps: dict[object, BootstrapSamples] = field(default_factory=dict, repr=False, compare=False)

    def bootstrap_ap(
        self, key: ResultKey, iou: int, speeds: SpeedRange | None = None, scenarios: Collection[str] | None = None
    ) -> Interval:
        """Return the AP of a cell with its interval, over some scenarios or one class of speeds alone."""
        return self._bootstrap(key, iou, speeds, scenarios).interval()

    def ap_pair(self, key: ResultKey) -> tuple[Interval, Interval]:
        """Return the AP of a cell at both IoU thresholds."""
        return self.bootstrap_ap(key, 0), self.bootstrap_ap(key, 1)

    def answer_ap_pair(self, key: ResultKey) -> tuple[Interval, Interval]:
        """Return the AP of a cell at the time of the answer at both IoU thresholds."""
        return self._bootstrap_answers(key, 0).interval(), self._bootstrap_answers(key, 1).interval()

    def compare_answers(self, description: str, key: ResultKey, baseline: ResultKey, iou: int = 0) -> Comparison:
        """Compare AP at the time of the answer of a cell with that of a baseline, paired over scenarios."""
        difference = self._bootstrap_answers(key, iou).paired_difference(self._bootstrap_answers(baseline, iou))
        return Comparison(description, f"AP@{IOU_THRESHOLDS[iou]:g} at the answer", difference)

    def compute_operating_point(self, key: ResultKey) -> OperatingPoint:
        """Return the metrics of a cell at its score threshold, at the first of IOU_THRESHOLDS."""
        frames = self.results[key].select_matches(0, self.protocol.class_name)
        return compute_operating_point(frames, self.thresholds.get(key, DEFAULT_THRESHOLD), self.protocol)

    def legacy_ap_pair(self, key: ResultKey) -> tuple[Interval, Interval]:
        """Return the AP of a cell over concatenated frames at both IoU thresholds."""
        protocol = replace(self.protocol, ap_order="concatenated")
        name, result = protocol.class_name, self.results[key]
        half, seven = (bootstrap(result.select_matches(iou, name), protocol=protocol).interval() for iou in (0, 1))
        return half, seven

    def paired_difference(
        self, key: ResultKey, other: ResultKey, iou: int, scenarios: Collection[str] | None = None
    ) -> Interval:
        """Return the AP of a cell minus that of another, paired over scenarios."""
        samples = self._bootstrap(key, iou, None, scenarios)
        return samples.paired_difference(self._bootstrap(other, iou, None, scenarios))

    def difference_pair(self, key: ResultKey, other: ResultKey) -> tuple[Interval, Interval] | None:
        """Return the AP of a cell minus that of another at both IoU thresholds; None where one was not run."""
        if not {key, other} <= self.results.keys():
            return None
        return self.paired_difference(key, other, 0), self.paired_difference(key, other, 1)

    def compare(self, description: str, key: ResultKey, baseline: ResultKey, iou: int = 0) -> Comparison:
        """Compare AP of a cell with that of a baseline, paired over scenarios."""
        return Comparison(description, f"AP@{IOU_THRESHOLDS[iou]:g}", self.paired_difference(key, baseline, iou))

    def scenarios_of(self, key: ResultKey) -> frozenset[str]:
        """Return the scenarios of a cell."""
        return frozenset(match.scenario for match in self.results[key].matches[0])

    def _bootstrap_answers(self, key: ResultKey, iou: int) -> BootstrapSamples:
        cache_key = (key, iou, "answer")
        if cache_key not in self._bootstraps:
            name = self.protocol.class_name
            frames = [match for match in self.results[key].answer_matches[iou] if match.class_name == name]
            # Methods answer at times of their own, at which other objects may be in range.
            samples = bootstrap(frames, protocol=self.protocol)
            self._bootstraps[cache_key] = replace(samples, same_truth=False)
        return self._bootstraps[cache_key]

    def _bootstrap(
        self, key: ResultKey, iou: int, speeds: SpeedRange | None, scenarios: Collection[str] | None
    ) -> BootstrapSamples:
        cache_key = (key, iou, speeds, None if scenarios is None else frozenset(scenarios))
        if cache_key not in self._bootstraps:
            frames = self.results[key].select_matches(iou, self.protocol.class_name, scenarios, speeds)
            self._bootstraps[cache_key] = bootstrap(frames, protocol=self.protocol)
        return self._bootstraps[cache_key]


def run_conditions(
    open_recording: Callable[[], Recording],
    conditions: Sequence[Condition],
    store: CellStore,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    object_class: str | None = None,
) -> ResultGrid:
    """Load every method of every condition from the store, or play it now and store it.

    object_class: whose numbers the grid gives, by default the first of the detector; cells hold all classes.

    progress counts scenarios of conditions that are still to be played. Conditions of one configuration but for its methods
    should be one: methods of one condition process each cloud once.
    """
    recording_hash = hash_recording(open_recording())
    cells = {(c.name, m): make_cell(c.config, m, recording_hash) for c in conditions for m in c.config.methods}
    stored = {key: result for key, cell in cells.items() if (result := store.load(cell)) is not None}
    remaining = [(c, tuple(m for m in c.config.methods if (c.name, m) not in stored)) for c in conditions]
    pending = [Condition(c.name, replace(c.config, methods=methods)) for c, methods in remaining if methods]
    with closing(run_benchmarks(open_recording, [c.config for c in pending], workers, progress)) as results:
        for condition, metrics_by_method in zip(pending, results):
            for metrics in metrics_by_method:
                key = condition.name, metrics.method
                stored[key] = summarize_metrics(metrics)
                store.save(cells[key], stored[key])
    protocol = resolve_protocol(conditions[0].config)
    thresholds = {
        (c.name, m): find_thresholds(load_detector(c.config.weights), m)[object_class or protocol.classes[0]]
        for c in conditions
        for m in c.config.methods
    }
    return ResultGrid(
        {key: stored[key] for key in cells},
        protocol.with_classes((object_class or protocol.classes[0],)),
        thresholds,
    )


def make_cell(config: BenchmarkConfig, method: str, recording_hash: str) -> Cell[MethodMatches]:
    """Describe the cell of one method of a configuration."""
    detector, correction = load_detector(config.weights), config.replay.pose_correction
    method_config = replace(config, methods=(method,), weights=detector.fingerprint.hex())
    net = None if correction is None else correction.net
    corrector_fingerprint = "" if net is None else fingerprint(net).hex()
    corrector = None if correction is None else load_corrector(correction.corrector)
    source = third_party_source(get_strategy(method), detector, getattr(detector, "fusion", None), corrector)
    key = (method_config, corrector_fingerprint, recording_hash, source, compute_time_s(method))
    return Cell(method, MethodMatches, key, COMPUTED_BY)
