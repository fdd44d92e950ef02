# SPDX-License-Identifier: Apache-2.0
"""Methods on a recording: every scenario replayed, matched and counted, in any number of processes with one result."""

from __future__ import annotations

import math
import multiprocessing
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, groupby, islice
from pathlib import Path

import torch

from manyeyes.agents.replay import WARMUP_FRAMES, CachedOutputs, ReplayConfig, ReplayStep, replay
from manyeyes.agents.strategies.names import current_name
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datasets.base import Recording
from manyeyes.datasets.odometry_drift import DriftingOdometry, OdometryDrift
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import VEHICLES, ConfigError, Snapshot
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult, MetricAccumulator
from manyeyes.evaluation.detection.answer_time import answer_of
from manyeyes.evaluation.detection.protocols import DetectionProtocol, get_protocol
from manyeyes.evaluation.detection.recording_filters import CachedRecording, FrameStride, NearestAgents, ScenarioStride
from manyeyes.evaluation.detection.sensor_change import NO_SENSOR_CHANGE, SensorChange
from manyeyes.evaluation.statistics.operating_point import OperatingThreshold
from manyeyes.models import pretrained
from manyeyes.models.detector.protocols import BoxDetector, check_detector
from manyeyes.models.detector.single_sweep import with_single_sweep
from manyeyes.models.score_calibration import default_drawing_score, has_score_map

CONDITIONS_PER_GROUP = 8
"""Conditions that are played side by side: more of them see each sweep once, fewer of them are lost when a study is stopped."""


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is compared, and how it is evaluated. weights: a name, a path or a detector. protocol: by name, over its range.

    frame_stride, scenario_stride: judge each so many-th frame, of each so many-th scenario. num_agents: the nearest so many, in
    scenarios that have them; None: all of all scenarios. sensors: changes of all agents' sensors. odometry_drift: of all agents,
    the ego too; None: odometry is true.
    """

    weights: str | BoxDetector = pretrained.DEFAULT_DETECTOR
    methods: tuple[str, ...] = ("no-fusion", "late", "intermediate", "early")
    protocol: str = "global-sort"
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    pose_noise: PoseNoise | None = None
    odometry_drift: OdometryDrift | None = None
    frame_stride: int = 1
    scenario_stride: int = 1
    num_agents: int | None = None
    sensors: SensorChange = NO_SENSOR_CHANGE

    def filter_recording(self, recording: Recording) -> Recording:
        """What is evaluated of a recording."""
        filtered = recording if self.scenario_stride == 1 else ScenarioStride(recording, self.scenario_stride)
        filtered = filtered if self.num_agents is None else NearestAgents(filtered, self.num_agents)
        return filtered if self.frame_stride == 1 else FrameStride(filtered, self.frame_stride)

    def make_perturbation(self) -> Callable[[Snapshot], Snapshot]:
        """Return what changes the snapshots of one scenario, in their order, before agents read them."""
        odometry = DriftingOdometry(self.odometry_drift) if self.odometry_drift else None
        return partial(_perturb, self.sensors, odometry, self.pose_noise)


def resolve_protocol(config: BenchmarkConfig) -> DetectionProtocol:
    """Return the named protocol of the classes of the detector; our own one uses its output range too."""
    detector = load_detector(config.weights)
    if config.protocol == "global-sort":
        return make_own_protocol(detector)
    return get_protocol(config.protocol).with_classes(list_classes(detector))


def make_own_protocol(detector: BoxDetector) -> DetectionProtocol:
    """Return the project's own protocol over the range and of the classes of a detector."""
    grid = detector.detection_range
    return (
        get_protocol("global-sort")
        .with_range((grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max))
        .with_classes(list_classes(detector))
    )


def list_classes(detector: BoxDetector) -> tuple[str, ...]:
    """Return the classes of ``datatypes.CLASSES`` that a detector finds; vehicles where it does not say."""
    return tuple(getattr(detector, "classes", None) or VEHICLES)


def check_class(name: str | None, classes: Sequence[str]) -> None:
    """Raise a ConfigError where a class is asked for that a detector does not find; None asks for none."""
    if name is not None and name not in classes:
        raise ConfigError(f"--object-class is one that the weights detect: {', '.join(classes)}; got {name}.")


