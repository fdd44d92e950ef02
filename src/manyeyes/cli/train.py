# SPDX-License-Identifier: Apache-2.0
"""Trains a detector or a map model on a recording, or FeaKM on what a detector sees; goes on where a stopped run was.

Several processes: torchrun -m manyeyes.cli.main train.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes._bounds import BatchSize, LearningRate, OutputFolder, PositiveInt, Seed, WorkerCount
from manyeyes.studies.replay_options import FileChecks

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as ProgressBars

    from manyeyes.datasets.base import Recording
    from manyeyes.datasets.missing import MissingFiles
    from manyeyes.models.detector.protocols import BoxDetector
    from manyeyes.training.maps.task import MapTask, MapTrainConfig
    from manyeyes.training.pose.feakm import FeakmTask, FeakmTrainConfig
    from manyeyes.training.pose.feakm_cache import FeatureCache
    from manyeyes.training.trainer import Task, TrainConfig


@dataclass(frozen=True)
class Options:
    """Which recording, which settings, where to."""

    data: Path
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = "train"
    """Which split of a dataset: a folder inside it."""
    preset: str = "costr-small/stage1"
    """Settings by name; an unknown name lists the known ones."""
    out: OutputFolder | None = None
    """Folder of the run, runs/PRESET by default: weights.safetensors, log.jsonl, loss.png, train.json, last.pt to go on from."""
    seed: Seed = 0
    """Of weights, samples and augmentation."""
    steps: PositiveInt | None = None
    """Steps of the optimiser, instead of the preset's."""
    batch: BatchSize | None = None
    """Samples a step over all processes, instead of the preset's."""
    learning_rate: LearningRate | None = None
    """Instead of the preset's."""
    fusion: str | None = None
    """Fusion module of a detector by name, one of your own too, instead of the preset's; an unknown name lists the known ones."""
    weights: tuple[Path, ...] = ()
    """Weights to begin from instead of random ones, such as those of the stage before. Of a map model several, each what it has in
    common with the preset, the first before the others. For feakm and feakm-paper the detector whose view they match, a shipped
    one by default."""
    threads: WorkerCount = 1
    """Threads of torch in each process; the result is the same only for the same number."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Train a model of a preset."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    from manyeyes._lock import hold_folder

    config, out = make_config(options), options.out or Path("runs") / options.preset
    torch.set_num_threads(options.threads)
    is_distributed = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if is_distributed:
        dist.init_process_group("gloo")
    is_first = not is_distributed or dist.get_rank() == 0
    try:
        with hold_folder(out) if is_first else nullcontext():
            _train(options, config, out, Console(quiet=not is_first))
    finally:
        if is_distributed:
            dist.destroy_process_group()


def make_config(options: Options) -> TrainConfig:
    """Make the configuration of the preset with what the options replace.

    Raises:
        ConfigError: the preset is unknown, takes only one file of weights, or has no fusion module.
    """
    from manyeyes.datatypes import ConfigError
    from manyeyes.training.maps.task import MapTrainConfig
    from manyeyes.training.presets import TRAINING_PRESETS

    if options.preset not in TRAINING_PRESETS:
        raise ConfigError(f"No training preset {options.preset!r}; choose one of {', '.join(TRAINING_PRESETS)}.")
    config = TRAINING_PRESETS[options.preset]
    if len(options.weights) > 1 and not isinstance(config, MapTrainConfig):
        raise ConfigError(f"--weights takes one file for {options.preset}; got {len(options.weights)}.")
    if options.fusion is not None:
        config = _with_fusion(config, options.fusion)
    given = {name: getattr(options, name) for name in ("steps", "batch", "learning_rate")}
    return replace(config, **{name: value for name, value in given.items() if value is not None})


def _with_fusion(config: TrainConfig, fusion: str) -> TrainConfig:
    from manyeyes.datatypes import ConfigError
    from manyeyes.models.fusion.registry import get_fusion
    from manyeyes.training.detector.task import DetectorTrainConfig

    if not isinstance(config, DetectorTrainConfig):
        raise ConfigError("--fusion is for presets of a detector; this one has no fusion module by name.")
    get_fusion(fusion)
    return replace(config, detector=replace(config.detector, fusion=fusion))


def _train(options: Options, config: TrainConfig, out: Path, console: Console) -> None:
    from manyeyes._io import remove_unfinished
    from manyeyes.studies import provenance
    from manyeyes.studies.map_recordings import open_sensor_recording
    from manyeyes.studies.recordings import check_files
    from manyeyes.training.maps.task import MapTrainConfig
    from manyeyes.training.trainer import Progress, Trainer
    from manyeyes.viz.loss_curve import save_loss_curve
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.table import missing_footer

    sensors = config.map_model.bev.sensors if isinstance(config, MapTrainConfig) else ("lidar",)
    recording = open_sensor_recording(options.data, options.split, sensors)
    missing = check_files(recording, options.checks, console)
    if not console.quiet:
        remove_unfinished(out, below=False)
    with make_progress_bars(console) as bars:
        task = _make_task(options, config, recording, missing, bars)
        settings = {"options": options, "training": task.config}
        origin = provenance.collect_provenance(settings, options.seed)
        trainer = Trainer(task, out)
        row = bars.add_task("Training", total=task.steps)

        def report(at: Progress) -> None:
            shown = [f"{name} {at.terms[name]:.2f}" for name in task.shown_terms]
            bars.update(row, completed=at.step, description=", ".join((f"loss {at.loss:.3f}", *shown)))

        weights = trainer.run({name: origin[name] for name in ("command", "versions", "git_commit")}, report)
    if console.quiet:
        return
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {"weights": weights.name, "loss": trainer.loss, "seconds": trainer.seconds, "missing": missing}
    provenance.write_json(out / "train.json", result, settings, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)


def _make_task(
    options: Options, config: TrainConfig, recording: Recording, missing: MissingFiles, bars: ProgressBars
) -> Task[Any, Any, Any]:
    from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
    from manyeyes.training.maps.task import MapTrainConfig
    from manyeyes.training.pose.feakm import FeakmTrainConfig

    if isinstance(config, DetectorTrainConfig):
        return DetectorTask(config, recording, options.seed, *options.weights)
    if isinstance(config, MapTrainConfig):
        return _make_map_task(options, config, recording)
    assert isinstance(config, FeakmTrainConfig)
    return _make_feakm_task(options, config, recording, missing, bars)


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
    digest = hashlib.blake2b(
        f"{options.data.resolve()}|{options.split}{missing_key}".encode(), digest_size=4
    ).hexdigest()
    row = bars.add_task("Detecting", total=len(select_snapshots(recording)))
    cache = None
    for cache in build_cache(recording, detector, Path("runs") / "views" / digest):
        bars.update(row, completed=len(cache.snapshots))
    assert cache is not None  # select_snapshots refuses a recording without a snapshot
    return cache
