# SPDX-License-Identifier: Apache-2.0
"""Trains a map model on a recording of towns whose true maps are known; the part of the command train for these presets."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manyeyes.cli.train_options import Options


def main(options: Options) -> None:
    """Train, or go on; several processes by torchrun."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    is_distributed = int(os.environ.get("WORLD_SIZE", "1")) > 1
    torch.set_num_threads(options.threads)
    if is_distributed:
        dist.init_process_group("gloo")
    try:
        _train(options, Console(quiet=is_distributed and dist.get_rank() > 0))
    finally:
        if is_distributed:
            dist.destroy_process_group()


def _train(options: Options, console: Any) -> None:
    from manyeyes.models import pretrained
    from manyeyes.simulator.scene.towns import TOWN_SPLIT
    from manyeyes.studies import provenance
    from manyeyes.studies.map_recordings import load_true_maps, open_sensor_recording
    from manyeyes.studies.recordings import check_files
    from manyeyes.training.maps.loop import MapProgress, train_map_model
    from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
    from manyeyes.training.maps.samples import TileStream
    from manyeyes.viz.loss_curve import save_loss_curve
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.table import missing_footer

    overrides = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    config = replace(MAP_TRAINING_PRESETS[options.preset], **{k: v for k, v in overrides.items() if v is not None})
    recording = open_sensor_recording(options.data, options.split, config.map_model.bev.sensors)
    missing = check_files(recording, options.checks, console)
    held_out = tuple(town for side, towns in TOWN_SPLIT.items() if side != "train" for town in towns)
    samples = TileStream(recording, load_true_maps(recording), config.map_model, config.augment, options.seed, held_out)
    start = [pretrained.load_map_model_state(weights) for weights in options.weights]
    out = options.out or Path("runs") / options.preset
    origin = provenance.collect_provenance({"options": options, "training": config}, options.seed)
    card = {name: origin[name] for name in ("command", "versions", "git_commit")}
    last_progress: list[MapProgress] = []
    with make_progress_bars(console) as progress:
        task = progress.add_task("Training", total=config.steps)

        def report(at: MapProgress) -> None:
            progress.update(task, completed=at.step, description=f"loss {at.loss:.3f}")
            last_progress[:] = [at]

        weights = train_map_model(config, samples, out, options.seed, card, report, start)
    if console.quiet:
        return
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {"weights": weights.name, "loss": last_progress[0].loss if last_progress else None, "missing": missing}
    provenance.write_json(out / "train.json", result, {"options": options, "training": config}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)
