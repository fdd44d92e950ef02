# SPDX-License-Identifier: Apache-2.0
"""The map model's training loop: plain, keyed, resumable, in one process or several; the schedule is the detector's.

A step sees every look by itself, fuses those of each tile by their claimed poses, and draws; nothing reaches a tile but tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from manyeyes.datatypes import SparseBev, Transform
from manyeyes.models import checkpoint
from manyeyes.models.map_presets import FORMAT
from manyeyes.models.mapper import Look, Mapper, MapperConfig
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.map_losses import MapLossConfig, MapTerms, ink_loss, map_terms
from manyeyes.training.map_samples import MapAugment, MapSample, MapSamples
from manyeyes.training.map_sketches import around_seen, sketch_loss, sketch_of
from manyeyes.training.map_targets import met, target_of
from manyeyes.training.run_state import RunState, warm_cosine


@dataclass(frozen=True)
class MapTrainConfig:
    """A run. batch: tiles a step over all processes. warm_up: steps of linear growth of the learning rate, then a cosine to zero.

    thin: the greatest share of a look's tokens that is left out, those of least worth, as a budget in bytes would; uniform, so that
    the model knows tiles of many bytes and of few. ema: decay of the averaged weights that are saved. beta2: decay of Adam's mean
    square; at the usual 0.999 it still divides by the great gradients of the start when half of a short run is over. sketch_steps:
    first steps in which the decoder is not taught, since what it would begin from shows nothing yet.
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


def see(model: Mapper, samples: Sequence[MapSample]) -> Look:
    """Every look of all samples by itself, with the sensors that the model has."""
    looks = [look for sample in samples for look in sample.looks]
    sensors = model.config.bev.sensors
    clouds = [look.points for look in looks] if "lidar" in sensors else []
    return model.see(clouds, [look.images for look in looks] if "camera" in sensors else [])


def placed(model: Mapper, tokens: SparseBev, samples: Sequence[MapSample]) -> tuple[Tensor, Tensor]:
    """Tokens of all looks in order on the cells of all samples' tiles, and what each look sees there, as ``Mapper.merge`` wants."""
    poses = [sample.tile_from_look for sample in samples]
    motion = Transform(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))
    tile = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor([len(s.looks) for s in samples]))
    return model.place(tokens, motion, tile, len(samples))


def thinned(tokens: SparseBev, worth: Tensor, share: Tensor) -> SparseBev:
    """The tokens without the share (looks,) of least worth (N,) of each look."""
    batch = tokens.sites.batch
    order = worth.argsort(stable=True)
    order = order[batch[order].argsort(stable=True)]
    count = torch.bincount(batch, minlength=tokens.sites.batch_size)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order)) - (count.cumsum(0) - count)[batch[order]]
    return tokens.keep(rank >= (share * count).floor()[batch])


def loss_terms(
    model: Mapper,
    samples: Sequence[MapSample],
    config: MapLossConfig,
    share: Tensor | None = None,
    draws: bool = True,
) -> MapTerms:
    """Losses of one batch of tiles; share (looks,): how much of each look's tokens is left out; draws: is the decoder taught?"""
    look = see(model, samples)
    drawn = torch.cat([sample.ink for sample in samples]).permute(0, 2, 3, 1).flatten(0, 2)[look.tokens.sites.key]
    ink = ink_loss(look.ink, drawn.float())
    tokens = look.tokens if share is None else thinned(look.tokens, look.worth, share)
    features, seen = placed(model, tokens, samples)
    ground = model.merge(features, seen)
    head, tile = model.config.head, model.config.tile
    around = around_seen(seen.any(1), tile)
    sketch = model.sketch(ground)
    wanted = [sketch_of(one.truth, tile, head.kinds).within(part) for one, part in zip(samples, around)]
    sketched = sketch_loss(sketch, wanted)
    if not draws:
        return MapTerms.undrawn(ink, sketched)
    truths = [met(one.truth, part, tile) for one, part in zip(samples, around)]
    targets = [target_of(truth, tile, head.kinds, head.points) for truth in truths]
    many = model.draw(ground, "many", sketch) if head.many else ()
    return map_terms(model.draw(ground, "one", sketch), many, ink, sketched, targets, config)


class MapRun:
    """One training run of the map model, in a folder from which it resumes."""

    def __init__(self, config: MapTrainConfig, samples: MapSamples, folder: Path, seed: int) -> None:
        self.config, self.samples, self.seed = config, samples, seed
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            model = Mapper(config.mapper)
        self.state = RunState(model, config, seed, folder, config.weight_decay, config.beta2)

    def advance(self) -> MapProgress:
        """One step of the optimiser."""
        config, state = self.config, self.state
        numbers = state.numbers(config.batch)
        samples = [self.samples.draw(number) for number in numbers]
        looks = sum(len(sample.looks) for sample in samples)
        thin = config.thin * keyed_uniform((looks,), "thin", self.seed, numbers.start).float()
        terms = loss_terms(state.model.train(), samples, config.loss, thin, state.step >= config.sketch_steps)
        loss = terms.total(config.loss)
        rate = config.learning_rate * warm_cosine(config.warm_up, state.step, config.steps)
        state.descend(loss, rate, config.clip, config.ema)
        return MapProgress(state.step, config.steps, float(loss.detach()), terms, rate, state.seconds)


def train_mapper(
    config: MapTrainConfig,
    samples: MapSamples,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[MapProgress], None] = lambda progress: None,
) -> Path:
    """Train, or go on where the run in folder stopped; returns the file of averaged weights, whose card names the towns.

    Writes last.pt (to resume), log.jsonl (one object a step) and weights.safetensors (float16).
    """
    run = MapRun(config, samples, folder, seed)
    state = run.state
    state.finish(config.steps, config.save_every, run.advance, report)
    weights = folder / "weights.safetensors"
    if not state.rank:
        about = {
            "seed": seed,
            "steps": config.steps,
            "towns": list(samples.towns),
            "train_seconds": round(state.seconds),
            "config": asdict(config),
        }
        checkpoint.save(state.average, weights, {**about, **(card or {})}, half=True, format=FORMAT)
    return weights
