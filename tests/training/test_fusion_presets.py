# SPDX-License-Identifier: Apache-2.0
"""Presets of compared fusions: equal settings but for the fusion, and a base that every one of them starts from."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.fusion.registry import list_fusion_modules
from manyeyes.training.detector.fusion_presets import (
    BARE_FUSIONS,
    EARLY_TRAINING_PRESETS,
    FUSION_PLANS,
    FUSION_TRAINING_PRESETS,
    INSIDE_FUSIONS,
    STEPS,
    TABLE3_ROWS,
)
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, make_sample
from manyeyes.training.detector.step import loss_terms
from manyeyes.training.detector.targets import TargetConfig
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig


def test_every_fusion_has_a_preset_in_its_modes() -> None:
    own = {name for name in list_fusion_modules() if name != "own-mean"}
    assert {name for name in own if not name.endswith("/bare")} == set(INSIDE_FUSIONS)
    assert {f"{name}/bare" for name in BARE_FUSIONS} <= own


def _without_own_loss(config: DetectorTrainConfig) -> DetectorTrainConfig:
    """The preset without the loss that DiscoNet has of its own."""
    return replace(config, loss=replace(config.loss, distillation=0.0))


def test_presets_differ_in_the_fusion_alone() -> None:
    reference = FUSION_TRAINING_PRESETS["fusion/fast"]
    assert reference.steps == STEPS == 2000
    for name in INSIDE_FUSIONS:
        config = _without_own_loss(FUSION_TRAINING_PRESETS[f"fusion/{name}"])
        assert replace(config, detector=replace(config.detector, fusion="fast")) == reference
    for name in BARE_FUSIONS:
        config = _without_own_loss(FUSION_TRAINING_PRESETS[f"fusion/{name}/bare"])
        assert config.degradation == replace(reference.degradation, ego_history=0)
        rest = replace(config, degradation=reference.degradation, detector=reference.detector)
        assert rest == reference


def test_early_fusion_has_the_recipe_of_the_others_on_merged_clouds() -> None:
    reference, config = FUSION_TRAINING_PRESETS["fusion/fast"], EARLY_TRAINING_PRESETS["early"]
    assert config.augment.early_fusion_prob == 0.8 > 2 * reference.augment.early_fusion_prob
    assert replace(config, augment=reference.augment) == reference


def test_the_rows_of_table_3_differ_in_their_parts_alone() -> None:
    """Every row has the steps of the others, and stage C their recipe."""
    presets = {name: FUSION_TRAINING_PRESETS[f"table3/{name}"] for name in TABLE3_ROWS}
    reference = replace(FUSION_TRAINING_PRESETS["stage-c/fast"], steps=STEPS)
    assert presets["se-dast-fast"] == reference and STEPS == 2000
    for name, config in presets.items():
        assert replace(config, detector=reference.detector) == reference
        own, whole = config.detector, reference.detector
        parts = {"encoder": whole.encoder, "dast": whole.dast, "fusion": whole.fusion}
        assert replace(own, fusion_attention=whole.fusion_attention, **parts) == whole
        assert own.encoder.use_coarse_strides == name.startswith("se")
        assert (own.dast.blocks > 0) == ("dast" in name)
        assert own.dast.separate_weights == own.fusion_attention.separate_weights == name.endswith("separate")
    assert len({str(config.detector) for config in presets.values()}) == len(presets) == 7


@pytest.mark.parametrize("name", TABLE3_ROWS)
def test_a_row_of_table_3_starts_from_random_weights(name: str) -> None:
    first, second = (
        DetectorTask(FUSION_TRAINING_PRESETS[f"table3/{name}"], _Nothing(), seed).make_model() for seed in (0, 1)
    )
    drawn = [k for k, v in first.state_dict().items() if not torch.equal(v, second.state_dict()[k])]
    assert {"encoder", "fusion", "head"} <= {key.split(".")[0] for key in drawn}


@pytest.mark.parametrize("preset", [name for name in FUSION_TRAINING_PRESETS if name.startswith("fusion/")])
def test_a_preset_takes_every_tensor_of_its_base(preset: str, tmp_path) -> None:
    base = Detector(FUSION_PLANS["stage-a"].stages[-1][1].detector)
    path = tmp_path / "base.safetensors"
    checkpoint.save(base, path, {})
    model = DetectorTask(replace(FUSION_TRAINING_PRESETS[preset]), _Nothing(), start=path).make_model()
    begun, state = base.state_dict(), model.state_dict()
    assert begun.keys() <= state.keys()
    assert all(torch.equal(state[name], value) for name, value in begun.items())
    added = {name.split(".")[0] for name in state.keys() - begun.keys()}
    assert added <= {"fusion", "refine"}


class _Nothing:
    """A recording that nothing is read of."""


def test_the_base_is_trained_without_a_fusion(toy) -> None:
    """The loss is that of single-agent boxes, whose gradient it is, too."""
    config = FUSION_PLANS["stage-a"].stages[-1][1]
    assert config.loss.fusion_weight == 0 and config.degradation == DegradationConfig()
    assert sum(stage.steps for _, stage in FUSION_PLANS["stage-a"].stages) == 20600
    torch.manual_seed(0)
    model = Detector(replace(config.detector, fusion="fast"))
    model.eval()
    moments = [toy(agents_n=2, frames=3).snapshot("toy_0", i) for i in range(3)]
    sample = make_sample(moments, 0, config.detector.grid, AugmentConfig.none(), ("a", 1))
    alone, both = (loss_terms(model, [sample], TargetConfig(), 0.0, weight) for weight in (0.0, 1e-9))
    for name, value in alone.computed().items():
        assert torch.allclose(value, getattr(both, name), atol=1e-5), name
    alone.total(config.loss).backward()
    assert all(p.grad is None for p in model.fusion.parameters())
    assert all(p.grad is not None for p in model.head.parameters())
