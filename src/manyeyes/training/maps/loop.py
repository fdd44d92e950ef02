# SPDX-License-Identifier: Apache-2.0
"""The map model's training loop: plain, keyed, resumable, in one process or several; the schedule is the detector's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.maps.map_model import Mapper, MapperConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.checkpointing import RunState, warm_cosine
from manyeyes.training.maps.losses import MapLossConfig, MapTerms
from manyeyes.training.maps.samples import MapAugment, MapSamples
from manyeyes.training.maps.score_calibration import calibrate
from manyeyes.training.maps.step import loss_terms

_LAST = ("scale", "shift")


@dataclass(frozen=True)
class MapTrainConfig:
    """A run. batch: tiles a step over all processes. warm_up: steps of linear growth of the learning rate, then a cosine to zero.

    thin: the greatest share of a look's tokens that is left out, those of least worth, as a budget in bytes would; uniform, so that
    the model knows tiles of many bytes and of few. ema: decay of the averaged weights that are saved. beta2: decay of Adam's mean
    square; at the usual 0.999 it still divides by the great gradients of the start when half of a short run is over. sketch_steps:
    first steps in which the decoder is not taught, since what it would begin from shows nothing yet. calibrated: tiles that follow
    those of the last step, by which scores are brought to what is true in the end; without any they stay as they are. at_once:
    tiles that a process holds in memory together; parts of a batch are normed each by itself, as those of several processes are.
    """

    mapper: MapperConfig
    steps: int
    batch: int = 4
    learning_rate: float = 6e-4
    weight_decay: float = 1e-2
    beta2: float = 0.98
    warm_up: int = 100
    clip: float = 35.0
    ema: float = 0.998
    thin: float = 0.9
    sketch_steps: int = 0
    calibrated: int = 0
    at_once: int = 8
    save_every: int = 100
    augment: MapAugment = field(default_factory=MapAugment)
    loss: MapLossConfig = field(default_factory=MapLossConfig)


@dataclass(frozen=True)
class MapProgress:
    """One line of the log."""

    step: int
    steps: int
    loss: float
    terms: MapTerms
    learning_rate: float
    seconds: float

    def line(self) -> dict[str, float]:
        """As it stands in log.jsonl."""
        terms = {name: round(float(value.detach()), 5) for name, value in vars(self.terms).items()}
        return {"step": self.step, "loss": round(self.loss, 5), **terms, "lr": self.learning_rate}


class MapRun:
    """One training run of the map model, in a folder from which it resumes."""

    def __init__(
        self,
        config: MapTrainConfig,
        samples: MapSamples,
        folder: Path,
        seed: int,
        start: Sequence[Mapping[str, torch.Tensor]] = (),
    ) -> None:
        self.config, self.samples, self.seed = config, samples, seed
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            model = Mapper(config.mapper)
        _begin_from(model, start)
        self.state = RunState(model, config, seed, folder, config.weight_decay, config.beta2, bool(start))

    def advance(self) -> MapProgress:
        """One step of the optimiser."""
        config, state = self.config, self.state
        numbers = state.numbers(config.batch)
        loss, parts = 0.0, []
        for first in numbers[:: config.at_once]:
            part = [self.samples.draw(number) for number in numbers[first - numbers.start :][: config.at_once]]
            looks = sum(len(sample.looks) for sample in part)
            thin = config.thin * keyed_uniform((looks,), "thin", self.seed, first).float()
            terms = loss_terms(state.model.train(), part, config.loss, thin, state.step >= config.sketch_steps)
            share = len(part) / len(numbers)
            loss += state.backward(terms.total(config.loss), share)
            parts.append(terms.shared(share))
        rate = config.learning_rate * warm_cosine(config.warm_up, state.step, config.steps)
        state.descend(rate, config.clip, config.ema)
        return MapProgress(state.step, config.steps, loss, MapTerms.summed(parts), rate, state.seconds)


def train_mapper(
    config: MapTrainConfig,
    samples: MapSamples,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[MapProgress], None] = lambda progress: None,
    start: Sequence[Mapping[str, torch.Tensor]] = (),
) -> Path:
    """Train, or go on where the run in folder stopped; returns the file of averaged weights, whose card names the towns.

    start: tensors of map models to begin from, in place of random ones where they fit; the first that has one has the say.
    Writes last.pt (to resume), log.jsonl (one object a step) and weights.safetensors (float16).
    """
    run = MapRun(config, samples, folder, seed, start)
    state = run.state
    state.finish(config.steps, config.save_every, run.advance, report)
    weights = folder / "weights.safetensors"
    if not state.rank:
        first = config.steps * config.batch
        calibrate(state.average, (samples.draw(number) for number in range(first, first + config.calibrated)))
        about = {
            "seed": seed,
            "steps": config.steps,
            "towns": list(samples.towns),
            "train_seconds": round(state.seconds),
            "config": asdict(config),
        }
        checkpoint.save(state.average, weights, {**about, **(card or {})}, half=True, format=FORMAT)
    return weights


def _begin_from(model: Mapper, start: Sequence[Mapping[str, torch.Tensor]]) -> None:
    """Tensors of these names and shapes are taken over: a model of other sensors has its tiles and its drawing in common."""
    own = model.state_dict()
    for state in reversed(start):
        # Scores are calibrated in the end; what is taught is what comes before.
        fitting = {k: v.float() for k, v in state.items() if k in own and v.shape == own[k].shape and k not in _LAST}
        if not fitting:
            raise ConfigError(
                "None of the given weights' tensors fits this preset; begin from a map model of its size."
            )
        model.load_state_dict(fitting, strict=False)
