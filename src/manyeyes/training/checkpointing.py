# SPDX-License-Identifier: Apache-2.0
"""State of a training run: model, averaged model, optimiser and step count, saved to a folder and resumed from it."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from manyeyes._io import atomic_write_text
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models.checkpoint import config_to_json, fingerprint

Model = TypeVar("Model", bound=nn.Module)


class LogLine(Protocol):
    """Progress of one step that can be written to the log."""

    def to_record(self) -> dict[str, float]:
        """Return the values by name; "step" is one of them."""
        ...


Line = TypeVar("Line", bound=LogLine)


class RunState(Generic[Model]):
    """State of one process, or of one of several that share every batch.

    config: a frozen dataclass that identifies the run. A folder of another configuration, seed or, with from_weights,
    other initial weights
    is refused. beta2: decay of Adam's second moment.
    """

    def __init__(
        self,
        model: Model,
        config: Any,
        seed: int,
        folder: Path,
        weight_decay: float,
        beta2: float = 0.999,
        from_weights: bool = False,
    ) -> None:
        self.model, self.folder = model, folder
        self.rank, self.world_size = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        self.average = copy.deepcopy(model).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(parameter_groups(model, weight_decay), betas=(0.9, beta2))
        self.step, self.seconds = 0, 0.0
        begun = fingerprint(model).hex() if from_weights else ""
        self._name = {"config": config_to_json(config), "seed": seed, "begun": begun}
        self._since = time.monotonic()
        if self.path.exists():
            self._resume()
        if not self.rank:
            _trim_log(self.folder / "log.jsonl", self.step)

    @property
    def path(self) -> Path:
        """The file of the saved training state."""
        return self.folder / "last.pt"

    def sample_numbers(self, batch: int) -> range:
        """Return the sample numbers of this process for the next step, and start the step's clock."""
        if batch % self.world_size:
            raise ConfigError(f"A batch of {batch} samples cannot be shared by {self.world_size} processes evenly.")
        self._since = time.monotonic()
        share = batch // self.world_size
        first = self.step * batch + self.rank * share
        return range(first, first + share)

    def backward(self, loss: Tensor, share: float = 1.0) -> float:
        """Accumulate the gradient of a loss that is this fraction of the step's; returns its part of the loss."""
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ConfigError(
                f"The loss is {value} at step {self.step}; lower the learning rate, or resume from an older save."
            )
        (loss * share).backward()
        return value * share

    def optimiser_step(self, rate: float, clip: float, decay: float) -> None:
        """Step down the mean loss of all processes and update the average with this decay, faster at the start."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self._average_gradients()
        nn.utils.clip_grad_norm_(self.model.parameters(), clip)
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self._update_average(min(decay, (1 + self.step) / (10 + self.step)))
        self.step += 1
        self.seconds += time.monotonic() - self._since

    def _average_gradients(self) -> None:
        """Average gradients and running statistics over processes, in one flat all-reduce each."""
        if self.world_size == 1:
            return
        for p in self.model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        _mean_in_place([p.grad for p in self.model.parameters() if p.grad is not None], self.world_size)
        _mean_in_place([b for b in self.model.buffers() if b.is_floating_point()], self.world_size)

    @torch.no_grad()
    def _update_average(self, decay: float) -> None:
        for mean, value in zip(self.average.state_dict().values(), self.model.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def run_to_end(
        self, steps: int, save_every: int, advance: Callable[[], Line], report: Callable[[Line], None]
    ) -> None:
        """Advance to the last step; the first process writes a line of log.jsonl and calls report at every step."""
        while self.step < steps:
            progress = advance()
            if not self.rank:
                self.folder.mkdir(parents=True, exist_ok=True)
                with (self.folder / "log.jsonl").open("a") as log:
                    log.write(json.dumps(progress.to_record()) + "\n")
                report(progress)
            if self.step % save_every == 0 or self.step == steps:
                self.save()

    def save(self) -> None:
        """Save everything that is needed to resume as if uninterrupted, atomically."""
        if self.rank:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
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
        if {name: state.get(name, "") for name in self._name} != self._name:
            raise CheckpointError(
                f"{self.path}: belongs to a run of another configuration or seed, or that began from other weights; give another "
                "--out, or delete it."
            )
        for name in ("model", "average", "optimiser"):
            getattr(self, name).load_state_dict(state[name])
        self.step, self.seconds = state["step"], state["seconds"]


def parameter_groups(model: nn.Module, decay: float) -> list[dict[str, Any]]:
    """Return optimiser groups: matrices with weight decay, and the other parameters without."""
    matrices = [p for p in model.parameters() if p.dim() > 1]
    rest = [p for p in model.parameters() if p.dim() <= 1]
    return [{"params": matrices, "weight_decay": decay}, {"params": rest, "weight_decay": 0.0}]


def warmup_cosine(warmup_steps: int, step: int, steps: int) -> float:
    """Return the learning rate as a fraction of its peak: linear warm-up over warmup_steps, times a cosine to zero."""
    return min(1.0, (step + 1) / max(1, warmup_steps)) * 0.5 * (1 + math.cos(math.pi * step / steps))


def _mean_in_place(tensors: list[Tensor], world: int) -> None:
    """Replace each tensor by its mean over world processes, in one flat all-reduce."""
    if not tensors:
        return
    flat = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(flat)
    flat /= world
    for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors])):
        tensor.copy_(part.view_as(tensor))


def _trim_log(path: Path, step: int) -> None:
    """Drop log lines written after the last save, which may be truncated; they will be written again."""
    if path.exists():
        kept = [line for line in path.read_text().splitlines() if 0 < _step_of(line) <= step]
        atomic_write_text(path, "".join(line + "\n" for line in kept))


def _step_of(line: str) -> int:
    try:
        return int(json.loads(line)["step"])
    except (json.JSONDecodeError, KeyError, TypeError):
        return 0
