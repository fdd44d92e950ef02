# SPDX-License-Identifier: Apache-2.0
"""Trains FeaKM's net on what a frozen detector sees; the part of the command train for these presets."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.progress import Progress

    from manyeyes.cli.train_options import Options
    from manyeyes.datasets.base import Recording
    from manyeyes.datasets.missing import MissingFiles
    from manyeyes.models.detector.detector import Detector
    from manyeyes.training.pose.feakm import FeakmTrainConfig
    from manyeyes.training.pose.feakm_cache import FeatureCache


def main(options: Options, console: Any) -> None:
    """See the recording once with the detector, or find that done; then train, or go on."""
    import torch

    from manyeyes.models import pretrained
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_files, open_recording
    from manyeyes.training.pose.feakm import FEAKM_TRAINING_PRESETS, MatchProgress, train_feakm
    from manyeyes.viz.loss_curve import save_loss_curve
    from manyeyes.viz.progress import make_progress_bars
    from manyeyes.viz.table import missing_footer

    overrides = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    config = replace(FEAKM_TRAINING_PRESETS[options.preset], **{k: v for k, v in overrides.items() if v is not None})
    torch.set_num_threads(options.threads)
    detector = pretrained.load(options.weights[0] if options.weights else pretrained.DEFAULT_DETECTOR)
    config = fit_to_detector(config, detector)
    out = options.out or Path("runs") / options.preset
    origin = provenance.collect_provenance({"options": options, "training": config}, options.seed)
    card = {name: origin[name] for name in ("command", "versions", "git_commit")}
    last_progress: list[MatchProgress] = []
    recording = open_recording(options.data, options.split)
    missing = check_files(recording, options.checks, console)
    with make_progress_bars(console) as progress:
        cache = _load_or_cache_features(options, recording, missing, detector, progress)
        task = progress.add_task("Training", total=config.steps)

        def report(at: MatchProgress) -> None:
            description = f"loss {at.loss:.3f}, recall {at.recall:.2f}, precision {at.precision:.2f}"
            progress.update(task, completed=at.step, description=description)
            last_progress[:] = [at]

        weights = train_feakm(config, cache, out, options.seed, card, report)
    save_loss_curve(out / "log.jsonl", out / "loss.png")
    result = {"weights": weights.name, "loss": last_progress[0].loss if last_progress else None, "missing": missing}
    provenance.write_json(out / "train.json", result, {"options": options, "training": config}, options.seed)
    if missing.count:
        console.print(missing_footer(missing.count, "train.json"), highlight=False, soft_wrap=True)
    console.print(f"{weights}; the loss over steps is in {out / 'loss.png'}", highlight=False, soft_wrap=True)


def fit_to_detector(config: FeakmTrainConfig, detector: Detector) -> FeakmTrainConfig:
    """The settings for this detector's views."""
    keypoints = replace(config.net.keypoints, in_channels=detector.encoder.out_channels)
    return replace(config, net=replace(config.net, keypoints=keypoints, detector=detector.fingerprint.hex()))


def _load_or_cache_features(
    options: Options, recording: Recording, missing: MissingFiles, detector: Detector, progress: Progress
) -> FeatureCache:
    """Kept under runs/views, by detector, data, split and missing files, so that both presets share it."""
    from manyeyes.training.pose.feakm_cache import build_cache, select_snapshots

    missing_key = f"|{missing}" if missing.count else ""
    digest = hashlib.blake2b(
        f"{options.data.resolve()}|{options.split}{missing_key}".encode(), digest_size=4
    ).hexdigest()
    task = progress.add_task("Seeing", total=len(select_snapshots(recording)))
    cache = None
    for cache in build_cache(recording, detector, Path("runs") / "views" / digest):
        progress.update(task, completed=len(cache.snapshots))
    assert cache is not None  # wanted refuses a recording without a snapshot
    return cache
