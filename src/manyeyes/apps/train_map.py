# SPDX-License-Identifier: Apache-2.0
"""Trains a map model on a recording of towns whose true maps are known; the part of the verb train that its presets ask for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manyeyes.apps.train import Options
    from manyeyes.datasets.dair_v2x import DairRecording
    from manyeyes.datasets.opv2v import Opv2vRecording
    from manyeyes.datasets.recording import Recording
    from manyeyes.datatypes.map_element import MapElements


def main(options: Options) -> None:
    """Train, or go on; several processes by torchrun."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    several = int(os.environ.get("WORLD_SIZE", "1")) > 1
    torch.set_num_threads(options.threads)
    if several:
        dist.init_process_group("gloo")
    try:
        _train(options, Console(quiet=several and dist.get_rank() > 0))
    finally:
        if several:
            dist.destroy_process_group()


def _train(options: Options, console: Any) -> None:
    from manyeyes.apps import provenance
    from manyeyes.apps.recordings import check_files
    from manyeyes.apps.showcase import bars
    from manyeyes.apps.viewer.loss_curve import save_loss_curve
    from manyeyes.apps.viewer.table import missing_footer
    from manyeyes.models import zoo
    from manyeyes.simulator.towns import TOWN_SPLIT
    from manyeyes.training.map_loop import MapProgress, train_mapper
    from manyeyes.training.map_presets import MAP_TRAINING
    from manyeyes.training.map_samples import TileStream

    asked = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    config = replace(MAP_TRAINING[options.preset], **{k: v for k, v in asked.items() if v is not None})
    recording = open_looks(options.data, options.split, config.mapper.bev.sensors)
    missing = check_files(recording, options.checks, console)
    held_out = tuple(town for side, towns in TOWN_SPLIT.items() if side != "train" for town in towns)
    samples = TileStream(recording, true_maps(recording), config.mapper, config.augment, options.seed, held_out)
    start = [zoo.mapper_state(weights) for weights in options.weights]
    out = options.out or Path("runs") / options.preset
    origin = provenance.provenance({"options": options, "training": config}, options.seed)
    card = {name: origin[name] for name in ("command", "versions", "git_commit")}
    last: list[MapProgress] = []
    with bars(console) as progress:
        task = progress.add_task("Training", total=config.steps)

        def report(at: MapProgress) -> None:
            progress.update(task, completed=at.step, description=f"loss {at.loss:.3f}")
            last[:] = [at]

        weights = train_mapper(config, samples, out, options.seed, card, report, start)
    if console.quiet:
        return
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {"weights": weights.name, "loss": last[0].loss if last else None, "missing": missing}
    provenance.write_json(out / "train.json", result, {"options": options, "training": config}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)


def open_looks(data: Path, split: str | None, sensors: Sequence[str]) -> Opv2vRecording | DairRecording:
    """The recording with what these sensors took: pictures are read where a model has cameras, and must then be there."""
    from manyeyes.apps.recordings import open_recording
    from manyeyes.datatypes import ConfigError

    recording = open_recording(data, split, images="camera" in sensors)
    if "camera" in sensors and not has_pictures(recording):
        raise ConfigError(
            f"{data}: no pictures in {recording.scenarios[0]}, and the model has cameras; give a recording of 'manyeyes simulate "
            "--preset streets-pictures' (or any preset with --cameras), or a model of agents with LiDAR."
        )
    return recording


def has_pictures(recording: Recording) -> bool:
    """Whether any agent of the first snapshot has; the recording reads them."""
    return any(frame.images for frame in recording.snapshot(recording.scenarios[0], 0).frames)


def true_maps(recording: Recording) -> dict[str, MapElements]:
    """The true map of every town that the recording's scenarios are named after, in its world frame; edges are the pavement's."""
    from manyeyes.maps.truth import TruthPolicy, map_truth
    from manyeyes.simulator.towns import GENERATED, TOWNS, load_town

    lower = {town.lower(): town for town in TOWNS}
    named = sorted({scenario.rsplit("_", 1)[0] for scenario in recording.scenarios})
    towns = [name if name.startswith(GENERATED) else lower.get(name, name) for name in named]
    return {town: map_truth(load_town(town), TruthPolicy(boundary="pavement")) for town in towns}