def find_thresholds(detector: BoxDetector, method: str) -> dict[str, OperatingThreshold]:
    """Return the threshold of a method for each class of a detector: that of the card of its weights, if it is calibrated.

    A card has one threshold for each form of result, and of all classes.
    """
    form = get_strategy(method).score_form
    score, source = default_drawing_score(detector, form), "weights" if has_score_map(detector, form) else "default"
    return {name: OperatingThreshold(score, source) for name in list_classes(detector)}


def load_detector(weights: str | BoxDetector) -> BoxDetector:
    """Return the weights of that name or path, read once by each process for as long as the file stays as it is; or the
    detector given.
    """
    if not isinstance(weights, str):
        check_detector(weights)
        return weights
    path = Path(weights)
    return _load_cached(weights, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=2)
def _load_cached(weights: str, modified_ns: int) -> BoxDetector:
    return pretrained.load(weights)


def run_scenario(
    open_recording: Callable[[], Recording], configs: Sequence[BenchmarkConfig], scenario: str
) -> list[list[MetricAccumulator]]:
    """Return all methods of each configuration on one scenario; a function of its arguments alone.

    The configurations have the same weights, sensors, odometry, view and history: each sweep is read and processed once.
    """
    torch.set_num_threads(1)
    first = configs[0]
    detector, feature_cache = load_detector(first.weights), {}
    if first.sensors.sweeps == 1:
        detector = with_single_sweep(detector)
    max_snapshots = 2 * first.frame_stride + first.replay.warmup_frames + 1
    recording = CachedRecording(first.filter_recording(open_recording()), max_snapshots)
    accumulators_by_config = [
        {name: MetricAccumulator(name, resolve_protocol(config)) for name in config.methods} for config in configs
    ]
    replays = [_iterate_snapshots(recording, scenario, detector, config, feature_cache) for config in configs]
    for instants in zip(*replays):
        for (_, steps), accumulators in zip(instants, accumulators_by_config):
            for step in steps:
                accumulators[step.method].add(step, answer_of(step, recording))
    return [list(accumulators.values()) for accumulators in accumulators_by_config]


def _iterate_snapshots(
    recording: Recording, scenario: str, detector: BoxDetector, config: BenchmarkConfig, feature_cache: CachedOutputs
) -> Iterator[tuple[int, Iterator[ReplayStep]]]:
    """Return the steps of one configuration, evaluated snapshot by evaluated snapshot."""
    steps = replay(
        recording, scenario, detector, config.methods, config.replay, config.make_perturbation(), feature_cache
    )
    return groupby(steps, lambda step: step.snapshot.index)


def _perturb(
    sensors: SensorChange, odometry: DriftingOdometry | None, noise: PoseNoise | None, snapshot: Snapshot
) -> Snapshot:
    changed = sensors.apply(snapshot)
    measured = odometry.apply(changed) if odometry else changed
    return noise.apply(measured, 0) if noise else measured


