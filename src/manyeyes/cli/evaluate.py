# SPDX-License-Identifier: Apache-2.0
"""Evaluate methods on a split: AP with 95 % intervals over scenarios, bytes, data age, time, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes._bounds import AngleDeg, LengthM, NonNegativeInt, OutputFolder
from manyeyes._text import count_noun
from manyeyes.studies.options import EvaluationOptions
from manyeyes.studies.replay_options import display_name, make_excerpt

if TYPE_CHECKING:
    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording
    from manyeyes.evaluation.detection.accumulator import MethodResult
    from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
    from manyeyes.models.detector.protocols import BoxDetector
    from manyeyes.viz.results import MethodComparison


@dataclass(frozen=True, kw_only=True)
class Options(EvaluationOptions):
    """Which recording, which methods, by which protocol."""

    out: OutputFolder = Path("out/evaluate")
    """Folder for results.json and results.md."""
    noise_xy_m: LengthM = 0.0
    """Standard deviation of the position noise of other agents."""
    noise_yaw_deg: AngleDeg = 0.0
    """Standard deviation of the heading noise of other agents, degrees."""
    all_egos: bool = False
    """Evaluate every agent as ego, not only the first."""
    thresholds: Path | None = None
    """results.json of 'manyeyes evaluate' on a validation split, whose score thresholds are used; by default the weights' own."""
    timing_frames: NonNegativeInt = 10
    """Frames of the first scenario on which each method is timed by itself; 0 leaves times out."""


def main(options: Options) -> None:
    """Evaluate methods on a split."""
    from manyeyes._lock import hold_folder

    with hold_folder(options.out):
        _evaluate(options)


def _evaluate(options: Options) -> None:
    from rich.console import Console

    from manyeyes._io import atomic_write_text
    from manyeyes.datasets.registry import open_recording
    from manyeyes.evaluation.detection.benchmark import check_class, load_detector, resolve_protocol, run_benchmark
    from manyeyes.models.pretrained import read_training_seed
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import adapt_to_dataset, check_evaluated_frames, check_files
    from manyeyes.studies.sensor_notes import print_sensor_note
    from manyeyes.studies.thresholds import load_thresholds
    from manyeyes.viz.progress import track
    from manyeyes.viz.results import format_comparison_markdown, print_comparison, summarize_comparison

    console, config = Console(), _make_config(options)
    protocol, detector = resolve_protocol(config), load_detector(config.weights)
    check_class(options.object_class, protocol.classes)
    thresholds = load_thresholds(options.thresholds, options.data, options.split) if options.thresholds else None
    opener = partial(open_recording, options.data, options.split)
    recording = opener()
    check_evaluated_frames(recording, recording.scenarios)
    config = replace(config, replay=adapt_to_dataset(config.replay, options.replay_options, recording))
    missing = check_files(recording, options.checks, console)
    print_sensor_note(recording, recording.scenarios[0], detector, console)
    num_scenarios = len(config.filter_recording(recording).scenarios)
    with track(console, "Evaluating", num_scenarios) as report:
        results = run_benchmark(opener, config, options.workers, report, thresholds)
    results = [r for r in results if options.object_class in (None, r.class_name)]
    timed_results = _add_times(results, recording, detector, config.replay, options.timing_frames)
    seed = read_training_seed(options.replay_options.weights)
    comparison = summarize_comparison(timed_results, protocol, missing, seed)
    data_name = f"{options.data.name}{f'/{options.split}' if options.split else ''}"
    held = count_noun(num_scenarios, "scenario")
    title = f"{display_name(options.replay_options.weights)} on {data_name}: {held}, {protocol.name}"
    note = "" if config.pose_noise is None else options.pose_errors.describe(options.seed)
    print_comparison(console, comparison, title)
    if note:
        console.print(note, highlight=False, soft_wrap=True)
    text = f"{title}\n\n{format_comparison_markdown(comparison)}"
    atomic_write_text(options.out / "results.md", f"{text}\n{note}\n" if note else text)
    path = options.out / "results.json"
    origin = provenance.write_json(path, comparison, {"options": options, "benchmark": config}, options.seed)
    page = _save_page(options.out, title, comparison, note, origin)
    console.print(f"\nNumbers, configuration and versions are in {path}; open {page}", highlight=False, soft_wrap=True)


def _make_config(options: Options) -> BenchmarkConfig:
    from manyeyes.evaluation.detection.benchmark import BenchmarkConfig

    errors, sigma_yaw_rad = options.pose_errors, math.radians(options.noise_yaw_deg)
    noise = errors.make_pose_noise(options.seed).at_level(options.noise_xy_m, sigma_yaw_rad)
    return BenchmarkConfig(
        weights=options.replay_options.weights,
        methods=options.replay_options.methods,
        protocol=options.protocol,
        replay=options.replay_options.make_replay_config(options.seed, options.all_egos),
        pose_noise=noise,
        odometry_drift=None if noise is None else errors.make_odometry_drift(options.seed),
        frame_stride=options.frame_stride,
        scenario_stride=options.scenario_stride,
    )


def _save_page(out: Path, title: str, comparison: MethodComparison, note: str, origin: dict[str, Any]) -> Path:
    """Write the report of an evaluation; returns its path."""
    from manyeyes.viz.report import HtmlReport, save_report

    page = HtmlReport(
        title,
        "All methods on the same scenarios; intervals are over scenarios.",
        comparison.rows,
        comparison.differences if comparison.has_several_scenarios else (),
        notes=tuple(words for words in (comparison.footer, note) if words),
        provenance=origin,
    )
    save_report(page, out / "report.html")
    return out / "report.html"


def _add_times(
    results: Sequence[MethodResult], recording: Recording, detector: BoxDetector, config: ReplayConfig, num_frames: int
) -> list[MethodResult]:
    """Return results with the times of their methods."""
    times = {
        name: _measure_times(name, recording, detector, config, num_frames)
        for name in dict.fromkeys(result.method for result in results)
    }
    return [replace(r, share_ms=times[r.method][0], perceive_ms=times[r.method][1]) for r in results]


def _measure_times(
    method: str, recording: Recording, detector: BoxDetector, config: ReplayConfig, num_frames: int
) -> tuple[float, float]:
    """Measure the time of share and perceive, ms, of one method by itself: in an evaluation, methods share the processing of each
    cloud. NaN without frames.
    """
    from manyeyes.agents.replay import replay

    if num_frames == 0:
        return math.nan, math.nan
    part = make_excerpt(recording, None, num_frames)
    steps = list(replay(part, part.scenario, detector, [method], config))
    share_s = [s.seconds for step in steps[1:] for s in step.sent if s.num_packets]
    perceive_s = [step.perceive_seconds for step in steps[1:]]
    return _mean_ms(share_s), _mean_ms(perceive_s)


def _mean_ms(seconds: list[float]) -> float:
    return 1e3 * sum(seconds) / len(seconds) if seconds else math.nan
