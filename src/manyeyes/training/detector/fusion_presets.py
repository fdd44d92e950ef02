# SPDX-License-Identifier: Apache-2.0
"""Training of fusions that are compared: one base without any fusion, then equal steps for every fusion, ours included.

stage-a: the schedule of costr-small, of which every view is trained by itself. ``fusion/NAME`` and ``fusion/NAME/bare`` start from
its weights, add a fusion drawn from the seed, and train everything on, with the same optimiser, steps, samples and degradation. A
bare fusion has no history, so that its samples have none.
``early`` trains the row of early fusion alike: FAST's recipe on merged clouds.
``stage-c/NAME``: 10,000 steps from random weights.
``table3/ROW``: rows of CoSTr's Table III by the same recipe. The base of a row has its parts and no other: ``stage-a/BASE``, or
``stage-a`` where the parts are all there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.samples import DegradationConfig
from manyeyes.training.detector.task import DetectorTrainConfig

STEPS = 2000
INSIDE_FUSIONS = (
    "fast",
    "attfuse",
    "v2vnet",
    "v2x-vit",
    "max",
    "disconet",
    "where2comm",
    "sparsealign",
    "how2comm",
    "ermvp",
    "self-attention",
    "multi-scale",
    "shift/fast",
)
"""Fusions in mode inside; our own arm is shift/fast, FAST on aligned senders."""
BARE_FUSIONS = ("max", "attfuse", "v2vnet", "v2x-vit", "where2comm", "disconet", "sparsealign", "how2comm", "ermvp")
"""Fusions in mode bare: features alone are sent."""
DISTILLATION = 10.0
"""Weight of DiscoNet's distillation, a cell that student and teacher both have. CoAlign's code weighs 10^4 / C each cell of a dense
map; most of them are empty and alike."""
STAGE_C_FUSIONS = INSIDE_FUSIONS
"""Fusions with a preset that starts from random weights, to show whether the recipe decides the order."""

EARLY_FUSION_PROB = 0.8
"""Fraction of samples with merged clouds of the preset ``early``."""

_FINAL = DETECTOR_TRAINING_PRESETS["costr-small/stage4"]
_STAGE_B = replace(_FINAL, steps=STEPS, learning_rate=1e-3, warmup_steps=100, prune_warmup_end=0.001)


@dataclass(frozen=True)
class TableRow:
    """A row of CoSTr's Table III: the plan of its base, its fusion, and what of the detector differs from costr-small."""

    base: str
    fusion: str
    changes: dict[str, Any]

    @property
    def is_whole(self) -> bool:
        """Whether nothing but the fusion differs: the run is that of ``fusion/NAME``."""
        return not self.changes


_FINE_ONLY = replace(_FINAL.detector.encoder, use_coarse_strides=False, prune_strides=())
_NO_BLOCKS = {"dast": replace(_FINAL.detector.dast, blocks=0)}
_SEPARATE = replace(_FINAL.detector.dast, separate_weights=True)
_SEPARATE_BOTH = {
    "dast": _SEPARATE,
    "fusion_attention": replace(_FINAL.detector.fusion_attention, separate_weights=True),
}

TABLE3_ROWS = {
    "none": TableRow("stage-a/none", "max", {"encoder": _FINE_ONLY, **_NO_BLOCKS}),
    "se": TableRow("stage-a/se", "max", _NO_BLOCKS),
    "se-dast": TableRow("stage-a", "max", {}),
    "se-dast-self-attention": TableRow("stage-a", "self-attention", {}),
    "se-fast": TableRow("stage-a/se", "fast", _NO_BLOCKS),
    "se-dast-fast": TableRow("stage-a", "fast", {}),
    "se-dast-fast-separate": TableRow("stage-a/separate", "fast", _SEPARATE_BOTH),
}
"""Rows by name; the last one has separate weights for each density level (Eq. 5). Rows equal to ``fusion/NAME`` are that run."""


def _stage_b(fusion: str, **changes: Any) -> DetectorTrainConfig:
    config = replace(_STAGE_B, detector=replace(_STAGE_B.detector, fusion=fusion, **changes))
    if fusion.removesuffix("/bare") == "disconet":
        config = replace(config, loss=replace(config.loss, distillation=DISTILLATION))
    if not fusion.endswith("/bare"):
        return config
    return replace(config, degradation=replace(config.degradation, ego_history=0, sender_history=0))


def _stage_c(fusion: str) -> DetectorTrainConfig:
    """Return 10,000 steps of the whole detector from random weights, with the samples of stage B."""
    config = replace(_stage_b(fusion), steps=10_000, learning_rate=1.5e-3, warmup_steps=200)
    # Random weights teach nothing.
    config = replace(config, loss=replace(config.loss, distillation=0.0))
    return replace(config, prune_warmup_start=0.02, prune_warmup_end=0.10)


def _early() -> DetectorTrainConfig:
    """Return FAST's recipe with merged clouds in four of five samples (elsewhere one of five); the others teach memory."""
    config = _stage_b("fast")
    return replace(config, augment=replace(config.augment, early_fusion_prob=EARLY_FUSION_PROB))


def _stage_a(**changes: Any) -> TrainPlan:
    """Return the stages of costr-small without a fusion: that of stage-a has no weights, and is not computed."""
    stages = []
    for number in range(1, 5):
        config = DETECTOR_TRAINING_PRESETS[f"costr-small/stage{number}"]
        detector = replace(config.detector, fusion="max/bare", **changes)
        loss = replace(config.loss, fusion_weight=0.0)
        stages.append(
            (f"stage{number}", replace(config, detector=detector, degradation=DegradationConfig(), loss=loss))
        )
    return TrainPlan(tuple(stages), codebook=None)


FUSION_TRAINING_PRESETS: dict[str, DetectorTrainConfig] = {
    **{f"fusion/{name}": _stage_b(name) for name in INSIDE_FUSIONS},
    **{f"fusion/{name}/bare": _stage_b(f"{name}/bare") for name in BARE_FUSIONS},
    **{f"stage-c/{name}": _stage_c(name) for name in STAGE_C_FUSIONS},
    **{f"table3/{name}": _stage_b(row.fusion, **row.changes) for name, row in TABLE3_ROWS.items()},
}
EARLY_TRAINING_PRESETS: dict[str, DetectorTrainConfig] = {"early": _early()}
"""The row of early fusion, by the strategies ``early`` and ``early-temporal``."""
FUSION_PLANS: dict[str, TrainPlan] = {
    "stage-a": _stage_a(),
    "stage-a/none": _stage_a(**TABLE3_ROWS["none"].changes),
    "stage-a/se": _stage_a(**TABLE3_ROWS["se"].changes),
    "stage-a/separate": _stage_a(dast=_SEPARATE),
}
