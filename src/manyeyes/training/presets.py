# SPDX-License-Identifier: Apache-2.0
"""Named training configurations of all tasks."""

from __future__ import annotations

from manyeyes.training.detector.fusion_presets import (
    EARLY_TRAINING_PRESETS,
    FUSION_PLANS,
    FUSION_TRAINING_PRESETS,
)
from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.detector.presets import DETECTOR_PLANS, DETECTOR_TRAINING_PRESETS
from manyeyes.training.maps.presets import MAP_TRAINING_PRESETS
from manyeyes.training.pose.candidate_verifier import CANDIDATE_VERIFIER_TRAINING_PRESETS
from manyeyes.training.pose.feakm import FEAKM_TRAINING_PRESETS
from manyeyes.training.trainer import TrainConfig

TRAINING_PRESETS: dict[str, TrainConfig] = {
    **DETECTOR_TRAINING_PRESETS,
    **FUSION_TRAINING_PRESETS,
    **EARLY_TRAINING_PRESETS,
    **FEAKM_TRAINING_PRESETS,
    **CANDIDATE_VERIFIER_TRAINING_PRESETS,
    **MAP_TRAINING_PRESETS,
}

TRAINING_PLANS: dict[str, TrainPlan] = {**DETECTOR_PLANS, **FUSION_PLANS}
"""Plans of several stages by name; no name is that of a preset of one stage."""