def run_benchmarks(
    open_recording: Callable[[], Recording],
    configs: Sequence[BenchmarkConfig],
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Generator[tuple[MetricAccumulator, ...]]:
    """Yield the tallies of each configuration in turn, as soon as they are there.

    open_recording must be picklable when workers > 1; results do not depend on workers. progress counts scenarios played by
    a configuration, from none on.
    """
    recording, groups = open_recording(), _group_configs(configs)
    jobs = [(group, name) for group in groups for name in group[0].filter_recording(recording).scenarios]
    work, total = partial(_run_job, open_recording), sum(len(group) for group, _ in jobs)

    def report(done: int) -> None:
        progress(done, total)

    report(0)
    if workers == 1:
        yield from _gather(map(work, jobs), groups, jobs, report)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from _gather(pool.imap(work, jobs), groups, jobs, report)


def _group_configs(configs: Sequence[BenchmarkConfig]) -> list[tuple[BenchmarkConfig, ...]]:
    """Return neighbours that can be replayed together, at most TOGETHER of them: what is finished is handed out group by group."""
    comparable = groupby(
        configs,
        lambda c: (c.weights, c.frame_stride, c.num_agents, c.replay.warmup_frames, c.sensors, c.odometry_drift),
    )
    runs = [tuple(run) for _, run in comparable]
    return [run[k : k + CONDITIONS_PER_GROUP] for run in runs for k in range(0, len(run), CONDITIONS_PER_GROUP)]


def _run_job(open_recording: Callable[[], Recording], job: tuple[tuple[BenchmarkConfig, ...], str]) -> bytes:
    """As bytes: between processes, torch would hand over every tensor as an open file, and a study has more than may be open."""
    return pickle.dumps(run_scenario(open_recording, *job))


def _gather(
    found: Iterable[bytes],
    groups: Sequence[tuple[BenchmarkConfig, ...]],
    jobs: Sequence[tuple[tuple[BenchmarkConfig, ...], str]],
    progress: Callable[[int], None],
) -> Generator[tuple[MetricAccumulator, ...]]:
    """Yield the tallies of jobs, added up over the scenarios of each group."""
    results, done = iter(found), 0
    for group in groups:
        totals = [[MetricAccumulator(name, resolve_protocol(config)) for name in config.methods] for config in group]
        for pickled in islice(results, sum(job_group is group for job_group, _ in jobs)):
            for total, part in zip(chain(*totals), chain(*pickle.loads(pickled))):
                total.extend(part)
            done += len(group)
            progress(done)
        yield from map(tuple, totals)


def run_benchmark(
    open_recording: Callable[[], Recording],
    config: BenchmarkConfig,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    thresholds: Mapping[str, Mapping[str, OperatingThreshold]] | None = None,
) -> tuple[MethodResult, ...]:
    """Return every method on every scenario, of each class of the detector. open_recording must be picklable when workers > 1;
    results do not depend on workers.

    thresholds: of the operating point, by method and class; those of the weights where it lacks them.
    """
    detector, chosen = load_detector(config.weights), thresholds or {}
    with closing(run_benchmarks(open_recording, [config], workers, progress)) as accumulators:
        return tuple(
            result
            for accumulator in next(accumulators)
            for result in accumulator.compute_results(
                {**find_thresholds(detector, accumulator.method), **chosen.get(accumulator.method, {})}
            )
        )


@dataclass(frozen=True)
class BenchmarkResult:
    """Results of methods on a recording, in their order, of each class of the detector.

    ``result["late"]`` is one of them, of the first class, and ``print(result)`` a table.
    """

    protocol: DetectionProtocol
    methods: tuple[MethodResult, ...]

    def __getitem__(self, method: str) -> MethodResult:
        return {result.method: result for result in reversed(self.methods)}[method]

    def __str__(self) -> str:
        has_classes = len({result.class_name for result in self.methods}) > 1
        class_heading = ("class",) if has_classes else ()
        names = ("method", *class_heading, *(f"AP@{iou}" for iou in IOU_THRESHOLDS), "bytes/message")
        rows = [
            (
                result.method,
                *((result.class_name,) if has_classes else ()),
                *(f"{interval.value:.3f}" for interval in result.intervals),
                _format_bytes(result),
            )
            for result in self.methods
        ]
        widths = [max(map(len, column)) for column in zip(names, *rows)]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in (names, *rows))


def _format_bytes(result: MethodResult) -> str:
    mean = result.communication.bytes_per_message
    return "-" if math.isnan(mean) else f"{mean:,.0f}"


def benchmark(
    recording: Recording,
    detector: str | Path | BoxDetector = pretrained.DEFAULT_DETECTOR,
    methods: Sequence[str] = ("no-fusion", "late", "intermediate", "early"),
    protocol: str = "global-sort",
    replay: ReplayConfig | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BenchmarkResult:
    """Evaluate methods on all scenarios of a recording.

    Args:
        recording: what a reader opened.
        detector: weights by name or path, a registered detector by name, or any object that is a BoxDetector.
        methods: names of strategies, registered ones of your own too.
        protocol: name of the evaluation protocol; the default one evaluates over the range of the detector.
        replay: channel, budget and more; by default an ideal channel with full histories, between agents within 70 m or
            the range that the reader sets.
        workers: number of processes that share the scenarios; with several, recording and detector must be picklable.
        progress: called with the number of scenarios played, and that of all.

    Raises:
        ConfigError: a name is not known, or a method needs tokens that the detector does not have.
    """
    weights = str(detector) if isinstance(detector, Path) else detector
    replay = replay or ReplayConfig(warmup_frames=WARMUP_FRAMES).adapt_to(recording)
    config = BenchmarkConfig(weights, tuple(map(current_name, methods)), protocol, replay)
    return BenchmarkResult(
        resolve_protocol(config), run_benchmark(partial(_return, recording), config, workers, progress)
    )


def _return(recording: Recording) -> Recording:
    return recording
