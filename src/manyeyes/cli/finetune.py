# SPDX-License-Identifier: Apache-2.0
"""Trains finished weights on over 20 to 500 labelled frames of your own sensor, and prints AP on a holdout before and after.

The codebook is fitted again and scores are calibrated, so that messages stay small. A killed run goes on when it is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manyeyes._bounds import Fraction, LearningRate, OutputFolder, PositiveInt, Seed, WorkerCount
from manyeyes.cli.compute_options import ComputeOptions
from manyeyes.studies.options import ClassName
from manyeyes.studies.replay_options import FileChecks

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.datasets.base import Recording
    from manyeyes.evaluation.detection.accumulator import MethodResult
    from manyeyes.evaluation.detection.benchmark import BenchmarkResult
    from manyeyes.training.detector.plan import TrainPlan
    from manyeyes.training.devices import Execution


@dataclass(frozen=True)
class Options:
    """Which frames, which weights, where to."""

    data: tuple[Path, ...]
    """Recordings with labels: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader. Several are mixed."""
    out: OutputFolder = Path("runs/finetune")
    """Folder of the run: weights.safetensors, finetune.json, and what a repeated run goes on from."""
    weights: str = "costr-small"
    """Weights to begin from: a shipped name or a .safetensors file."""
    split: str | None = None
    """Which split of every dataset: a folder inside it."""
    validation: tuple[Path, ...] = ()
    """Recordings for the numbers before and after, and for calibration; by default a part of the data is held out."""
    validation_split: str | None = None
    """Which split of every recording of validation."""
    holdout: Fraction = 0.25
    """Fraction of the scenarios, or of the end of a single one, that is held out where no recording of validation is given."""
    steps: PositiveInt | None = None
    """Steps of the optimiser; by default by the number of frames, 120 for 20 and 600 for 500."""
    learning_rate: LearningRate = 5e-4
    """Its peak. Halve it where AP falls on the holdout."""
    classes: tuple[ClassName, ...] = ()
    """Classes of objects that the result finds; by default those of the weights. New ones begin untrained and need more steps."""
    codebook: Literal["refit", "keep"] = "refit"
    """Whether the codebook is fitted to the new tokens, or that of the weights is kept."""
    max_frames: PositiveInt = 200
    """Frames of the holdout that are evaluated at most, spread evenly."""
    seed: Seed = 0
    """Of samples, augmentation and the codebook."""
    threads: WorkerCount = 1
    """Threads of torch; the result is the same only for the same number."""
    compute: ComputeOptions = field(default_factory=ComputeOptions)
    """Where and how steps are computed."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Train weights on, and compare them with the given ones."""
    import torch
    from rich.console import Console

    from manyeyes._lock import hold_folder
    from manyeyes.training.devices import Execution, resolve_device

    torch.set_num_threads(options.threads)
    with hold_folder(options.out):
        compute = options.compute
        execution = Execution(resolve_device(compute.device), compute.workers, compute.tensorboard)
        _finetune(options, execution, Console())


def _finetune(options: Options, execution: Execution, console: Console) -> None:
    import time

    from manyeyes.datasets.base import iter_eval_frames
    from manyeyes.models import checkpoint, pretrained
    from manyeyes.studies import provenance
    from manyeyes.training.detector.finetune import choose_steps, make_finetune_plan
    from manyeyes.training.detector.plan import PlanRun
    from manyeyes.training.monitor import Progress
    from manyeyes.viz.progress import make_progress_bars

    training, holdout = _open_parts(options, console)
    num_frames, num_held = (sum(1 for _ in iter_eval_frames(part)) for part in (training, holdout))
    steps = options.steps or choose_steps(num_frames)
    console.print(f"{num_frames} frames for training, {num_held} held out; {steps} steps", highlight=False)
    with pretrained.open_detector_file(options.weights) as start, make_progress_bars(console) as bars:
        begun = checkpoint.load(start).config
        plan = make_finetune_plan(
            begun, steps, options.learning_rate, options.codebook, options.classes or begun.classes
        )
        plan = plan.change_stages(
            micro_batch=options.compute.micro_batch, precision=options.compute.precision or "float32"
        )
        origin = provenance.collect_provenance({"options": options, "training": plan}, options.seed)
        card: dict[str, Any] = {name: origin[name] for name in ("command", "versions", "git_commit")}
        card |= {"finetuned_from": options.weights, "data": [str(path) for path in options.data]}
        row = bars.add_task("Training", total=steps)

        def report(stage: str, at: Progress) -> None:
            bars.update(row, completed=at.step, description=f"loss {at.loss:.3f}")

        began = time.process_time()
        weights = PlanRun(plan, training, options.seed, options.out, start, holdout, execution).run(card, report)
        cpu_minutes = (time.process_time() - began) / 60
    results = _evaluate(holdout, (options.weights, weights), options.max_frames, console)
    _write_results(options, plan, results, cpu_minutes, console)
    console.print(str(weights), highlight=False, soft_wrap=True)


