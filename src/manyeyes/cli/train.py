# SPDX-License-Identifier: Apache-2.0
"""Trains a detector or a map model on recordings, FeaKM on what a detector sees, or a verifier of poses on generated scenes; goes
on where a stopped run was.

A plan (costr-small, costr-base) trains several stages and fits the codebook, from nothing to the weights that ship.

Several processes: torchrun -m manyeyes.cli.main train.
"""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from manyeyes._bounds import (
    BatchSize,
    InputPath,
    LearningRate,
    OutputFolder,
    PositiveFloat,
    PositiveInt,
    Seed,
    WorkerCount,
)
from manyeyes.cli.compute_options import ComputeOptions
from manyeyes.studies.options import ClassName
from manyeyes.studies.replay_options import FileChecks

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as ProgressBars

    from manyeyes.datasets.base import Recording, RecordingReader
    from manyeyes.datasets.missing import MissingFiles
    from manyeyes.models.detector.protocols import BoxDetector
    from manyeyes.training.detector.plan import TrainPlan
    from manyeyes.training.devices import Execution
    from manyeyes.training.maps.task import MapTask, MapTrainConfig
    from manyeyes.training.pose.candidate_verifier import CandidateVerifierTask, CandidateVerifierTrainConfig
    from manyeyes.training.pose.feakm import FeakmTask, FeakmTrainConfig
    from manyeyes.training.pose.feakm_cache import FeatureCache
    from manyeyes.training.trainer import Task, TrainConfig

_REPLACED = ("steps", "batch", "learning_rate", "validate_every", "validate_frames")
"""Options that replace fields of the settings of every stage."""
_Config = TypeVar("_Config", bound="TrainConfig")


