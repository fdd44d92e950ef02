# SPDX-License-Identifier: Apache-2.0
"""What a training run is made of besides its loss: model, average, optimiser and count, kept in a folder and resumed from it."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models.checkpoint import config_to_json
from manyeyes.training.loop import parameter_groups

Model = TypeVar("Model", bound=nn.Module)


class RunState(Generic[Model]):
    """One process. config: a frozen dataclass that names the run; a folder of another run, or of another seed, is refused."""

    def __init__(self, model: Model, config: Any, seed: int, folder: Path, weight_decay: float) -> None:
        self.model, self.path = model, folder / "last.pt"
        self.average = copy.deepcopy(model).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(parameter_groups(model, weight_decay))
        self.step, self.seconds = 0, 0.0
        self._name = {"config": config_to_json(config), "seed": seed}
        if self.path.exists():
            self._resume()

    def descend(self, loss: Tensor, rate: float, clip: float, decay: float) -> None:
        """One step down the loss at this learning rate; the average follows with this decay, faster at the start."""
        if not bool(torch.isfinite(loss)):
            raise ConfigError(
                f"The loss is {float(loss.detach())} at step {self.step}; lower the learning rate, or resume from an older save."
            )
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), clip)
        self.optimiser.step()
        self._follow(min(decay, (1 + self.step) / (10 + self.step)))
        self.step += 1

    @torch.no_grad()
    def _follow(self, decay: float) -> None:
        for mean, value in zip(self.average.state_dict().values(), self.model.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def save(self) -> None:
        """Everything that the run needs to go on as if it had not stopped; atomic."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        parts = {name: getattr(self, name).state_dict() for name in ("model", "average", "optimiser")}
        torch.save({**self._name, **parts, "step": self.step, "seconds": self.seconds}, partial)
        partial.replace(self.path)

    def _resume(self) -> None:
        try:
            state = torch.load(self.path, weights_only=True)
        except Exception as error:
            raise CheckpointError(
                f"{self.path}: not a whole training state ({type(error).__name__}); delete it to start anew."
            ) from error
        if {name: state[name] for name in self._name} != self._name:
            raise CheckpointError(
                f"{self.path}: belongs to a run of another configuration or seed; give another --out, or delete it."
            )
        for name in ("model", "average", "optimiser"):
            getattr(self, name).load_state_dict(state[name])
        self.step, self.seconds = state["step"], state["seconds"]
