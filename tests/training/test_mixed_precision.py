# SPDX-License-Identifier: Apache-2.0
"""Training with products of bfloat16: what it changes, what stays float32, that it learns, and which runs it can go on from."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.mixed_precision import multiply_in_bfloat16
from manyeyes.training.monitor import Progress
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training
LOSS_TOLERANCE = 0.02
"""Relative, of a step at equal weights: products are rounded by 2^-8, a dozen layers deep."""


def make_task(toy, precision: str, preset: str = "costr-tiny", **changes) -> DetectorTask:
    config = TRAINING_PRESETS[preset]
    assert isinstance(config, DetectorTrainConfig)
    return DetectorTask(replace(config, precision=precision, **changes), toy(frames=3, points_per_car=40), 0)


def step(task: DetectorTask, folder, device) -> tuple[float, dict[str, torch.Tensor]]:
    """The loss of a step, and the gradients of all parameters on the CPU."""
    trainer = Trainer(task, folder, device)
    samples = [task.draw(number) for number in range(2)]
    loss, _ = task.loss(trainer.model, samples, range(2), 0)
    loss.backward()
    grads = {name: p.grad for name, p in trainer.model.named_parameters() if p.grad is not None}
    assert loss.dtype == torch.float32 and all(grad.dtype == torch.float32 for grad in grads.values())
    return float(loss.detach().cpu()), {name: grad.cpu() for name, grad in grads.items()}


@pytest.mark.parametrize("preset", ["costr-tiny", pytest.param("costr-small/stage1", marks=pytest.mark.slow)])
@pytest.mark.parametrize("place", ["cpu", "device"])
def test_a_step_is_close_to_that_of_float32_with_finite_gradients(toy, tmp_path, device, place, preset):
    where = torch.device("cpu") if place == "cpu" else device
    exact, ours = (
        step(make_task(toy, precision, preset), tmp_path / precision, where) for precision in ("float32", "bfloat16")
    )
    assert ours[0] != exact[0] and ours[0] == pytest.approx(exact[0], rel=LOSS_TOLERANCE)
    assert ours[1].keys() == exact[1].keys() and all(bool(grad.isfinite().all()) for grad in ours[1].values())
    one, other = (torch.cat([grad.flatten() for grad in side[1].values()]) for side in (exact, ours))
    assert float(torch.cosine_similarity(one, other, 0)) > 0.98


def test_parameters_state_and_averages_are_float32(toy, tmp_path):
    run = Trainer(make_task(toy, "bfloat16"), tmp_path)
    run.advance()
    run.save()
    state = torch.load(run.path, weights_only=True)
    tensors = [*state["model"].values(), *state["average"].values()]
    tensors += [value for each in state["optimiser"]["state"].values() for value in each.values()]
    assert {value.dtype for value in tensors if value.is_floating_point()} == {torch.float32}


@pytest.mark.slow
def test_a_run_learns_as_with_float32_and_its_card_names_the_precision(toy, tmp_path):
    heat = []
    for precision in ("float32", "bfloat16"):
        task, logged = make_task(toy, precision, steps=30), list[Progress]()
        weights = Trainer(task, tmp_path / precision).run(report=logged.append)
        heat.append([progress.terms["heat"] for progress in logged])
    begun, exact, ours = sum(heat[1][:5]), sum(heat[0][-5:]), sum(heat[1][-5:])
    assert ours < 0.65 * begun and ours < 1.1 * exact
    assert checkpoint.read_card(weights)["config"]["precision"] == "bfloat16"
    assert checkpoint.load(weights).config == task.config.detector


def test_an_interrupted_run_ends_with_the_same_result(toy, tmp_path, check_resumption):
    check_resumption(lambda: make_task(toy, "bfloat16"), tmp_path)


def test_a_run_of_another_precision_is_refused(toy, tmp_path):
    Trainer(make_task(toy, "bfloat16"), tmp_path).save()
    with pytest.raises(CheckpointError, match="precision is 'bfloat16' there and 'float32' here"):
        Trainer(make_task(toy, "float32"), tmp_path)


def test_convolutions_and_attention_multiply_in_it_and_heads_do_not():
    config = TRAINING_PRESETS["costr-small/stage4"]
    assert isinstance(config, DetectorTrainConfig)
    model = Detector(config.detector)
    names = set(model.state_dict())
    count = multiply_in_bfloat16(model)
    changed = {
        name for name, part in model.named_modules() if getattr(part, "in_bfloat16", False) or "forward" in vars(part)
    }
    assert len(changed) == count > 30 and set(model.state_dict()) == names
    assert {name.split(".")[0] for name in changed} == {"encoder", "dast", "fusion"}
    assert (
        "dast.blocks.0.query" in changed
        and "encoder.up.4.lateral" in changed
        and not any("prune" in n for n in changed)
    )


def test_a_model_without_such_layers_is_refused():
    with pytest.raises(ConfigError, match="precision bfloat16: Linear has no layer that multiplies in it; use float32"):
        multiply_in_bfloat16(nn.Linear(2, 2))
