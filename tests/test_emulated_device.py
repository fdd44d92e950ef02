# SPDX-License-Identifier: Apache-2.0
"""The emulated device itself: values of the CPU, no mixing, every call and every wait counted with its place."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tests.emulated_device import DEVICE, DeviceMixError, DeviceTensor, Record, emulate
from torch import Tensor, nn

HERE = "/tests/"


class Exponential(torch.autograd.Function):
    """An autograd function of our own, whose backward makes a tensor and branches on the device."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        assert x.device == DEVICE
        y = x.exp()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        assert y.device == grads[0].device == DEVICE and isinstance(grads[0], DeviceTensor)
        return grads[0] * y + torch.zeros(3, device=grads[0].device)


def exponential(x: Tensor) -> Tensor:
    y: Tensor = Exponential.apply(x)  # pyright: ignore[reportAssignmentType]
    return y


def calls_in(record: Record, name: str) -> int:
    return sum(count for (_, called), count in record.calls.items() if called == name)


def test_an_own_autograd_function_stays_on_the_device_and_is_counted_in_both_passes():
    with emulate(HERE) as record:
        x = torch.tensor([0.0, 1.0, 2.0]).to("cuda").requires_grad_()
        exponential(x).sum().backward()
        assert calls_in(record, "exp") == calls_in(record, "mul") == calls_in(record, "zeros") == 1
        assert x.grad is not None and x.grad.device == DEVICE
        assert x.grad.tolist() == x.detach().exp().tolist()
        assert any(place.startswith("test_emulated_device.py:") for place, _ in record.calls)


def test_a_step_of_a_model_equals_that_of_the_cpu():
    torch.manual_seed(0)
    model, x = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.ReLU()), torch.randn(5, 3)
    twin = copy.deepcopy(model)
    with emulate(HERE):
        twin.to("cuda")
        assert all(isinstance(p, nn.Parameter) and p.device == DEVICE for p in twin.parameters())
        for one, given in ((model, x), (twin, x.to(DEVICE))):
            optimiser = torch.optim.AdamW(one.parameters(), fused=True)
            one(given).square().sum().backward()
            optimiser.step()
        for mine, its in zip(model.state_dict().values(), twin.state_dict().values(), strict=True):
            assert torch.equal(mine, its.cpu())
        assert torch.equal(copy.deepcopy(twin)[0].weight.cpu(), model[0].weight)


@pytest.mark.parametrize(
    "mix",
    [
        lambda here, there: there + here,
        lambda here, there: torch.cat((here, there)),
        lambda here, there: here[there.long()],
        lambda here, there: there[torch.tensor([0, 1])],
        lambda here, there: there.index_add(0, torch.tensor([0]), there[:1]),
        lambda here, there: nn.functional.linear(there, torch.ones(3, 3)),
        lambda here, there: there.numpy(),
    ],
)
def test_mixing_devices_is_refused_with_the_place(mix):
    with emulate(HERE), pytest.raises(DeviceMixError, match=r"test_emulated_device\.py:\d+"):
        mix(torch.zeros(3), torch.zeros(3, device=DEVICE))


def test_what_cuda_allows_is_allowed():
    with emulate(HERE) as record:
        there = torch.ones(3, device="cuda")
        assert (there * torch.tensor(2.0)).tolist() == [2.0, 2.0, 2.0]
        there.copy_(torch.tensor([3.0, 4.0, 5.0]))
        assert there.cpu().tolist() == [3.0, 4.0, 5.0]
        assert sum(record.uploads.values()) == 1 and record.num_syncs == 2


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.nonzero(),
        lambda x: x[x > 0],
        lambda x: float(x.sum()),
        lambda x: x.sum().item(),
        lambda x: bool((x > 0).all()),
        lambda x: int(x[0]),
        lambda x: x.cpu(),
        lambda x: x.to("cpu"),
        lambda x: x.tolist(),
        lambda x: x.unique(),
        lambda x: torch.unique_consecutive(x),
        lambda x: torch.bincount(x.long()),
        lambda x: torch.zeros(3).copy_(x),
    ],
)
def test_waiting_for_the_device_is_counted_once(wait):
    with emulate(HERE) as record:
        x = torch.tensor([1.0, 0.0, 2.0]).to(DEVICE)
        assert record.num_syncs == 0
        wait(x)
        assert record.num_syncs == 1
        assert all(place.startswith("test_emulated_device.py:") for place, _ in record.syncs)


def test_what_needs_no_waiting_counts_none():
    with emulate(HERE) as record:
        x = torch.arange(3, device=DEVICE)
        x = x.index_select(0, x) + x.new_zeros(3) + torch.zeros_like(x)
        x[1:] += 2
        assert record.num_syncs == 0 and record.num_calls > 5
        assert record.report().startswith(f"operator calls: {record.num_calls}")


def test_nothing_is_left_afterwards():
    with emulate(HERE):
        there = torch.zeros(2, device=DEVICE)
    assert torch.inference_mode is not None and torch.zeros(2).device.type == "cpu"
    with torch.inference_mode():
        assert torch.zeros(1).is_inference()
    with pytest.raises(DeviceMixError, match="outside of emulate"):
        there.sum()
