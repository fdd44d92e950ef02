# SPDX-License-Identifier: Apache-2.0
"""The training loop of the detector: keyed randomness, resumable."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.training.checkpointing import RunState, warmup_cosine
from manyeyes.training.detector.losses import LossConfig, LossTerms
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, SampleStream, epoch_length
from manyeyes.training.detector.step import loss_terms
from manyeyes.training.detector.targets import TargetConfig


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Attributes:
        detector: configuration of the model.
        steps: number of optimiser steps; 0 to use epochs.
        epochs: passes over the evaluated frames.
        batch: samples per step over all processes.
        warmup_steps: steps of linear growth of the learning rate, before a cosine to zero.
        max_grad_norm: at which gradients are clipped.
        ema_decay: decay of the averaged weights, which are saved.
        prune_warmup_start: fraction of the run at which the pruning threshold starts to grow from 0.
        prune_warmup_end: fraction of the run at which it reaches that of the detector.
    """

    detector: DetectorConfig
    steps: int = 0
    epochs: float = 90.0
    batch: int = 4
    learning_rate: float = 2e-4
    weight_decay: float = 1e-2
    warmup_steps: int = 500
    max_grad_norm: float = 10.0
    ema_decay: float = 0.999
    prune_warmup_start: float = 0.03
    prune_warmup_end: float = 0.10
    save_every: int = 200
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    degradation: DegradationConfig = field(default_factory=DegradationConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    loss: LossConfig = field(default_factory=LossConfig)


@dataclass(frozen=True)
class DetectorProgress:
    """Progress of one step: one line of the log."""

    step: int
    steps: int
    loss: float
    terms: LossTerms
    learning_rate: float
    seconds: float

    def to_record(self) -> dict[str, float]:
        """Return the line of log.jsonl."""
        terms = {name: round(float(value.detach()), 5) for name, value in vars(self.terms).items()}
        return {"step": self.step, "loss": round(self.loss, 5), **terms, "lr": self.learning_rate}


def learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    """Return the learning rate: linear warm-up, then a cosine to zero."""
    return config.learning_rate * warmup_cosine(config.warmup_steps, step, steps)


def prune_threshold(config: TrainConfig, step: int, steps: int) -> float:
    """Return the pruning threshold: 0, then linear growth from prune_warmup_start to prune_warmup_end of the run."""
    ramp = (step / steps - config.prune_warmup_start) / max(1e-9, config.prune_warmup_end - config.prune_warmup_start)
    return config.detector.prune_threshold * min(1.0, max(0.0, ramp))


class DetectorRun:
    """A resumable training run of the detector in a folder."""

    def __init__(
        self, config: TrainConfig, recording: Recording, folder: Path, seed: int, start: Path | None = None
    ) -> None:
        self.config = config
        self.steps = config.steps or math.ceil(config.epochs * epoch_length(recording) / config.batch)
        self.stream = SampleStream(recording, config.detector.grid, config.augment, seed, config.degradation)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            model = Detector(config.detector)
        if start is not None:
            _load_weights(model, start)
        self.state = RunState(model, config, seed, folder, config.weight_decay, from_weights=start is not None)

    def advance(self) -> DetectorProgress:
        """Run one optimiser step."""
        config, state = self.config, self.state
        samples = [self.stream.draw(number) for number in state.sample_numbers(config.batch)]
        model = state.model.train()
        threshold = prune_threshold(config, state.step, self.steps)
        terms = loss_terms(model, samples, config.targets, threshold, config.loss.fusion_weight, config.loss.target)
        loss, rate = terms.total(config.loss), learning_rate(config, state.step, self.steps)
        state.backward(loss)
        state.optimiser_step(rate, config.max_grad_norm, config.ema_decay)
        return DetectorProgress(state.step, self.steps, float(loss.detach()), terms, rate, state.seconds)


def train_detector(
    config: TrainConfig,
    recording: Recording,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[DetectorProgress], None] = lambda progress: None,
    start: Path | None = None,
) -> Path:
    """Train, or resume the run in folder; returns the file of averaged weights.

    start: weights file that initialises the model; its configuration may differ where tensor shapes agree.

    Writes last.pt (training state), log.jsonl (one object per step) and weights.safetensors (float16).
    """
    run = DetectorRun(config, recording, folder, seed, start)
    state = run.state
    state.run_to_end(run.steps, config.save_every, run.advance, report)
    weights = folder / "weights.safetensors"
    if not state.rank:
        about = {"seed": seed, "steps": run.steps, "train_seconds": round(state.seconds), "config": asdict(config)}
        checkpoint.save(state.average, weights, {**about, **(card or {})}, half=True)
    return weights


def _load_weights(model: Detector, start: Path) -> None:
    """Initialise the model from a file.

    New modules keep their initialisation, and new rows and columns of a matrix start at zero, so that both have no
    effect at first. Modules
    that the model lacks are skipped, as in an ablation.
    """
    state, own = checkpoint.read_state(start), model.state_dict()
    begun = {name: _grow(value, state[name]) for name, value in own.items() if name in state}
    odd = sorted(name for name, value in begun.items() if value is None)
    if odd or not begun:
        raise CheckpointError(
            f"{start}: cannot start this preset, tensor {(odd or sorted(state))[0]} does not fit; "
            "start from weights of the same architecture."
        )
    model.load_state_dict(begun, strict=False)


def _grow(new: Tensor, old: Tensor) -> Tensor | None:
    """Copy old values to the start of the new tensor; None where they do not fit."""
    if new.dim() != old.dim() or any(n < o for n, o in zip(new.shape, old.shape)):
        return None
    grown = torch.zeros_like(new) if new.dim() > 1 else new.clone()
    grown[tuple(slice(0, o) for o in old.shape)] = old.to(new.dtype)
    return grown
