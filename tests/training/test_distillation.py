# SPDX-License-Identifier: Apache-2.0
"""DiscoNet's teacher: equal features cost nothing, cells by hand, merged clouds, and weights that stay as they are."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import ConfigError, Sites, SparseBev
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.distillation import distillation_loss, teacher_features
from manyeyes.training.detector.fusion_presets import DISTILLATION, FUSION_TRAINING_PRESETS
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, Sample, make_sample
from manyeyes.training.detector.task import DetectorTask

GRID = COSTR_TINY.grid.at(4)


@pytest.fixture
def sample(toy) -> Sample:
    recording = toy(agents_n=3, points_per_car=20, ground_points=60)
    moments = [recording.snapshot("toy_0", i) for i in range(3)]
    return make_sample(moments, 0, COSTR_TINY.grid, AugmentConfig.none(), ("distil",), DegradationConfig())


def bev(keys: list[int], seed: int = 0) -> SparseBev:
    features = torch.randn(len(keys), 8, generator=torch.Generator().manual_seed(seed))
    return SparseBev(features.requires_grad_(), Sites(torch.tensor(keys, dtype=torch.int64), GRID))


def test_a_student_like_its_teacher_has_no_loss_and_no_gradient() -> None:
    student = bev([3, 7, 9])
    loss = distillation_loss(student, student)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
    assert student.features.grad is not None and float(student.features.grad.abs().max()) < 1e-6


def test_common_cells_alone_count_and_the_teacher_gets_no_gradient() -> None:
    student, teacher = bev([1, 3, 7]), bev([3, 5, 7, 8], seed=1)
    loss = distillation_loss(student, teacher)
    expected = 0.0
    for i, j in ((1, 0), (2, 2)):
        p, q = teacher.features[j].detach().softmax(0), student.features[i].detach().softmax(0)
        expected += float((p * (p / q).log()).sum()) / 2
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert (
        teacher.features.grad is None and not student.features.grad[0].any() and bool(student.features.grad[1:].any())
    )
    for other in (bev([2]), bev([])):
        assert float(distillation_loss(student, other).detach()) == 0.0


def test_the_teacher_sees_the_clouds_of_all_views_that_are_in_place(sample: Sample) -> None:
    torch.manual_seed(0)
    teacher = Detector(COSTR_TINY).eval()
    alone = teacher_features(teacher, [replace(sample, views=sample.views[:1])], 0.0)
    together = teacher_features(teacher, [sample], 0.0)
    away = (sample.views[0], *(replace(view, sigma_xy_m=0.5) for view in sample.views[1:]))
    assert len(together.sites) > len(alone.sites)
    displaced = teacher_features(teacher, [replace(sample, views=away)], 0.0)
    assert torch.equal(displaced.sites.key, alone.sites.key) and not together.features.requires_grad


def test_a_training_step_distils_from_the_initial_weights(sample: Sample, tmp_path) -> None:
    preset = DETECTOR_TRAINING_PRESETS["costr-tiny"]
    config = replace(preset, detector=replace(COSTR_TINY, fusion="disconet"), loss=LossConfig(distillation=3.0))
    torch.manual_seed(0)
    path = tmp_path / "base.safetensors"
    checkpoint.save(Detector(replace(COSTR_TINY, fusion="max/bare")), path, {})

    class Nothing:
        scenarios = ()

    task = DetectorTask(config, Nothing(), start=path)  # pyright: ignore[reportArgumentType]
    model = task.make_model().train()
    total, terms = task.loss(model, [sample], range(1), 0)
    teacher = task._make_teacher(model)
    before = deepcopy(teacher.state_dict())
    total.backward()
    assert float(terms["distillation"].detach()) > 0 and not any(p.requires_grad for p in teacher.parameters())
    task.loss(model, [sample], range(1), 0)
    assert all(torch.equal(value, teacher.state_dict()[name]) for name, value in before.items())
    plain = replace(config, loss=LossConfig())
    rest = DetectorTask(plain, Nothing(), start=path).loss(model, [sample], range(1), 0)  # pyright: ignore[reportArgumentType]
    assert "distillation" not in rest[1]
    with pytest.raises(ConfigError, match="initial weights"):
        DetectorTask(config, Nothing()).loss(model, [sample], range(1), 0)  # pyright: ignore[reportArgumentType]


def test_presets_of_disconet_distil_where_they_have_a_base() -> None:
    weights = {name: config.loss.distillation for name, config in FUSION_TRAINING_PRESETS.items()}
    assert {name for name, weight in weights.items() if weight} == {"fusion/disconet", "fusion/disconet/bare"}
    assert weights["fusion/disconet"] == DISTILLATION
