# SPDX-License-Identifier: Apache-2.0
"""Training of the detector as a task: settings, samples, loss, initial weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from manyeyes.datasets.base import Recording
from manyeyes.datasets.recording_check import check_recording
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.models.sensor_domain import write_sensor_domain
from manyeyes.models.token_peaks import CARD_KEY, NUM_SAMPLES, measure_token_peaks
from manyeyes.ops.lidar.sweep_statistics import SensorDomain
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, Sample, SampleStream, epoch_length
from manyeyes.training.detector.step import loss_terms
from manyeyes.training.detector.targets import TargetConfig
from manyeyes.training.detector.validation import draw_frame, measure_ap, select_frames
from manyeyes.training.trainer import Task, TrainConfig

if TYPE_CHECKING:
    from PIL.Image import Image

NUM_SENSOR_SCENARIOS = 60
"""Maximum number of scenarios whose sensors are measured at the end of training."""
_NEW_CLASS_HEAT, _NEW_CLASS_RESIDUAL = -6.0, -4.0
"""Logit of the heat of a class that initial weights do not have, and what fusion adds to it."""


@dataclass(frozen=True)
class DetectorTrainConfig(TrainConfig):
    """Settings of a training run of the detector.

    Attributes:
        detector: configuration of the model.
        steps: number of optimiser steps; 0 to use epochs.
        epochs: passes over the evaluated frames.
        prune_warmup_start: fraction of the run at which the pruning threshold starts to grow from 0.
        prune_warmup_end: fraction of the run at which it reaches that of the detector.
    """

    detector: DetectorConfig
    _: KW_ONLY
    steps: int = 0
    epochs: float = 90.0
    warmup_steps: int = 500
    prune_warmup_start: float = 0.03
    prune_warmup_end: float = 0.10
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    degradation: DegradationConfig = field(default_factory=DegradationConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    loss: LossConfig = field(default_factory=LossConfig)


def prune_threshold(config: DetectorTrainConfig, step: int, steps: int) -> float:
    """Return the pruning threshold: 0, then linear growth from prune_warmup_start to prune_warmup_end of the run."""
    ramp = (step / steps - config.prune_warmup_start) / max(1e-9, config.prune_warmup_end - config.prune_warmup_start)
    return config.detector.prune_threshold * min(1.0, max(0.0, ramp))


class DetectorTask(Task[DetectorTrainConfig, Detector, Sample]):
    """Train a detector on samples of a recording.

    start: weights file that initialises the model; its configuration may differ where tensor shapes agree. validation: recording
    on which averaged weights are measured during training.
    """

    format = checkpoint.FORMAT

    def __init__(
        self,
        config: DetectorTrainConfig,
        recording: Recording,
        seed: int = 0,
        start: Path | None = None,
        validation: Recording | None = None,
    ) -> None:
        if config.validate_every and validation is None:
            raise ConfigError(
                "validate_every needs a recording of validation; give one (--validation), or set it to 0."
            )
        self.config, self.seed, self._start, self._validation = config, seed, start, validation
        self._teacher: Detector | None = None
        self._steps = config.steps or math.ceil(config.epochs * epoch_length(recording) / config.batch)
        self.stream = SampleStream(
            recording, config.detector.grid, config.augment, seed, config.degradation, config.detector.classes
        )

    @property
    def is_initialised(self) -> bool:
        """Whether a weights file is given."""
        return self._start is not None

    @property
    def steps(self) -> int:
        """Number of optimiser steps, of all epochs where the configuration gives none."""
        return self._steps

    def make_model(self) -> Detector:
        """Make the detector, random or from the weights file."""
        model = Detector(self.config.detector)
        if self._start is not None:
            _load_weights(model, self._start)
        return model

    def draw(self, number: int) -> Sample:
        """Draw the sample of this number."""
        return self.stream.draw(number)

    def loss(
        self, model: Detector, samples: list[Sample], numbers: range, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the losses of single-agent and fused boxes."""
        config = self.config
        threshold = prune_threshold(config, step, self.steps)
        teacher = self._make_teacher(model) if config.loss.distillation else None
        weights = config.loss.fusion_weight, config.loss.target
        terms = loss_terms(model, samples, config.targets, threshold, *weights, teacher)
        return terms.total(config.loss), terms.computed()

    def _make_teacher(self, model: Detector) -> Detector:
        """Return the detector of the initial weights, frozen, on the device of a model."""
        if self._start is None:
            raise ConfigError("LossConfig.distillation needs initial weights, which are those of the teacher (--init).")
        if self._teacher is None:
            self._teacher = Detector(self.config.detector)
            _load_weights(self._teacher, self._start)
            self._teacher.eval().requires_grad_(False).to(model.device)
        return self._teacher

    def validate(self, weights: Path) -> dict[str, float]:
        """Return AP@0.5 of intermediate fusion, where there are several agents, and of no fusion."""
        if self._validation is None:
            return super().validate(weights)
        return measure_ap(weights, select_frames(self._validation, self.config.validate_frames))

    def draw_pictures(self, weights: Path) -> dict[str, Image]:
        """Draw a frame of validation with true and detected boxes, for each method that is measured."""
        if self._validation is None:
            return {}
        return draw_frame(weights, select_frames(self._validation, self.config.validate_frames))

    def finish(self, model: Detector) -> dict[str, Any]:
        """Measure the range of the tokens on samples after those of training, and the sensors of the recording."""
        first, was = self.steps * self.config.batch, model.training
        model.eval()
        views = (view for number in range(first, first + NUM_SAMPLES) for view in self.draw(number).views)
        with torch.inference_mode():
            shared = (model.extract_tokens(view.cloud, view.previous_cloud)[0] for view in views)
            peaks = measure_token_peaks((model.pack_tokens(t).features for t in shared), model.packed_channels)
        model.train(was)
        return {CARD_KEY: peaks, **write_sensor_domain(self._measure_sensors())}

    def _measure_sensors(self) -> SensorDomain | None:
        """Measure the sensors of scenarios that are spread over the recording; intensities as augmentation presents them."""
        sensors = check_recording(self.stream.recording, NUM_SENSOR_SCENARIOS).sensors
        periods = [sensor.period_s for sensor in sensors if sensor.period_s is not None]
        return SensorDomain.of(
            [sensor.sweep for sensor in sensors], periods, any_intensity=self.config.augment.sensors is not None
        )


