# SPDX-License-Identifier: Apache-2.0
"""Calibrates the scores of trained weights: a score becomes the fraction of such boxes that are correct (IoU 0.5).

The maps, one for each form of result, and the score from which boxes are drawn are stored in the weights. AP is unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manyeyes._bounds import OutputFile, PositiveInt, WorkerCount
from manyeyes.studies.replay_options import FileChecks


@dataclass(frozen=True)
class Options:
    """Which weights, which scenes, where to."""

    data: tuple[Path, ...]
    """Recordings that the weights were not trained on: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    out: OutputFile
    """The file of the new weights; it may be the old one."""
    weights: str
    """Shipped weights by name, or a .safetensors file. Earlier calibration is replaced."""
    split: str | None = "val"
    """Which split of every dataset: a folder inside it."""
    max_frames: PositiveInt = 300
    """Evaluated frames that are used at most, spread evenly."""
    workers: WorkerCount = 1
    """Processes that share the scenarios; the result does not depend on it."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Fit the maps of scores and write weights that hold them."""
    from functools import partial

    import torch
    from rich.console import Console

    from manyeyes.datasets.base import iter_eval_frames
    from manyeyes.datasets.mixed import open_recordings
    from manyeyes.models import checkpoint, pretrained
    from manyeyes.models.detector.fold_norms import fold_norms
    from manyeyes.models.score_calibration import CARD_KEY
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_files
    from manyeyes.training.detector.score_calibration import calibrate_detector
    from manyeyes.viz.progress import track

    torch.set_num_threads(1)
    console, opener = Console(), partial(open_recordings, options.data, options.split)
    recording = opener()
    missing = check_files(recording, options.checks, console)
    stride = max(1, sum(1 for _ in iter_eval_frames(recording)) // options.max_frames)
    with pretrained.open_detector_file(options.weights) as path:
        model, card = checkpoint.load(path), checkpoint.read_card(path)
        half = any(v.dtype == torch.float16 for v in checkpoint.read_state(path).values())
    model.score_calibration = None
    with track(console, "Calibrating", len(recording.scenarios)) as report:
        calibration, boxes = calibrate_detector(opener, fold_norms(model), stride, options.workers, report)
    origin = provenance.collect_provenance({"options": options}, None)
    about = {
        "command": origin["command"],
        "git_commit": origin["git_commit"],
        "boxes": {form: len(found.score) for form, found in boxes.items()},
        "missing": provenance.to_plain(missing),
    }
    checkpoint.save(model, options.out, card | {CARD_KEY: calibration.to_card(), "calibrated_on": about}, half)
    for form in boxes:
        score_map = calibration.get(form)
        assert score_map is not None
        console.print(f"{form}: {len(boxes[form].score):,} boxes; drawn from a score of {score_map.min_drawn:.2f}")
    console.print(str(options.out), highlight=False, soft_wrap=True)
