# SPDX-License-Identifier: Apache-2.0
"""Trains a detector or a map model on a recording, or FeaKM on what a detector sees; goes on where a stopped run was.

Several processes (not for FeaKM): torchrun -m manyeyes.apps.cli train.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes.apps.playing import FileChecks

if TYPE_CHECKING:
    from manyeyes.datasets.missing import MissingFiles


@dataclass(frozen=True)
class Options:
    """Which recording, which settings, where to."""

    data: Path
    """A dataset in OPV2V's layout, a folder of scenarios, or one scenario; or a root in DAIR-V2X's layout."""
    split: str | None = "train"
    """Which split of a dataset: a folder inside it."""
    preset: str = "costr-small"
    """Settings by name; an unknown name lists the known ones."""
    out: Path | None = None
    """Folder of the run, runs/PRESET by default: weights.safetensors, log.jsonl, loss.png, train.json, last.pt to go on from."""
    seed: int = 0
    """Of weights, samples and augmentation."""
    steps: int | None = None
    """Steps of the optimiser, instead of the preset's."""
    batch: int | None = None
    """Samples a step over all processes, instead of the preset's."""
    learning_rate: float | None = None
    """Instead of the preset's."""
    weights: tuple[Path, ...] = ()
    """Weights to begin from instead of random ones, such as those of the stage before. Of a map model several, each what it has in
    common with the preset, the first before the others. For feakm and feakm-paper the detector whose view they match, a shipped
    one by default."""
    threads: int = 1
    """Threads of torch in each process; the result is the same only for the same number."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """The verb."""
    import torch
    import torch.distributed as dist
    from rich.console import Console

    from manyeyes.apps import train_feakm, train_map
    from manyeyes.apps.recordings import check_files, open_recording
    from manyeyes.datatypes import ConfigError
    from manyeyes.training.feakm import FEAKM_TRAINING
    from manyeyes.training.map_presets import MAP_TRAINING
    from manyeyes.training.presets import TRAINING_PRESETS

    if len(options.weights) > 1 and options.preset not in MAP_TRAINING:
        raise ConfigError(f"--weights takes one file for {options.preset}; got {len(options.weights)}.")
    if options.preset in FEAKM_TRAINING:
        return train_feakm.main(options, Console())
    if options.preset in MAP_TRAINING:
        return train_map.main(options)
    if options.preset not in TRAINING_PRESETS:
        known = ", ".join((*TRAINING_PRESETS, *FEAKM_TRAINING, *MAP_TRAINING))
        raise ConfigError(f"No training preset {options.preset!r}; choose one of {known}.")
    asked = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    config = replace(TRAINING_PRESETS[options.preset], **{k: v for k, v in asked.items() if v is not None})
    torch.set_num_threads(options.threads)
    recording = open_recording(options.data, options.split)
    several = int(os.environ.get("WORLD_SIZE", "1")) > 1
    missing = check_files(recording, options.checks, Console(quiet=int(os.environ.get("RANK", "0")) > 0))
    if several:
        dist.init_process_group("gloo")
    try:
        _train(options, config, recording, missing, Console(quiet=several and dist.get_rank() > 0))
    finally:
        if several:
            dist.destroy_process_group()


def _train(options: Options, config: Any, recording: Any, missing: MissingFiles, console: Any) -> None:
    from manyeyes.apps import provenance
    from manyeyes.apps.showcase import bars
    from manyeyes.apps.viewer.loss_curve import save_loss_curve
    from manyeyes.apps.viewer.table import missing_footer
    from manyeyes.training.loop import Progress, train

    out = options.out or Path("runs") / options.preset
    origin = provenance.provenance({"options": options, "training": config}, options.seed)
    card = {"command": origin["command"], "versions": origin["versions"], "git_commit": origin["git_commit"]}
    last: list[Progress] = []
    with bars(console) as progress:
        task = progress.add_task("Training", total=None)

        def report(at: Progress) -> None:
            progress.update(task, total=at.steps, completed=at.step, description=f"loss {at.loss:.3f}")
            last[:] = [at]

        weights = train(config, recording, out, options.seed, card, report, *options.weights)
    if console.quiet:
        return
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {
        "weights": weights.name,
        "loss": last[0].loss if last else None,
        "seconds": last[0].seconds if last else None,
        "missing": missing,
    }
    provenance.write_json(out / "train.json", result, {"options": options, "training": config}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)
