# SPDX-License-Identifier: Apache-2.0
"""Gradients clipped, weights averaged and states moved in few calls, against torch's own loops."""

import copy

import pytest
import torch
from torch import nn

from manyeyes.training.optimiser import AveragedWeights, clip_gradients, load_optimiser, make_optimiser, to_cpu


def make_model() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2))


def fill_gradients(model: nn.Module, scale: float = 1.0) -> None:
    random = torch.Generator().manual_seed(1)
    for p in model.parameters():
        p.grad = scale * torch.randn(p.shape, generator=random).to(p.device)


@pytest.mark.parametrize("max_norm", [0.5, 1e3])
def test_gradients_are_clipped_as_torch_does_it(max_norm):
    mine, its = make_model(), make_model()
    for model in (mine, its):
        fill_gradients(model)
    norm = clip_gradients(mine.parameters(), max_norm)
    assert float(norm) == pytest.approx(float(nn.utils.clip_grad_norm_(its.parameters(), max_norm)), rel=1e-6)
    for a, b in zip(mine.parameters(), its.parameters(), strict=True):
        assert a.grad is not None and b.grad is not None
        assert torch.allclose(a.grad, b.grad, rtol=1e-6, atol=0)


def test_weights_are_averaged_and_counters_copied():
    model, average = make_model(), make_model()
    with torch.no_grad():
        for p in model.parameters():
            p.add_(1.0)
    model(torch.randn(5, 3))
    before, now = copy.deepcopy(average.state_dict()), model.state_dict()
    AveragedWeights(average, model).update(0.9)
    for name, value in average.state_dict().items():
        wanted = 0.9 * before[name] + 0.1 * now[name] if value.is_floating_point() else now[name]
        assert torch.allclose(value, wanted, atol=1e-7)
    assert int(average.state_dict()["1.num_batches_tracked"]) == 1


def test_the_fused_step_is_that_of_plain_adamw():
    mine, its = make_model(), make_model()
    fused = make_optimiser(mine, 0.1, 0.99)
    plain = torch.optim.AdamW(
        [{"params": [its[0].weight, its[2].weight], "weight_decay": 0.1},
         {"params": [p for p in its.parameters() if p.dim() < 2], "weight_decay": 0.0}],
        betas=(0.9, 0.99), fused=False, foreach=False,
    )  # fmt: skip
    for step in range(3):
        for model, optimiser in ((mine, fused), (its, plain)):
            fill_gradients(model, 1.0 + step)
            optimiser.step()
    for a, b in zip(mine.parameters(), its.parameters(), strict=True):
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-7)


def test_a_state_is_kept_on_the_cpu_and_loaded_on_any_device(device):
    ours, theirs = make_model(), make_model().to(device)
    first, second = (make_optimiser(model, 0.1, 0.99) for model in (ours, theirs))
    fill_gradients(ours)
    first.step()
    # A state of a version whose optimiser was not fused.
    state = to_cpu(first.state_dict())
    for group in state["param_groups"]:
        group["fused"] = None
    load_optimiser(second, state)
    assert all(group["fused"] for group in second.param_groups)
    moments = [value for each in second.state.values() for value in each.values()]
    assert len(moments) == 3 * 6 and all(value.device == device for value in moments)
    fill_gradients(theirs)
    second.step()
    back = to_cpu(second.state_dict())
    values = [value for each in back["state"].values() for value in each.values()]
    assert all(type(value) is torch.Tensor and value.device.type == "cpu" for value in values)
    assert {float(value) for each in back["state"].values() for name, value in each.items() if name == "step"} == {2.0}
