# SPDX-License-Identifier: Apache-2.0
"""Options of trainings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manyeyes._bounds import NonNegativeFloat, PositiveInt, Seed
from manyeyes.studies.replay_options import FileChecks


@dataclass(frozen=True)
class Options:
    """Which recording, which settings, where to."""

    data: Path
    """A dataset in OPV2V's layout, a folder of scenarios, or one scenario; or a root in DAIR-V2X's layout."""
    split: str | None = "train"
    """Which split of a dataset: a folder inside it."""
    preset: str = "costr-small/stage1"
    """Settings by name; an unknown name lists the known ones."""
    out: Path | None = None
    """Folder of the run, runs/PRESET by default: weights.safetensors, log.jsonl, loss.png, train.json, last.pt to go on from."""
    seed: Seed = 0
    """Of weights, samples and augmentation."""
    steps: PositiveInt | None = None
    """Steps of the optimiser, instead of the preset's."""
    batch: PositiveInt | None = None
    """Samples a step over all processes, instead of the preset's."""
    learning_rate: NonNegativeFloat | None = None
    """Instead of the preset's."""
    weights: tuple[Path, ...] = ()
    """Weights to begin from instead of random ones, such as those of the stage before. Of a map model several, each what it has in
    common with the preset, the first before the others. For feakm and feakm-paper the detector whose view they match, a shipped
    one by default."""
    threads: PositiveInt = 1
    """Threads of torch in each process; the result is the same only for the same number."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""
