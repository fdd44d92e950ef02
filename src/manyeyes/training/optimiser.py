# SPDX-License-Identifier: Apache-2.0
"""Optimiser step in few calls on any device: fused AdamW, clipped gradients, averaged weights, states that any device can load."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn


def make_optimiser(model: nn.Module, weight_decay: float, beta2: float) -> torch.optim.AdamW:
    """Make AdamW for a model on its device: one fused call per group instead of a dozen per tensor."""
    return torch.optim.AdamW(parameter_groups(model, weight_decay), betas=(0.9, beta2), fused=True)


def parameter_groups(model: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Return optimiser groups: matrices with weight decay, and the other parameters without."""
    matrices = [p for p in model.parameters() if p.dim() > 1]
    rest = [p for p in model.parameters() if p.dim() <= 1]
    return [{"params": matrices, "weight_decay": decay}, {"params": rest, "weight_decay": 0.0}]


@torch.no_grad()
def clip_gradients(parameters: Iterable[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients so that their norm over all parameters is at most max_norm; returns the norm before, a scalar.

    As ``torch.nn.utils.clip_grad_norm_``, in four calls and without reading the norm.
    """
    grads = [p.grad for p in parameters if p.grad is not None]
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(grads)))  # pyright: ignore[reportPrivateImportUsage]
    torch._foreach_mul_(grads, (max_norm / (norm + 1e-6)).clamp_max(1.0))  # pyright: ignore[reportPrivateImportUsage]
    return norm


class AveragedWeights:
    """The exponential moving average of a model's floating-point tensors, in another model; other tensors are copied."""

    def __init__(self, average: nn.Module, model: nn.Module) -> None:
        pairs = list(zip(average.state_dict().values(), model.state_dict().values(), strict=True))
        self._means = [pair for pair in pairs if pair[0].is_floating_point()]
        self._rest = [pair for pair in pairs if not pair[0].is_floating_point()]

    @torch.no_grad()
    def update(self, decay: float) -> None:
        """Move the average towards the model by 1 - decay."""
        if self._means:
            means, values = map(list, zip(*self._means))
            torch._foreach_lerp_(means, values, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]
        if self._rest:
            copies, values = map(list, zip(*self._rest))
            torch._foreach_copy_(copies, values)  # pyright: ignore[reportPrivateImportUsage]


def to_cpu(state: Any) -> Any:
    """Copy the tensors of a nested state to the CPU, so that a run can go on on any device."""
    if isinstance(state, Tensor):
        return state.detach().cpu()
    if isinstance(state, dict):
        return {key: to_cpu(value) for key, value in state.items()}
    return [to_cpu(value) for value in state] if isinstance(state, list) else state


def load_optimiser(optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Load a saved state, whose tensors are on the CPU, to the device of the parameters."""
    # How steps are counted belongs to this optimiser, not to the one that was saved.
    own = [{name: group[name] for name in ("fused", "foreach")} for group in optimiser.param_groups]
    groups = [saved | now for saved, now in zip(state["param_groups"], own, strict=True)]
    optimiser.load_state_dict({**state, "param_groups": groups})