def _load_weights(model: Detector, start: Path) -> None:
    """Initialise the model from a file.

    New modules keep their initialisation, and new rows and columns of a matrix start at zero, so that both have no effect at first.
    Modules that the model lacks are skipped, as in an ablation. The heat of a class is that of the class in the file.
    """
    state, own = checkpoint.read_state(start), model.state_dict()
    begun = {name: _grow(value, state[name]) for name, value in own.items() if name in state}
    odd = sorted(name for name, value in begun.items() if value is None)
    if odd or not begun:
        raise CheckpointError(
            f"{start}: cannot start this preset, tensor {(odd or sorted(state))[0]} does not fit; "
            "start from weights of the same architecture."
        )
    if len(model.config.classes) > 1:
        _map_class_heat(begun, state, checkpoint.load(start).config.classes, model.config.classes)
    model.load_state_dict(begun, strict=False)


def _map_class_heat(
    begun: Mapping[str, Tensor | None], state: Mapping[str, Tensor], old_classes: Sequence[str], classes: Sequence[str]
) -> None:
    """Set the rows of heads that predict the heat of each class: those of the class in the file, low heat for a new class.

    A head for one class has no such row; its heat is row 0, which the head of fusion adds to the heat of every class. Low heat at
    first keeps a new class out of the proposals, which have the maximum over classes.
    """
    for head, new_bias in (("head", _NEW_CLASS_HEAT), ("refine", _NEW_CLASS_RESIDUAL)):
        for part, new_value in (("weight", 0.0), ("bias", new_bias)):
            rows, old = begun[f"{head}.out.{part}"], state[f"{head}.out.{part}"]
            assert rows is not None
            for row, kind in enumerate(classes, BOX_LAYOUT.total):
                if kind not in old_classes:
                    rows[row] = new_value
                elif len(old_classes) > 1:
                    rows[row] = old[BOX_LAYOUT.total + old_classes.index(kind)]
                else:
                    rows[row] = old[0] if head == "head" else 0.0


def _grow(new: Tensor, old: Tensor) -> Tensor | None:
    """Copy old values to the start of the new tensor; None where they do not fit."""
    if new.dim() != old.dim() or any(n < o for n, o in zip(new.shape, old.shape)):
        return None
    grown = torch.zeros_like(new) if new.dim() > 1 else new.clone()
    grown[tuple(slice(0, o) for o in old.shape)] = old.to(new.dtype)
    return grown
