# SPDX-License-Identifier: Apache-2.0
"""Training of the map model as a task: settings, samples, loss, initial weights, calibration of scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT
from manyeyes.models.token_peaks import CARD_KEY, NUM_SAMPLES, measure_token_peaks
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.training.maps.losses import MapLossConfig
from manyeyes.training.maps.samples import MapAugmentConfig, MapSample, MapSamples
from manyeyes.training.maps.score_calibration import calibrate_scores
from manyeyes.training.maps.step import extract_features, loss_terms
from manyeyes.training.trainer import Task, TrainConfig

_CALIBRATION_TENSORS = ("logit_scale", "logit_shift")


@dataclass(frozen=True)
class MapTrainConfig(TrainConfig):
    """Settings of a training run of the map model.

    Attributes:
        map_model: configuration of the model.
        batch: tiles per step over all processes.
        beta2: with 0.999, the large initial gradients still dominate at half of a short run.
        max_token_dropout: maximum fraction of a frame's tokens that are dropped, lowest scores first, as under a byte
            budget; uniform.
        line_field_steps: first steps without training of the decoder, while the line field is still uninformative.
        calibration_tiles: tiles after those of the last step that calibrate the scores; 0 disables calibration.
    """

    map_model: MapModelConfig
    _: KW_ONLY
    learning_rate: float = 6e-4
    beta2: float = 0.98
    max_grad_norm: float = 35.0
    ema_decay: float = 0.998
    micro_batch: int | None = 8
    save_every: int = 100
    max_token_dropout: float = 0.9
    line_field_steps: int = 0
    calibration_tiles: int = 0
    augment: MapAugmentConfig = field(default_factory=MapAugmentConfig)
    loss: MapLossConfig = field(default_factory=MapLossConfig)


@dataclass
class MapTask(Task[MapTrainConfig, MapModel, MapSample]):
    """Train a map model on tiles; its card names their towns.

    start: tensors of map models that initialise the model where names and shapes agree; earlier ones take precedence.
    """

    format = FORMAT

    config: MapTrainConfig
    samples: MapSamples
    seed: int = 0
    start: Sequence[Mapping[str, Tensor]] = ()

    @property
    def is_initialised(self) -> bool:
        """Whether tensors of other models are given."""
        return bool(self.start)

    def make_model(self) -> MapModel:
        """Make the map model, random or from the given tensors."""
        model = MapModel(self.config.map_model)
        _begin_from(model, self.start)
        return model

    def draw(self, number: int) -> MapSample:
        """Draw the tile of this number."""
        return self.samples.draw(number)

    def loss(
        self, model: MapModel, samples: list[MapSample], numbers: range, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the losses of tiles whose frames lack random fractions of their tokens."""
        config, num_frames = self.config, sum(len(sample.frames) for sample in samples)
        dropout = config.max_token_dropout * keyed_uniform((num_frames,), "thin", self.seed, numbers.start).float()
        terms = loss_terms(model, samples, config.loss, dropout, step >= config.line_field_steps)
        return terms.total(config.loss), vars(terms)

    def finish(self, model: MapModel) -> dict[str, Any]:
        """Calibrate the scores, and measure the range of the tokens, on tiles after those of training."""
        first, was = self.steps * self.config.batch, model.training
        calibrate_scores(model, map(self.draw, range(first, first + self.config.calibration_tiles)))
        model.eval()
        with torch.inference_mode():
            tiles = map(self.draw, range(first, first + NUM_SAMPLES))
            tokens = (extract_features(model, [tile]).tokens.features for tile in tiles)
            peaks = measure_token_peaks(tokens, model.config.token_channels)
        model.train(was)
        return {"towns": list(self.samples.towns), CARD_KEY: peaks}


def _begin_from(model: MapModel, start: Sequence[Mapping[str, Tensor]]) -> None:
    """Copy tensors of equal name and shape, such as tile and head of a model of other sensors."""
    own = model.state_dict()
    for state in reversed(start):
        # Calibration follows training, so its tensors start again.
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
