# SPDX-License-Identifier: Apache-2.0
"""The map model's training loop: plain, keyed, resumable, in one process or several; the schedule is the detector's.

A step sees every look by itself, fuses those of each tile by their claimed poses, and draws; nothing reaches a tile but tokens.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from manyeyes.datatypes import CheckpointError, ConfigError, SparseBev, Transform
from manyeyes.models import checkpoint
from manyeyes.models.checkpoint import config_to_json
from manyeyes.models.map_presets import FORMAT
from manyeyes.models.mapper import Look, Mapper, MapperConfig
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.loop import mean_in_place, parameter_groups, trim_log, warm_cosine
from manyeyes.training.map_losses import MapLossConfig, MapTerms, ink_loss, map_terms
from manyeyes.training.map_samples import MapAugment, MapSample, MapSamples
from manyeyes.training.map_targets import target_of


@dataclass(frozen=True)
class MapTrainConfig:
    """A run. batch: tiles a step over all processes. warm_up: steps of linear growth of the learning rate, then a cosine to zero.

    thin: the greatest share of a look's tokens that is left out, those of least worth, as a budget in bytes would; uniform, so that
    the model knows tiles of many bytes and of few. ema: decay of the averaged weights that are saved.
    """

    mapper: MapperConfig
    steps: int
    batch: int = 4
    learning_rate: float = 6e-4
    weight_decay: float = 1e-2
    warm_up: int = 100
    clip: float = 35.0
    ema: float = 0.998
    thin: float = 0.9
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


def see(model: Mapper, samples: Sequence[MapSample]) -> Look:
    """Every look of all samples by itself, with the sensors that the model has."""
    looks = [look for sample in samples for look in sample.looks]
    sensors = model.config.bev.sensors
    clouds = [look.points for look in looks] if "lidar" in sensors else []
    return model.see(clouds, [look.images for look in looks] if "camera" in sensors else [])


def ground_of(model: Mapper, tokens: SparseBev, samples: Sequence[MapSample]) -> Tensor:
    """The features of all samples' tiles, of tokens of all their looks in order."""
    poses = [sample.tile_from_look for sample in samples]
    motion = Transform(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))
    tile = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor([len(s.looks) for s in samples]))
    return model.fuse(tokens, motion, tile, len(samples))


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
    model: Mapper, samples: Sequence[MapSample], config: MapLossConfig, share: Tensor | None = None
) -> MapTerms:
    """Losses of one batch of tiles; share (looks,): how much of each look's tokens is left out."""
    look = see(model, samples)
    drawn = torch.cat([sample.ink for sample in samples]).permute(0, 2, 3, 1).flatten(0, 2)[look.tokens.sites.key]
    ink = ink_loss(look.ink, drawn.float())
    tokens = look.tokens if share is None else thinned(look.tokens, look.worth, share)
    ground = ground_of(model, tokens, samples)
    head = model.config.head
    targets = [target_of(sample.truth, model.config.tile, head.kinds, head.points) for sample in samples]
    many = model.draw(ground, "many") if head.many else ()
    return map_terms(model.draw(ground), many, ink, targets, config)


class MapRun:
    """Model, optimiser and average of one training run, in a folder from which it resumes."""

    def __init__(self, config: MapTrainConfig, samples: MapSamples, folder: Path, seed: int) -> None:
        self.config, self.samples, self.folder, self.seed = config, samples, folder, seed
        self.rank, self.world = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        if config.batch % self.world:
            raise ConfigError(f"A batch of {config.batch} tiles cannot be shared by {self.world} processes evenly.")
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.model = Mapper(config.mapper)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self.optimiser = torch.optim.AdamW(parameter_groups(self.model, config.weight_decay), lr=config.learning_rate)
        self.step, self.seconds = 0, 0.0
        if self.state_path.exists():
            self._resume()

    @property
    def state_path(self) -> Path:
        """Where the run is kept between saves."""
        return self.folder / "last.pt"

    def advance(self) -> MapProgress:
        """One step of the optimiser."""
        began, config = time.monotonic(), self.config
        self.model.train()
        share = config.batch // self.world
        first = self.step * config.batch + self.rank * share
        samples = [self.samples.draw(first + i) for i in range(share)]
        rate = config.learning_rate * warm_cosine(config.warm_up, self.step, config.steps)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        looks = sum(len(sample.looks) for sample in samples)
        thin = config.thin * keyed_uniform((looks,), "thin", self.seed, first).float()
        terms = loss_terms(self.model, samples, config.loss, thin)
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
        return MapProgress(self.step, config.steps, float(loss.detach()), terms, rate, self.seconds)

    def _share_gradients(self) -> None:
        """The mean over processes, one flat exchange; a parameter that nobody used has none."""
        if self.world == 1:
            return
        for p in self.model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        mean_in_place([p.grad for p in self.model.parameters() if p.grad is not None], self.world)

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        for mean, value in zip(self.average.parameters(), self.model.parameters()):
            mean.lerp_(value, 1 - decay)

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
    folder.mkdir(parents=True, exist_ok=True)
    if run.rank == 0:
        trim_log(folder / "log.jsonl", run.step)
    while run.step < config.steps:
        progress = run.advance()
        if run.rank == 0:
            with (folder / "log.jsonl").open("a") as log:
                log.write(json.dumps(_log_line(progress)) + "\n")
            report(progress)
        if run.step % config.save_every == 0 or run.step == config.steps:
            run.save()
    weights = folder / "weights.safetensors"
    if run.rank == 0:
        about = {
            "seed": seed,
            "steps": config.steps,
            "towns": list(samples.towns),
            "train_seconds": round(run.seconds),
            "config": asdict(config),
            **(card or {}),
        }
        checkpoint.save(run.average, weights, about, half=True, format=FORMAT)
    return weights


def _log_line(progress: MapProgress) -> dict[str, float]:
    terms = {name: round(float(value.detach()), 5) for name, value in vars(progress.terms).items()}
    return {"step": progress.step, "loss": round(progress.loss, 5), **terms, "lr": progress.learning_rate}