@dataclass(frozen=True)
class Options:
    """Which recordings, which settings, where to."""

    data: tuple[Path, ...] = ()
    """Data sets, folders of scenarios, or single scenarios: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader.
    Several are mixed: samples are uniform over the scenarios of all."""
    split: str | None = "train"
    """Which split of every dataset: a folder inside it."""
    data_weights: tuple[PositiveFloat, ...] = ()
    """Probability that a sample comes from each of the recordings, up to a common factor, instead of by numbers of scenarios."""
    validation: tuple[Path, ...] = ()
    """Recordings whose frames are in no training: a plan calibrates scores on them, and weights are measured on them during
    training where --validate-every is given."""
    validate_every: PositiveInt | None = None
    """Steps between two measurements of AP@0.5 on frames of validation; the result is then the best weights, best.safetensors."""
    validate_frames: PositiveInt | None = None
    """Frames of a measurement at most, spread evenly, instead of the preset's 40."""
    validation_split: str | None = "val"
    """Which split of every recording of validation."""
    preset: str = "costr-small/stage1"
    """Settings by name, of a stage or of a plan of stages; an unknown name lists the known ones."""
    config: InputPath | None = None
    """TOML file with any fields of the preset's settings, which replace them; the options of this command replace both."""
    print_config: bool = False
    """Print the settings as such a file, and train nothing."""
    out: OutputFolder | None = None
    """Folder of the run, runs/PRESET by default: weights.safetensors, log.jsonl, loss.png, train.json, last.pt to go on from;
    of a plan one such folder for each stage, and the final weights.safetensors."""
    seed: Seed = 0
    """Of weights, samples and augmentation; stage k of a plan, from 0, has the seed plus k."""
    steps: PositiveInt | None = None
    """Steps of the optimiser, instead of the preset's; of a plan those of each stage."""
    batch: BatchSize | None = None
    """Samples a step over all processes, instead of the preset's."""
    learning_rate: LearningRate | None = None
    """Instead of the preset's; of a plan that of each stage."""
    fusion: str | None = None
    """Fusion module of a detector by name, one of your own too, instead of the preset's; an unknown name lists the known ones."""
    classes: tuple[ClassName, ...] = ()
    """Classes of objects that a detector finds, instead of the preset's, mostly vehicles. Weights to begin from may have fewer."""
    weights: tuple[Path, ...] = ()
    """Weights to begin from instead of random ones, such as those of the stage before; of a plan, its first stage. Of a map model
    several, each what it has in common with the preset, the first before the others. For feakm and feakm-paper the detector whose
    view they match, a shipped one by default."""
    threads: WorkerCount = 1
    """Threads of torch in each process; the result is the same only for the same number."""
    compute: ComputeOptions = field(default_factory=ComputeOptions)
    """Where and how steps are computed."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Train a model of a preset."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    from manyeyes._lock import hold_folder
    from manyeyes.datatypes import ConfigError
    from manyeyes.training.config_file import print_config
    from manyeyes.training.devices import Execution, open_device
    from manyeyes.training.pose.candidate_verifier import CandidateVerifierTrainConfig

    chosen, out = choose_preset(options), options.out or Path("runs") / options.preset
    if options.print_config:
        print(print_config(chosen), end="")
        return
    is_generated = isinstance(chosen, CandidateVerifierTrainConfig)
    if is_generated == bool(options.data):
        raise ConfigError(
            f"{options.preset} is trained on generated scenes; leave out --data."
            if is_generated
            else "--data is missing: name the recordings to train on."
        )
    torch.set_num_threads(options.threads)
    with open_device(options.compute.device) as device:
        is_first = not dist.is_initialized() or dist.get_rank() == 0
        with hold_folder(out) if is_first else nullcontext():
            execution = Execution(device, options.compute.workers, options.compute.tensorboard)
            _train(options, chosen, out, execution, Console(quiet=not is_first))


def choose_preset(options: Options) -> TrainConfig | TrainPlan:
    """Return the configuration or the plan of the preset with what the options replace.

    Raises:
        ConfigError: the preset is unknown, the file of settings does not fit it, or it takes one file of weights or has no
            fusion module.
    """
    from manyeyes.datatypes import ConfigError
    from manyeyes.training.config_file import read_config
    from manyeyes.training.detector.plan import TrainPlan
    from manyeyes.training.maps.task import MapTrainConfig
    from manyeyes.training.presets import TRAINING_PLANS, TRAINING_PRESETS

    chosen = {**TRAINING_PRESETS, **TRAINING_PLANS}.get(options.preset)
    if chosen is None:
        known = ", ".join((*TRAINING_PLANS, *TRAINING_PRESETS))
        raise ConfigError(f"No training preset {options.preset!r}; choose one of {known}.")
    if options.config is not None:
        chosen = read_config(options.config, chosen)
    if len(options.weights) > 1 and not isinstance(chosen, MapTrainConfig):
        raise ConfigError(f"--weights takes one file for {options.preset}; got {len(options.weights)}.")
    given = {name: getattr(options, name) for name in _REPLACED}
    given |= {name: getattr(options.compute, name) for name in ("micro_batch", "precision")}
    given = {name: value for name, value in given.items() if value is not None}
    replaced: dict[str, Any] = {} if options.fusion is None else {"fusion": options.fusion}
    replaced |= {"classes": options.classes} if options.classes else {}
    if not isinstance(chosen, TrainPlan):
        return _change_config(chosen, replaced, given)
    plan = chosen
    stages = ((name, _change_config(config, replaced, given)) for name, config in plan.stages)
    released = None if plan.released is None else replace(plan.released, **replaced)
    return replace(plan, stages=tuple(stages), released=released)


def _change_config(config: _Config, detector: dict[str, Any], given: dict[str, Any]) -> _Config:
    """Return the settings with fields replaced, and with fields of the detector replaced."""
    return replace(_change_detector(config, detector) if detector else config, **given)


def _change_detector(config: _Config, replaced: dict[str, Any]) -> _Config:
    from manyeyes.datatypes import ConfigError
    from manyeyes.models.detector.box_head import check_classes
    from manyeyes.models.fusion.registry import get_fusion
    from manyeyes.training.detector.task import DetectorTrainConfig

    if not isinstance(config, DetectorTrainConfig):
        names = {"fusion": "no fusion module by name", "classes": "no classes"}
        name = next(iter(replaced))
        raise ConfigError(f"--{name} is for presets of a detector; this one has {names[name]}.")
    detector = replace(config.detector, **replaced)
    get_fusion(detector.fusion)
    check_classes(detector.classes)
    return replace(config, detector=detector)


def _train(
    options: Options, chosen: TrainConfig | TrainPlan, out: Path, execution: Execution, console: Console
) -> None:
    from manyeyes._io import remove_unfinished
    from manyeyes.datasets.missing import NONE_MISSING
    from manyeyes.training.detector.plan import TrainPlan
    from manyeyes.training.pose.candidate_verifier import CandidateVerifierTrainConfig
    from manyeyes.viz.progress import make_progress_bars

    missing = NONE_MISSING
    if isinstance(chosen, CandidateVerifierTrainConfig):
        if not console.quiet:
            remove_unfinished(out)
        with make_progress_bars(console) as bars:
            run = _run_task(options, _make_verifier_task(options, chosen, out, bars), out, execution, bars)
    else:
        recording, missing = _open_training_recording(options, chosen, console)
        if not console.quiet:
            remove_unfinished(out, below=isinstance(chosen, TrainPlan))
        with make_progress_bars(console) as bars:
            if isinstance(chosen, TrainPlan):
                run = _train_plan(options, chosen, out, execution, recording, bars)
            else:
                task = _make_task(options, chosen, recording, missing, bars)
                run = _run_task(options, task, out, execution, bars)
    if not console.quiet:
        _write_record(options, run, missing, out, console)


def _open_training_recording(
    options: Options, chosen: TrainConfig | TrainPlan, console: Console
) -> tuple[RecordingReader, MissingFiles]:
    """Open what is trained on, with images where the preset needs them, and check its files."""
    from manyeyes.datasets.mixed import open_recordings
    from manyeyes.studies.map_recordings import check_images
    from manyeyes.studies.recordings import check_files
    from manyeyes.training.maps.task import MapTrainConfig

    has_cameras = isinstance(chosen, MapTrainConfig) and "camera" in chosen.map_model.bev.sensors
    recording = open_recordings(options.data, options.split, images=has_cameras, weights=options.data_weights)
    if has_cameras:
        check_images(recording, " ".join(map(str, options.data)))
    return recording, check_files(recording, options.checks, console)


@dataclass(frozen=True)
class _FinishedRun:
    """What a run is recorded by: its settings, weights, last loss, time, and the folders with a log."""

    settings: TrainConfig | TrainPlan
    weights: Path
    loss: float | None
    seconds: float
    log_folders: tuple[Path, ...]


def _write_record(options: Options, run: _FinishedRun, missing: MissingFiles, out: Path, console: Console) -> None:
    """Write train.json and the curves of the loss, and print where they are."""
    from manyeyes.studies import provenance
    from manyeyes.viz.loss_curve import save_loss_curve
    from manyeyes.viz.table import missing_footer

    for folder in run.log_folders:
        save_loss_curve(folder / "log.jsonl", folder / "loss.png")
    result = {"weights": run.weights.name, "loss": run.loss, "seconds": run.seconds, "missing": missing}
    provenance.write_json(out / "train.json", result, {"options": options, "training": run.settings}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    shown = " and ".join(str(folder / "loss.png") for folder in run.log_folders)
    text = f"{run.weights}; the loss over steps is in {shown}" if shown else str(run.weights)
    console.print(text, highlight=False, soft_wrap=True)


def _make_card(options: Options, settings: TrainConfig | TrainPlan) -> dict[str, Any]:
    from manyeyes.studies import provenance

    origin = provenance.collect_provenance({"options": options, "training": settings}, options.seed)
    return {name: origin[name] for name in ("command", "versions", "git_commit")}


def _run_task(
    options: Options, task: Task[Any, Any, Any], out: Path, execution: Execution, bars: ProgressBars
) -> _FinishedRun:
    from manyeyes.training.monitor import Progress
    from manyeyes.training.trainer import Trainer

    card = _make_card(options, task.config)
    trainer = Trainer(task, out, execution.device, execution.workers, execution.tensorboard)
    row = bars.add_task("Training", total=task.steps)

    def report(at: Progress) -> None:
        shown = [f"{name} {at.terms[name]:.2f}" for name in task.shown_terms]
        bars.update(row, completed=at.step, description=", ".join((f"loss {at.loss:.3f}", *shown)))

    weights = trainer.run(card, report)
    return _FinishedRun(task.config, weights, trainer.loss, trainer.seconds, (out,))


def _train_plan(
    options: Options,
    plan: TrainPlan,
    out: Path,
    execution: Execution,
    recording: RecordingReader,
    bars: ProgressBars,
) -> _FinishedRun:
    """Run what is left of a plan, with a progress bar for each stage that is trained now."""
    from contextlib import ExitStack

    from manyeyes.models import checkpoint, pretrained
    from manyeyes.training.detector.plan import PlanRun
    from manyeyes.training.monitor import Progress

    rows: dict[str, Any] = {}
    last: Progress | None = None

    def report(stage: str, at: Progress) -> None:
        nonlocal last
        if stage not in rows:
            rows[stage] = bars.add_task(stage, total=at.steps)
        bars.update(rows[stage], completed=at.step, description=f"{stage}: loss {at.loss:.3f}")
        last = at

    with ExitStack() as files:
        given = next(iter(map(str, options.weights)), None)
        start = files.enter_context(pretrained.open_detector_file(given)) if given else None
        card = {**_make_card(options, plan), "preset": options.preset, "data": [str(path) for path in options.data]}
        validation = _open_validation(options)
        run = PlanRun(plan, recording, options.seed, out, start, validation, execution)
        weights = run.run(card, report)
    seconds = checkpoint.read_card(weights)["train_seconds"]
    folders = tuple(out / name for name, _ in plan.stages if (out / name / "log.jsonl").exists())
    return _FinishedRun(plan, weights, last.loss if last else None, seconds, folders)


def _open_validation(options: Options) -> RecordingReader | None:
    from manyeyes.datasets.mixed import open_recordings

    return open_recordings(options.validation, options.validation_split) if options.validation else None


def _make_task(
    options: Options, config: TrainConfig, recording: Recording, missing: MissingFiles, bars: ProgressBars
) -> Task[Any, Any, Any]:
    from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
    from manyeyes.training.maps.task import MapTrainConfig
    from manyeyes.training.pose.feakm import FeakmTrainConfig

    if isinstance(config, DetectorTrainConfig):
        start = next(iter(options.weights), None)
        return DetectorTask(config, recording, options.seed, start, _open_validation(options))
    if isinstance(config, MapTrainConfig):
        return _make_map_task(options, config, recording)
    assert isinstance(config, FeakmTrainConfig)
    return _make_feakm_task(options, config, recording, missing, bars)


def _make_verifier_task(
    options: Options, config: CandidateVerifierTrainConfig, out: Path, bars: ProgressBars
) -> CandidateVerifierTask:
    """Generate the scenes of a seed under the folder of the run, or read those that are there."""
    from manyeyes.training.pose.candidate_scenes import LabelledCandidates, build_scenes
    from manyeyes.training.pose.candidate_verifier import CandidateVerifierTask

    row, parts = bars.add_task("Generating scenes", total=config.num_scenes), list[LabelledCandidates]()
    for part in build_scenes(out / f"scenes-{options.seed}", options.seed, config.num_scenes):
        parts.append(part)
        bars.update(row, advance=len(part.exists))
    return CandidateVerifierTask(config, LabelledCandidates.cat(parts), options.seed)


def _make_map_task(options: Options, config: MapTrainConfig, recording: Recording) -> MapTask:
    from manyeyes.models import pretrained
    from manyeyes.simulator.scene.towns import TOWN_SPLIT
    from manyeyes.studies.map_recordings import load_true_maps
    from manyeyes.training.maps.samples import TileStream
    from manyeyes.training.maps.task import MapTask

    held_out = tuple(town for side, towns in TOWN_SPLIT.items() if side != "train" for town in towns)
    maps = load_true_maps(recording)
    samples = TileStream(recording, maps, config.map_model, config.augment, options.seed, held_out)
    start = [pretrained.load_map_model_state(weights) for weights in options.weights]
    return MapTask(config, samples, options.seed, start)


def _make_feakm_task(
    options: Options, config: FeakmTrainConfig, recording: Recording, missing: MissingFiles, bars: ProgressBars
) -> FeakmTask:
    from manyeyes.models import pretrained
    from manyeyes.models.detector.proposal import PROPOSAL_DIM
    from manyeyes.models.detector.protocols import require_tokens
    from manyeyes.training.pose.feakm import FeakmTask

    detector = require_tokens(pretrained.load(*options.weights[:1]))
    keypoints = replace(config.net.keypoints, in_channels=detector.token_channels - PROPOSAL_DIM)
    net = replace(config.net, keypoints=keypoints, detector=detector.fingerprint.hex())
    cache = _load_or_cache_features(options, recording, missing, detector, bars)
    return FeakmTask(replace(config, net=net), cache, options.seed)


def _load_or_cache_features(
    options: Options, recording: Recording, missing: MissingFiles, detector: BoxDetector, bars: ProgressBars
) -> FeatureCache:
    """Cache the detector's views under runs/views, by detector, data, split and missing files, for both FeaKM presets."""
    from manyeyes.training.pose.feakm_cache import build_cache, select_snapshots

    missing_key = f"|{missing}" if missing.count else ""
    data = "|".join(str(path.resolve()) for path in options.data)
    digest = hashlib.blake2b(f"{data}|{options.split}{missing_key}".encode(), digest_size=4).hexdigest()
    row = bars.add_task("Detecting", total=len(select_snapshots(recording)))
    cache = None
    for cache in build_cache(recording, detector, Path("runs") / "views" / digest):
        bars.update(row, completed=len(cache.snapshots))
    assert cache is not None  # select_snapshots refuses a recording without a snapshot
    return cache
