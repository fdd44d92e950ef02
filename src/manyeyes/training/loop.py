# SPDX-License-Identifier: Apache-2.0
"""The training loop: plain, keyed, resumable; fork it."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from manyeyes.datasets.recording import Recording
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.checkpoint import config_to_json
from manyeyes.models.detector import Detector, DetectorConfig
from manyeyes.training.losses import LossConfig, LossTerms
from manyeyes.training.samples import AugmentConfig, RoadConfig, SampleStream, epoch_length
from manyeyes.training.step import loss_terms
from manyeyes.training.targets import TargetConfig


@dataclass(frozen=True)
class TrainConfig:
    """A run. steps, or epochs over the judged frames when steps is 0; batch: samples a step over all processes.

    warm_up: steps of linear growth of the learning rate, then a cosine to zero. prune_from, prune_full: the pruning threshold
    grows from 0 to the detector's between these shares of the run. ema: decay of the averaged weights that are saved.
    """

    detector: DetectorConfig
    steps: int = 0
    epochs: float = 90.0
    batch: int = 4
    learning_rate: float = 2e-4
    weight_decay: float = 1e-2
    warm_up: int = 500
    clip: float = 10.0
    ema: float = 0.999
    prune_from: float = 0.03
    prune_full: float = 0.10
    save_every: int = 200
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    road: RoadConfig = field(default_factory=RoadConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    loss: LossConfig = field(default_factory=LossConfig)


@dataclass(frozen=True)
class Progress:
    """One line of the log."""

    step: int
    steps: int
    loss: float
    terms: LossTerms
    learning_rate: float
    seconds: float


def learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    """Linear warm-up, then a cosine to zero."""
    return config.learning_rate * warm_cosine(config.warm_up, step, steps)


def warm_cosine(warm_up: int, step: int, steps: int) -> float:
    """A share of the peak: linear growth over warm_up steps, and a cosine to zero over all."""
    return min(1.0, (step + 1) / max(1, warm_up)) * 0.5 * (1 + math.cos(math.pi * step / steps))


def prune_threshold(config: TrainConfig, step: int, steps: int) -> float:
    """The detector's threshold, approached linearly between prune_from and prune_full of the run; 0 before."""
    ramp = (step / steps - config.prune_from) / max(1e-9, config.prune_full - config.prune_from)
    return config.detector.prune_threshold * min(1.0, max(0.0, ramp))


