# SPDX-License-Identifier: Apache-2.0
"""Options of evaluations and of studies of detection and poses."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from manyeyes._bounds import NonNegativeFloat, NonNegativeInt, PositiveInt, Seed
from manyeyes.studies.replay_options import FileChecks, ReplayOptions


@dataclass(frozen=True)
class Options:
    """Which recording, which methods, whose rules."""

    data: Path
    """A data set, a folder of scenarios, or one scenario: OPV2V, DAIR-V2X, Argoverse 2, or the layout of a registered reader."""
    split: str | None = None
    """Which split of a data set, such as test: a folder inside it; with DAIR-V2X one of its split file."""
    out: Path = Path("out/evaluate")
    """Folder for results.json and results.md."""
    protocol: str = "global-sort"
    """Evaluation protocol: global-sort, opencood, coalign, sparsealign; on DAIR-V2X also dair, heal-dair, costr-dair,
    sparsealign-dair."""
    noise_xy_m: NonNegativeFloat = 0.0
    """Standard deviation of errors of collaborators' claimed positions."""
    noise_yaw_deg: NonNegativeFloat = 0.0
    """Standard deviation of errors of collaborators' claimed headings, degrees."""
    all_egos: bool = False
    """Judge every agent as ego, not only the first."""
    seed: Seed = 0
    """Of losses, jitter and pose errors."""
    workers: PositiveInt = os.cpu_count() or 1
    """How many processes share the scenarios; results do not depend on it."""
    timing_frames: NonNegativeInt = 10
    """Frames of the first scenario on which each method is timed by itself; 0 leaves times out."""
    replay_options: ReplayOptions = field(default_factory=ReplayOptions)
    """How agents collaborate."""
    frame_stride: PositiveInt = 1
    """Judge each so many-th frame of those that the recording judges."""
    study: str | None = None
    """robustness, bandwidth, num-agents, ablation, shared-bandwidth, pose-noise-ap, pose-estimation, feakm or qualitative; finished
    results are stored under --out."""
    perturbations: tuple[str, ...] = ()
    """Those that the studies 'robustness' and 'pose-noise-ap' play, by the names of their tables, such as "0.4 s" "30 % lost"
    or "2°, 2 m" "0.8 m"; by default all."""
    budgets: tuple[PositiveInt, ...] = ()
    """Budgets in bytes: of a message in the study 'bandwidth', of all messages of a snapshot in 'shared-bandwidth'; by default the
    study's own."""
    token_selection: tuple[str, ...] = ()
    """Methods that choose tokens, in the studies 'bandwidth' and 'shared-bandwidth'; by default intermediate,
    intermediate-confidence, intermediate-random."""
    token_encodings: tuple[str, ...] = ()
    """Ways to write tokens, in the study 'bandwidth'; by default all."""
    correctors: tuple[str, ...] = ()
    """Pose correctors of the studies 'pose-noise-ap' and 'pose-estimation', among them feakm or a file of its weights; by default
    the study's own."""
    checkpoints: tuple[str, ...] = ()
    """Weights that the study 'ablation' compares, and baselines of 'robustness' and 'pose-noise-ap', as name=weights.safetensors;
    of 'feakm' each as name=detector.safetensors,net.safetensors."""
    checks: FileChecks = field(default_factory=FileChecks)
    """What is done about missing files."""
