# SPDX-License-Identifier: Apache-2.0
"""Training of the detector on a device beside the CPU: the same losses, gradients and weights, and runs that change the device."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training


def make_task(toy, preset: str, **changes: object) -> DetectorTask:
    """A task of a preset whose pruning works from the first step on."""
    config = TRAINING_PRESETS[preset]
    assert isinstance(config, DetectorTrainConfig)
    # Drawn intensities may be constant, whose norm amplifies rounding.
    augment = replace(config.augment, sensors=None)
    config = replace(config, augment=augment, prune_warmup_start=-1.0, prune_warmup_end=-0.5, **changes)
    return DetectorTask(config, toy(frames=6, points_per_car=40, ground_points=200), 0)


def weights_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    state = trainer.model.state_dict() | {
        f"average.{name}": value for name, value in trainer.average.state_dict().items()
    }
    return {name: value.cpu().clone() for name, value in state.items()}


def largest_difference(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    """The largest difference of weights, relative to the largest of their tensor and to a thousandth of one."""
    assert one.keys() == other.keys()
    floats = ((value, other[name]) for name, value in one.items() if value.is_floating_point() and value.numel())
    return max(float((a - b).abs().max() / a.abs().max().clamp_min(1e-3)) for a, b in floats)


def divergence(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor], begun: dict[str, torch.Tensor]) -> float:
    """The distance of two sets of weights, relative to the way of the first from where both began."""
    apart, way = (
        sum(float((value.double() - where[name]).square().sum()) for name, value in one.items())
        for where in (other, begun)
    )
    return math.sqrt(apart / way)


@pytest.mark.parametrize(
    "preset",
    [
        "costr-tiny",
        pytest.param("costr-small/stage4", marks=pytest.mark.slow),
        pytest.param("costr-opv2v", marks=pytest.mark.slow),
    ],
)
def test_a_step_has_the_loss_and_the_gradients_of_the_cpu(toy, tmp_path, device, preset):
    batch = 1 if preset == "costr-opv2v" else 2
    ours, theirs = (
        Trainer(make_task(toy, preset, steps=4, batch=batch), tmp_path / str(i), d)
        for i, d in enumerate(("cpu", device))
    )
    samples = [ours.task.draw(number) for number in range(batch)]
    grads = []
    for trainer in (ours, theirs):
        loss, terms = trainer.task.loss(trainer.model, samples, range(batch), 0)
        loss.backward()
        assert loss.device == trainer.device and set(terms) == set(
            ours.task.loss(ours.model, samples, range(batch), 0)[1]
        )
        grads.append({n: p.grad.cpu() for n, p in trainer.model.named_parameters() if p.grad is not None})
        grads[-1]["loss"] = loss.detach().cpu()
    assert float(grads[0]["loss"]) == pytest.approx(float(grads[1]["loss"]), rel=1e-5)
    assert len(grads[0]) > 50 and largest_difference(*grads) < 1e-4
    before = weights_of(theirs)
    assert all(p.device == device for p in theirs.model.parameters())
    progress = theirs.advance()
    assert progress.loss == pytest.approx(float(grads[0]["loss"]), rel=1e-5)
    assert largest_difference(before, weights_of(theirs)) > 1e-3


def test_a_run_goes_on_on_another_device_and_back(toy, tmp_path, device):
    whole = Trainer(make_task(toy, "costr-tiny", steps=6), tmp_path / "whole")
    begun = weights_of(whole)
    losses = [whole.advance().loss for _ in range(4)]
    moved = []
    for count, kind in ((1, "cpu"), (2, device), (1, "cpu")):
        run = Trainer(make_task(toy, "costr-tiny", steps=6), tmp_path / "moved", kind)
        assert run.step == len(moved) and all(p.device == run.device for p in run.model.parameters())
        moved += [run.advance().loss for _ in range(count)]
        run.save()
        state = torch.load(run.path, weights_only=True)
        tensors = [*state["model"].values(), *state["average"].values()]
        tensors += [value for each in state["optimiser"]["state"].values() for value in each.values()]
        assert len(tensors) > 100 and all(
            type(value) is torch.Tensor and value.device.type == "cpu" for value in tensors
        )
    # AdamW amplifies rounding where a gradient is nearly zero.
    assert moved == pytest.approx(losses, rel=2e-3)
    assert divergence(weights_of(run), weights_of(whole), begun) < 0.05


def test_losses_are_read_and_checked_every_few_steps_off_the_cpu(toy, tmp_path, device):
    run = Trainer(make_task(toy, "costr-tiny", steps=3, save_every=100), tmp_path, device)
    seen: list[int] = []
    run.run(report=lambda progress: seen.append(progress.step))
    assert seen == [1, 2, 3]
    assert len((tmp_path / "log.jsonl").read_text().splitlines()) == 3 and (Path(tmp_path) / "last.pt").exists()
