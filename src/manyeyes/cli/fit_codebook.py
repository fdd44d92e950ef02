# SPDX-License-Identifier: Apache-2.0
"""Fits a codebook to trained weights, so that their tokens can be sent as a few bytes (--token-encoding codebook)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manyeyes._bounds import OutputFile, PositiveInt, Seed, StageCount
from manyeyes.studies.replay_options import FileChecks


@dataclass(frozen=True)
class Options:
    """Which weights, which scenes, where to."""

    data: Path
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    out: OutputFile
    """The file of the new weights; it may be the old one."""
    weights: Path
    """Weights that 'manyeyes train' wrote. They are kept as they are; a codebook that they have is replaced."""
    split: str | None = "train"
    """Which split of a dataset: a folder inside it."""
    stages: StageCount = 4
    """Bytes for the features of a token."""
    frame_stride: PositiveInt = 10
    """Use every n-th of the evaluated frames."""
    seed: Seed = 0
    """Of the first centres."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""


def main(options: Options) -> None:
    """Fit a codebook and write weights that hold it."""
    import torch
    from rich.console import Console

    from manyeyes.datasets.registry import open_recording
    from manyeyes.models import checkpoint
    from manyeyes.models.detector.codebook import CodebookConfig
    from manyeyes.studies import provenance
    from manyeyes.studies.recordings import check_files
    from manyeyes.training.detector.codebook import CollectionProgress, fit_codebook
    from manyeyes.viz.progress import track

    torch.set_num_threads(1)
    detector, card = checkpoint.load(options.weights), checkpoint.read_card(options.weights)
    half = any(v.dtype == torch.float16 for v in checkpoint.read_state(options.weights).values())
    recording = open_recording(options.data, options.split)
    console, tokens = Console(), 0
    missing = check_files(recording, options.checks, console)
    with track(console, "Frames") as show:

        def report(progress: CollectionProgress) -> None:
            nonlocal tokens
            tokens = progress.tokens
            show(progress.frames, progress.total)

        fitted = fit_codebook(
            detector, recording, options.seed, CodebookConfig(options.stages), options.frame_stride, report
        )
    origin = provenance.collect_provenance({"options": options}, options.seed)
    codebook_card = {
        "command": origin["command"],
        "seed": options.seed,
        "tokens": tokens,
        "git_commit": origin["git_commit"],
    }
    codebook_card["missing"] = provenance.to_plain(missing)
    checkpoint.save(fitted, options.out, card | {"codebook": codebook_card}, half)
    width = fitted.codebook.width if fitted.codebook else 0
    console.print(
        f"{options.out}: a token is {width} bytes before entropy coding, fitted to {tokens:,}", soft_wrap=True
    )