class Run:
    """Model, optimiser and average of one training run, in a folder from which it resumes."""

    def __init__(
        self, config: TrainConfig, recording: Recording, folder: Path, seed: int, start: Path | None = None
    ) -> None:
        self.config, self.folder, self.seed = config, folder, seed
        self.rank, self.world = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        if config.batch % self.world:
            raise ConfigError(f"A batch of {config.batch} samples cannot be shared by {self.world} processes evenly.")
        self.steps = config.steps or math.ceil(config.epochs * epoch_length(recording) / config.batch)
        self.stream = SampleStream(recording, config.detector.grid, config.augment, seed, config.road)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.model = Detector(config.detector)
        if start is not None:
            _load_weights(self.model, start)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(parameter_groups(self.model, config.weight_decay), lr=config.learning_rate)
        self.step, self.seconds = 0, 0.0
        if self.state_path.exists():
            self._resume()

    @property
    def state_path(self) -> Path:
        """Where the run is kept between saves."""
        return self.folder / "last.pt"

    def advance(self) -> Progress:
        """One step of the optimiser."""
        began, config = time.monotonic(), self.config
        self.model.train()
        share = config.batch // self.world
        first = self.step * config.batch + self.rank * share
        samples = [self.stream.draw(first + i) for i in range(share)]
        rate = learning_rate(config, self.step, self.steps)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        threshold = prune_threshold(config, self.step, self.steps)
        terms = loss_terms(self.model, samples, config.targets, threshold, config.loss.together, config.loss.target)
        loss = terms.total(config.loss)
        if not bool(torch.isfinite(loss)):
            raise ConfigError(
                f"The loss is {float(loss.detach())} at step {self.step}; lower the learning rate, or resume from an older save."
            )
        loss.backward()
        self._share_gradients()
        nn.utils.clip_grad_norm_(self.model.parameters(), config.clip)
        self.optimiser.step()
        self._average()
        self.step += 1
        self.seconds += time.monotonic() - began
        return Progress(self.step, self.steps, float(loss.detach()), terms, rate, self.seconds)

    def _share_gradients(self) -> None:
        """The mean over processes of gradients and of running statistics: one flat exchange each."""
        if self.world == 1:
            return
        for p in self.model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        mean_in_place([p.grad for p in self.model.parameters() if p.grad is not None], self.world)
        mean_in_place([b for b in self.model.buffers() if b.is_floating_point()], self.world)

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        for mean, value in zip(self.average.state_dict().values(), self.model.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def save(self) -> None:
        """Everything that the run needs to go on as if it had not stopped; atomic."""
        if self.rank:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = self.state_path.with_suffix(".partial")
        state: dict[str, Any] = {
            "config": config_to_json(self.config),
            "seed": self.seed,
            "step": self.step,
            "seconds": self.seconds,
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        torch.save(state, partial)
        partial.replace(self.state_path)

    def _resume(self) -> None:
        try:
            state = torch.load(self.state_path, weights_only=True)
        except Exception as error:
            raise CheckpointError(
                f"{self.state_path}: not a whole training state ({type(error).__name__}); delete it to start anew."
            ) from error
        if state["config"] != config_to_json(self.config) or state["seed"] != self.seed:
            raise CheckpointError(
                f"{self.state_path}: belongs to a run of another configuration or seed; give another --out, or delete it."
            )
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.seconds = state["step"], state["seconds"]


def train(
    config: TrainConfig,
    recording: Recording,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
    start: Path | None = None,
) -> Path:
    """Train, or go on where the run in folder stopped; returns the file of averaged weights.

    start: a file of weights to begin from instead of random ones; its settings may differ where they shape no tensor.

    Writes last.pt (to resume), log.jsonl (one object a step) and weights.safetensors (float16).
    """
    run = Run(config, recording, folder, seed, start)
    folder.mkdir(parents=True, exist_ok=True)
    if run.rank == 0:
        trim_log(folder / "log.jsonl", run.step)
    while run.step < run.steps:
        progress = run.advance()
        if run.rank == 0:
            with (folder / "log.jsonl").open("a") as log:
                log.write(json.dumps(_log_line(progress)) + "\n")
            report(progress)
        if run.step % config.save_every == 0 or run.step == run.steps:
            run.save()
    weights = folder / "weights.safetensors"
    if run.rank == 0:
        about = {
            "seed": seed,
            "steps": run.steps,
            "train_seconds": round(run.seconds),
            "config": asdict(config),
            **(card or {}),
        }
        checkpoint.save(run.average, weights, about, half=True)
    return weights


def _load_weights(model: Detector, start: Path) -> None:
    """Begin from a file. Where the model has grown, by a part or by rows and columns at their ends, what is new starts as if
    it were not there: a new part as it is built, new rows and columns of a matrix at zero. Parts that the model lacks are left out,
    as an ablation does."""
    state, own = checkpoint.read_state(start), model.state_dict()
    begun = {name: _grown(value, state[name]) for name, value in own.items() if name in state}
    odd = sorted(name for name, value in begun.items() if value is None)
    if odd or not begun:
        raise CheckpointError(
            f"{start}: cannot start this preset, tensor {(odd or sorted(state))[0]} does not fit; "
            "start from weights of its own kind."
        )
    model.load_state_dict(begun, strict=False)


def _grown(new: Tensor, old: Tensor) -> Tensor | None:
    """The old values at the start of the new tensor, None where they do not fit into it."""
    if new.dim() != old.dim() or any(n < o for n, o in zip(new.shape, old.shape)):
        return None
    grown = torch.zeros_like(new) if new.dim() > 1 else new.clone()
    grown[tuple(slice(0, o) for o in old.shape)] = old.to(new.dtype)
    return grown


def _log_line(progress: Progress) -> dict[str, float]:
    terms = {name: round(float(value.detach()), 5) for name, value in vars(progress.terms).items()}
    return {"step": progress.step, "loss": round(progress.loss, 5), **terms, "lr": progress.learning_rate}


def trim_log(path: Path, step: int) -> None:
    """Drop the lines that a killed run wrote after its last save, the last of them perhaps cut: they will be written again."""
    if path.exists():
        kept = [line for line in path.read_text().splitlines() if 0 < _step_of(line) <= step]
        partial = path.with_suffix(".partial")
        partial.write_text("".join(line + "\n" for line in kept))
        partial.replace(path)


def _step_of(line: str) -> int:
    try:
        return int(json.loads(line)["step"])
    except (json.JSONDecodeError, KeyError, TypeError):
        return 0


def parameter_groups(model: nn.Module, decay: float) -> list[dict[str, Any]]:
    """What an optimiser is given: matrices, whose weights decay, and the rest, whose do not."""
    matrices = [p for p in model.parameters() if p.dim() > 1]
    rest = [p for p in model.parameters() if p.dim() <= 1]
    return [{"params": matrices, "weight_decay": decay}, {"params": rest, "weight_decay": 0.0}]


def mean_in_place(tensors: list[Tensor], world: int) -> None:
    """Each tensor becomes its mean over world processes, in one flat exchange."""
    flat = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(flat)
    flat /= world
    for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors])):
        tensor.copy_(part.view_as(tensor))
