# SPDX-License-Identifier: Apache-2.0
"""Trains a detector or a map model on a recording, or FeaKM on what a detector sees; goes on where a stopped run was.

Several processes (not for FeaKM): torchrun -m manyeyes.cli.main train.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes.cli.train_options import Options

if TYPE_CHECKING:
    from manyeyes.datasets.missing import MissingFiles


def main(options: Options) -> None:
    """Train a model of a preset."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    from manyeyes.cli import train_maps as train_map, train_pose as train_feakm
    from manyeyes.datatypes import ConfigError
    from manyeyes.studies.recordings import check_files, open_recording
    from manyeyes.training.detector.presets import TRAINING_PRESETS
    from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
    from manyeyes.training.pose.feakm import FEAKM_TRAINING_PRESETS

    if len(options.weights) > 1 and options.preset not in MAP_TRAINING_PRESETS:
        raise ConfigError(f"--weights takes one file for {options.preset}; got {len(options.weights)}.")
    if options.preset in FEAKM_TRAINING_PRESETS:
        return train_feakm.main(options, Console())
    if options.preset in MAP_TRAINING_PRESETS:
        return train_map.main(options)
    if options.preset not in TRAINING_PRESETS:
        known = ", ".join((*TRAINING_PRESETS, *FEAKM_TRAINING_PRESETS, *MAP_TRAINING_PRESETS))
        raise ConfigError(f"No training preset {options.preset!r}; choose one of {known}.")
    overrides = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    config = replace(TRAINING_PRESETS[options.preset], **{k: v for k, v in overrides.items() if v is not None})
    torch.set_num_threads(options.threads)
    recording = open_recording(options.data, options.split)
    is_distributed = int(os.environ.get("WORLD_SIZE", "1")) > 1
    missing = check_files(recording, options.checks, Console(quiet=int(os.environ.get("RANK", "0")) > 0))
    if is_distributed:
        dist.init_process_group("gloo")
    try:
        _train(options, config, recording, missing, Console(quiet=is_distributed and dist.get_rank() > 0))
    finally:
        if is_distributed:
            dist.destroy_process_group()


def _train(options: Options, config: Any, recording: Any, missing: MissingFiles, console: Any) -> None:
    from manyeyes.studies import provenance
    from manyeyes.training.detector.loop import DetectorProgress, train_detector
    from manyeyes.viz.loss_curve import save_loss_curve
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.table import missing_footer

    out = options.out or Path("runs") / options.preset
    origin = provenance.collect_provenance({"options": options, "training": config}, options.seed)
    card = {"command": origin["command"], "versions": origin["versions"], "git_commit": origin["git_commit"]}
    last_progress: list[DetectorProgress] = []
    with make_progress_bars(console) as progress:
        task = progress.add_task("Training", total=None)

        def report(at: DetectorProgress) -> None:
            progress.update(task, total=at.steps, completed=at.step, description=f"loss {at.loss:.3f}")
            last_progress[:] = [at]

        weights = train_detector(config, recording, out, options.seed, card, report, *options.weights)
    if console.quiet:
        return
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {
        "weights": weights.name,
        "loss": last_progress[0].loss if last_progress else None,
        "seconds": last_progress[0].seconds if last_progress else None,
        "missing": missing,
    }
    provenance.write_json(out / "train.json", result, {"options": options, "training": config}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)
