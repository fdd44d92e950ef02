# SPDX-License-Identifier: Apache-2.0
"""The training loop of the map model: keyed randomness, resumable, one or more processes; the detector's schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.checkpointing import RunState, warmup_cosine
from manyeyes.training.maps.losses import MapLossConfig, MapLossTerms
from manyeyes.training.maps.samples import MapAugmentConfig, MapSamples
from manyeyes.training.maps.score_calibration import calibrate_scores
from manyeyes.training.maps.step import loss_terms

_CALIBRATION_TENSORS = ("logit_scale", "logit_shift")


@dataclass(frozen=True)
class MapTrainConfig:
    """Settings of a training run.

    Attributes:
        map_model: configuration of the model.
        batch: tiles per step over all processes.
        beta2: decay of Adam's second moment; with 0.999, the large initial gradients still dominate at half of a
            short run.
        warmup_steps: steps of linear growth of the learning rate, before a cosine to zero.
        max_grad_norm: at which gradients are clipped.
        ema_decay: decay of the averaged weights, which are saved.
        max_token_dropout: maximum fraction of a frame's tokens that are dropped, lowest scores first, as under a byte
            budget; uniform.
        line_field_steps: first steps without training of the decoder, while the line field is still uninformative.
        calibration_tiles: tiles after those of the last step that calibrate the scores; 0 disables calibration.
        micro_batch: tiles that a process holds in memory together; batch norms see one part at a time.
    """

    map_model: MapModelConfig
    steps: int
    batch: int = 4
    learning_rate: float = 6e-4
    weight_decay: float = 1e-2
    beta2: float = 0.98
    warmup_steps: int = 100
    max_grad_norm: float = 35.0
    ema_decay: float = 0.998
    max_token_dropout: float = 0.9
    line_field_steps: int = 0
    calibration_tiles: int = 0
    micro_batch: int = 8
    save_every: int = 100
    augment: MapAugmentConfig = field(default_factory=MapAugmentConfig)
    loss: MapLossConfig = field(default_factory=MapLossConfig)


@dataclass(frozen=True)
class MapProgress:
    """Progress of one step: one line of the log."""

    step: int
    steps: int
    loss: float
    terms: MapLossTerms
    learning_rate: float
    seconds: float

    def to_record(self) -> dict[str, float]:
        """Return the line of log.jsonl."""
        terms = {name: round(float(value.detach()), 5) for name, value in vars(self.terms).items()}
        return {"step": self.step, "loss": round(self.loss, 5), **terms, "lr": self.learning_rate}


class MapRun:
    """A resumable training run of the map model in a folder."""

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
            model = MapModel(config.map_model)
        _begin_from(model, start)
        self.state = RunState(model, config, seed, folder, config.weight_decay, config.beta2, bool(start))

    def advance(self) -> MapProgress:
        """Run one optimiser step."""
        config, state = self.config, self.state
        numbers = state.sample_numbers(config.batch)
        loss, parts = 0.0, []
        for first in numbers[:: config.micro_batch]:
            part = [self.samples.draw(number) for number in numbers[first - numbers.start :][: config.micro_batch]]
            num_frames = sum(len(sample.frames) for sample in part)
            dropout = config.max_token_dropout * keyed_uniform((num_frames,), "thin", self.seed, first).float()
            terms = loss_terms(state.model.train(), part, config.loss, dropout, state.step >= config.line_field_steps)
            share = len(part) / len(numbers)
            loss += state.backward(terms.total(config.loss), share)
            parts.append(terms.scale(share))
        rate = config.learning_rate * warmup_cosine(config.warmup_steps, state.step, config.steps)
        state.optimiser_step(rate, config.max_grad_norm, config.ema_decay)
        return MapProgress(state.step, config.steps, loss, MapLossTerms.add_up(parts), rate, state.seconds)


def train_map_model(
    config: MapTrainConfig,
    samples: MapSamples,
    folder: Path,
    seed: int = 0,
    card: dict[str, Any] | None = None,
    report: Callable[[MapProgress], None] = lambda progress: None,
    start: Sequence[Mapping[str, torch.Tensor]] = (),
) -> Path:
    """Train, or resume the run in folder; returns the file of averaged weights, whose card names the towns.

    start: tensors of map models that initialise the model where names and shapes agree; earlier ones take precedence.
    Writes last.pt
    (training state), log.jsonl (one object per step) and weights.safetensors (float16).
    """
    run = MapRun(config, samples, folder, seed, start)
    state = run.state
    state.run_to_end(config.steps, config.save_every, run.advance, report)
    weights = folder / "weights.safetensors"
    if not state.rank:
        first = config.steps * config.batch
        calibrate_scores(
            state.average, (samples.draw(number) for number in range(first, first + config.calibration_tiles))
        )
        about = {
            "seed": seed,
            "steps": config.steps,
            "towns": list(samples.towns),
            "train_seconds": round(state.seconds),
            "config": asdict(config),
        }
        checkpoint.save(state.average, weights, {**about, **(card or {})}, half=True, format=FORMAT)
    return weights


def _begin_from(model: MapModel, start: Sequence[Mapping[str, torch.Tensor]]) -> None:
    """Copy tensors of equal name and shape, such as tile and head of a model of other sensors."""
    own = model.state_dict()
    for state in reversed(start):
        # Calibration follows training, so its tensors start anew.
        fitting = {
            k: v.float()
            for k, v in state.items()
            if k in own and v.shape == own[k].shape and k not in _CALIBRATION_TENSORS
        }
        if not fitting:
            raise ConfigError(
                "None of the given weights' tensors fits this preset; start from a map model of its size."
            )
        model.load_state_dict(fitting, strict=False)
