# SPDX-License-Identifier: Apache-2.0
"""Training of fusions that are compared: one base without any fusion, then equal steps for every fusion, ours included.

stage-a: the schedule of costr-small, of which every view is trained by itself. ``fusion/NAME`` and ``fusion/NAME/bare`` start from
its weights, add a fusion drawn from the seed, and train everything on, with the same optimiser, steps, samples and degradation. A
bare fusion has no history, so that its samples have none.
``early`` trains the row of early fusion alike: FAST's recipe on merged clouds.
``stage-c/NAME``: 10,000 steps from random weights, with the same samples.
``table3/ROW``: rows of CoSTr's Table III, 2,000 steps from random weights each: no row starts with trained parts that another
lacks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.samples import DegradationConfig
from manyeyes.training.detector.task import DetectorTrainConfig

STEPS = 2000
"""Of every fusion and of every row of Table III."""
STAGE_C_STEPS = 10_000
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
    """A row of CoSTr's Table III: its fusion, and what of the detector differs from costr-small."""

    fusion: str
    changes: dict[str, Any]


_FINE_ONLY = replace(_FINAL.detector.encoder, use_coarse_strides=False, prune_strides=())
_NO_BLOCKS = {"dast": replace(_FINAL.detector.dast, blocks=0)}
_SEPARATE_BOTH = {
    "dast": replace(_FINAL.detector.dast, separate_weights=True),
    "fusion_attention": replace(_FINAL.detector.fusion_attention, separate_weights=True),
}

TABLE3_ROWS = {
    "none": TableRow("max", {"encoder": _FINE_ONLY, **_NO_BLOCKS}),
    "se": TableRow("max", _NO_BLOCKS),
    "se-dast": TableRow("max", {}),
    "se-dast-self-attention": TableRow("self-attention", {}),
    "se-fast": TableRow("fast", _NO_BLOCKS),
    "se-dast-fast": TableRow("fast", {}),
    "se-dast-fast-separate": TableRow("fast", _SEPARATE_BOTH),
}
"""Rows by name; the last one has separate weights for each density level (Eq. 5)."""


def _stage_b(fusion: str, **changes: Any) -> DetectorTrainConfig:
    config = replace(_STAGE_B, detector=replace(_STAGE_B.detector, fusion=fusion, **changes))
    if fusion.removesuffix("/bare") == "disconet":
        config = replace(config, loss=replace(config.loss, distillation=DISTILLATION))
    if not fusion.endswith("/bare"):
        return config
    return replace(config, degradation=replace(config.degradation, ego_history=0, sender_history=0))


def _from_random_weights(fusion: str, steps: int, **changes: Any) -> DetectorTrainConfig:
    """Return steps of the whole detector from random weights, with the samples of stage B."""
    config = replace(_stage_b(fusion, **changes), steps=steps, learning_rate=1.5e-3, warmup_steps=200)
    # Random weights teach nothing.
    config = replace(config, loss=replace(config.loss, distillation=0.0))
    return replace(config, prune_warmup_start=0.02, prune_warmup_end=0.10)


def _early() -> DetectorTrainConfig:
    """Return FAST's recipe with merged clouds in four of five samples (elsewhere one of five); the others teach memory."""
    config = _stage_b("fast")
    return replace(config, augment=replace(config.augment, early_fusion_prob=EARLY_FUSION_PROB))


def _stage_a() -> TrainPlan:
    """Return the stages of costr-small without a fusion: that of stage-a has no weights, and is not computed."""
    stages = []
    for number in range(1, 5):
        config = DETECTOR_TRAINING_PRESETS[f"costr-small/stage{number}"]
        detector = replace(config.detector, fusion="max/bare")
        loss = replace(config.loss, fusion_weight=0.0)
        stages.append(
            (f"stage{number}", replace(config, detector=detector, degradation=DegradationConfig(), loss=loss))
        )
    return TrainPlan(tuple(stages), codebook=None)


FUSION_TRAINING_PRESETS: dict[str, DetectorTrainConfig] = {
    **{f"fusion/{name}": _stage_b(name) for name in INSIDE_FUSIONS},
    **{f"fusion/{name}/bare": _stage_b(f"{name}/bare") for name in BARE_FUSIONS},
    **{f"stage-c/{name}": _from_random_weights(name, STAGE_C_STEPS) for name in STAGE_C_FUSIONS},
    **{f"table3/{name}": _from_random_weights(row.fusion, STEPS, **row.changes) for name, row in TABLE3_ROWS.items()},
}
EARLY_TRAINING_PRESETS: dict[str, DetectorTrainConfig] = {"early": _early()}
"""The row of early fusion, by the strategies ``early`` and ``early-temporal``."""
FUSION_PLANS: dict[str, TrainPlan] = {"stage-a": _stage_a()}