def _open_parts(options: Options, console: Console) -> tuple[Recording, Recording]:
    """Open the recordings of training and of the holdout, with their files checked."""
    from manyeyes.datasets.holdout import split_holdout
    from manyeyes.datasets.mixed import open_recordings
    from manyeyes.studies.recordings import check_files

    recording = open_recordings(options.data, options.split)
    check_files(recording, options.checks, console)
    if options.validation:
        holdout = open_recordings(options.validation, options.validation_split)
        check_files(holdout, options.checks, console)
        return recording, holdout
    if len(recording.scenarios) == 1:
        console.print(
            "note: the end of the only scenario is held out, in the same street: the gain elsewhere may be smaller.",
            highlight=False,
            soft_wrap=True,
        )
    return split_holdout(recording, options.holdout)


def _evaluate(
    holdout: Recording, weights: tuple[str | Path, ...], max_frames: int, console: Console
) -> tuple[BenchmarkResult, ...]:
    """Evaluate no fusion, and intermediate fusion where there are several agents, with each file of weights."""
    from manyeyes.datasets.base import iter_eval_frames
    from manyeyes.evaluation.detection.benchmark import benchmark
    from manyeyes.evaluation.detection.recording_filters import FrameStride
    from manyeyes.viz.progress import track

    stride = max(1, sum(1 for _ in iter_eval_frames(holdout)) // max_frames)
    evaluated = FrameStride(holdout, stride)
    has_several = any(len(holdout.agents(name)) > 1 for name in holdout.scenarios)
    methods = ("no-fusion", "intermediate-temporal") if has_several else ("no-fusion",)
    results: list[BenchmarkResult] = []
    with track(console, "Evaluating the holdout before and after", len(weights) * len(evaluated.scenarios)) as show:

        def report(done: int, total: int) -> None:
            show(len(results) * total + done, len(weights) * total)

        for path in weights:
            results.append(benchmark(evaluated, str(path), methods, progress=report))
    return tuple(results)


def _write_results(
    options: Options, plan: TrainPlan, results: tuple[BenchmarkResult, ...], cpu_minutes: float, console: Console
) -> None:
    """Print the numbers before and after with their differences, and write finetune.json."""
    from manyeyes.evaluation.statistics.comparison import Comparison
    from manyeyes.studies import provenance
    from manyeyes.viz.study_table import (
        StudyTable,
        format_interval,
        format_number,
        make_comparison_table,
        make_terminal_table,
    )

    before, after = results
    named = [(name, r) for name, result in (("before", before), ("after", after)) for r in result.methods]
    lines = tuple(
        (
            name,
            f"{r.method}{_name_class(r, after)}",
            *map(format_interval, r.intervals),
            format_number(r.communication.bytes_per_message),
        )
        for name, r in named
    )
    comparisons = tuple(
        Comparison(
            f"{new.method}{_name_class(new, after)}, after - before",
            f"AP@{iou}",
            new.paired_difference(old, row, after.protocol),
        )
        for new in after.methods
        for old in before.methods
        if (old.method, old.class_name) == (new.method, new.class_name)
        for row, iou in enumerate((0.5, 0.7))
    )
    table = StudyTable("Holdout", ("weights", "method", "AP@0.5", "AP@0.7", "bytes/message"), lines)
    console.print(make_terminal_table(table))
    console.print(make_terminal_table(make_comparison_table(comparisons)))
    console.print(f"{cpu_minutes:.1f} minutes of CPU time for this run", highlight=False)
    rows = [
        {
            "weights": name,
            "method": r.method,
            "class_name": r.class_name,
            "ap": r.intervals,
            "bytes_per_message": r.communication.bytes_per_message,
        }
        for name, r in named
    ]
    payload = {"rows": rows, "comparisons": comparisons, "cpu_minutes": cpu_minutes}
    provenance.write_json(options.out / "finetune.json", payload, {"options": options, "plan": plan}, options.seed)


def _name_class(result: MethodResult, all_results: BenchmarkResult) -> str:
    """Return what names the class of a result; empty where there is one class."""
    has_classes = len({other.class_name for other in all_results.methods}) > 1
    return f", {result.class_name}" if has_classes else ""
