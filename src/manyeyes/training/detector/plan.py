# SPDX-License-Identifier: Apache-2.0
"""Training plans: stages in order, each initialised by the one before, then a codebook, then the weights that ship."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch.distributed as dist

from manyeyes.datasets.base import Recording, iter_eval_frames
from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector, DetectorConfig
from manyeyes.models.detector.fold_norms import fold_norms
from manyeyes.models.score_calibration import CARD_KEY as SCORE_KEY
from manyeyes.models.sensor_domain import CARD_KEY as SENSOR_KEY
from manyeyes.models.token_peaks import CARD_KEY
from manyeyes.training.detector.codebook import CollectionProgress, attach_codebook, fit_codebook
from manyeyes.training.detector.score_calibration import calibrate_detector
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.devices import Execution
from manyeyes.training.monitor import Progress
from manyeyes.training.run_identity import RunIdentity
from manyeyes.training.trainer import Trainer

WEIGHTS = "weights.safetensors"
CODEBOOK, CALIBRATION = "codebook", "calibration"
"""Folders of the weights with a codebook, and of those with calibrated scores too, in that of the run."""


@dataclass(frozen=True)
class TrainPlan:
    """What gives weights that ship, from nothing or from given weights.

    Attributes:
        stages: name and settings of each stage; stage k is trained with the seed of the plan plus k.
        released: configuration of the weights that ship, with tensors of the same shapes; None for that of the last stage.
        codebook: settings of the codebook that is fitted after the last stage; "start" for that of the initial weights; None for no
            codebook.
        codebook_frames: maximum number of evaluated frames that the codebook is fitted to, spread evenly.
        calibration_frames: maximum number of evaluated frames of validation that scores are calibrated on, spread evenly.
    """

    stages: tuple[tuple[str, DetectorTrainConfig], ...]
    _: KW_ONLY
    released: DetectorConfig | None = None
    codebook: CodebookConfig | Literal["start"] | None = CodebookConfig()
    codebook_frames: int = 400
    calibration_frames: int = 300

    def __post_init__(self) -> None:
        names = [name for name, _ in self.stages]
        if not names or len(set(names)) < len(names) or {CODEBOOK, CALIBRATION} & set(names):
            raise ConfigError(
                f"TrainPlan.stages needs names of its own for each stage, none '{CODEBOOK}' or '{CALIBRATION}'; got {names}."
            )

    @property
    def steps(self) -> int:
        """Number of optimiser steps of all stages; epochs are not counted."""
        return sum(config.steps for _, config in self.stages)

    def change_stages(self, **changes: Any) -> TrainPlan:
        """Return the plan with fields of every stage's settings replaced."""
        return replace(self, stages=tuple((name, replace(config, **changes)) for name, config in self.stages))


Report = Callable[[str, Progress], None]


def _report_nothing(stage: str, progress: Progress) -> None:
    pass


@dataclass(frozen=True)
class PlanRun:
    """A run of a plan in a folder; a killed one, made and run again, ends with the same weights bit by bit.

    The folder holds one folder a stage, as of :class:`manyeyes.training.trainer.Trainer`, the folders ``codebook`` and
    ``calibration``, and weights.safetensors. Of a finished stage only its weights are needed, so that the rest of its folder may be
    deleted, and the folders of equal stages of another plan may be copied. Hold the lock of the folder, as for one stage.

    Attributes:
        plan: what is trained.
        recording: training samples.
        seed: of the first stage.
        folder: of the run.
        start: weights file that the first stage begins from.
        validation: recording on which stages are validated and scores calibrated; None leaves scores as they are.
        execution: how stages are computed; the codebook and calibration are computed on the CPU.
    """

    plan: TrainPlan
    recording: Recording
    seed: int
    folder: Path
    start: Path | None = None
    validation: Recording | None = None
    execution: Execution = Execution()

    def run(self, card: dict[str, Any] | None = None, report: Report = _report_nothing) -> Path:
        """Run what is left of the plan; returns the file of the final weights.

        Args:
            card: additions to the model cards of all weights.
            report: called at every step of a stage with its name.

        Raises:
            CheckpointError: a folder holds a stage of other settings, another seed or other initial weights.
            KeyboardInterrupt: SIGINT or SIGTERM came; the state after the current step is saved.
        """
        card, weights, stages = card or {}, self.start, list[dict[str, Any]]()
        for number, (name, _) in enumerate(self.plan.stages):
            weights = self._run_stage(number, weights, card, report)
            stages.append({"name": name, **_select_stage_facts(checkpoint.read_card(weights))})
        assert weights is not None
        final = self.folder / WEIGHTS
        if not dist.is_initialized() or dist.get_rank() == 0:
            summary = {"seed": self.seed, "steps": sum(stage["steps"] for stage in stages)}
            summary |= {"train_seconds": sum(stage["train_seconds"] for stage in stages), "stages": stages}
            last = self._calibrate(self._fit_codebook(weights, {**card, **summary}))
            checkpoint.save(checkpoint.load(last), final, checkpoint.read_card(last), half=True)
        _wait_for_first()
        return final

    def _run_stage(self, number: int, start: Path | None, card: dict[str, Any], report: Report) -> Path:
        """Run a stage unless its weights are there; returns them."""
        name, config = self.plan.stages[number]
        seed, folder = self.seed + number, self.folder / name
        begun = "" if start is None else checkpoint.load(start).fingerprint.hex()
        if (folder / WEIGHTS).exists():
            _check_stage(folder / WEIGHTS, config, seed, begun)
            return folder / WEIGHTS
        task, execution = DetectorTask(config, self.recording, seed, start, self.validation), self.execution
        trainer = Trainer(task, folder, execution.device, execution.workers, execution.tensorboard)
        weights = trainer.run({**card, "started_from": begun}, lambda progress: report(name, progress))
        _wait_for_first()
        return weights

    def _fit_codebook(self, weights: Path, card: dict[str, Any]) -> Path:
        """Write the weights under their released configuration, with a codebook where the plan has one; returns the file."""
        plan, path = self.plan, self.folder / CODEBOOK / WEIGHTS
        seed = self.seed + len(plan.stages)
        trained = checkpoint.load(weights)
        source = trained.fingerprint.hex()
        given = self._load_start() if plan.codebook == "start" else None
        config = replace(plan.released or trained.config, codebook=self._codebook_config(given))
        if path.exists():
            fitted = checkpoint.read_card(path).get("codebook", {})
            if (fitted.get("seed"), fitted.get("started_from")) == (seed, source) and checkpoint.load(
                path
            ).config == config:
                return path
        detector, tokens = with_config(trained, config), 0

        def count(progress: CollectionProgress) -> None:
            nonlocal tokens
            tokens = progress.tokens

        if given is not None:
            detector = attach_codebook(detector, given)
        elif isinstance(plan.codebook, CodebookConfig):
            frames = sum(1 for _ in iter_eval_frames(self.recording))
            stride = max(1, frames // plan.codebook_frames)
            detector = fit_codebook(detector, self.recording, seed, plan.codebook, stride, count)
        about = {"seed": seed, "tokens": tokens, "started_from": source}
        measured = checkpoint.read_card(weights)
        kept = {key: measured[key] for key in (CARD_KEY, SENSOR_KEY) if key in measured}
        checkpoint.save(detector, path, {**card, **kept, "codebook": about}, half=True)
        return path

    def _codebook_config(self, given: Detector | None) -> CodebookConfig | None:
        """Return the settings of the final codebook; given: the initial detector, where its codebook is kept."""
        if given is not None:
            return given.config.codebook
        return self.plan.codebook if isinstance(self.plan.codebook, CodebookConfig) else None

    def _load_start(self) -> Detector:
        """Return the initial detector, whose codebook is kept.

        Raises:
            ConfigError: there are none, or they have no codebook.
        """
        initial = None if self.start is None else checkpoint.load(self.start)
        if initial is None or initial.codebook is None:
            raise ConfigError("The initial weights have no codebook that could be kept; fit one instead.")
        return initial

    def _calibrate(self, weights: Path) -> Path:
        """Write the weights with calibrated scores, where there is a recording of validation; returns the file."""
        if self.validation is None:
            return weights
        path, source = self.folder / CALIBRATION / WEIGHTS, checkpoint.load(weights).fingerprint
        if path.exists() and checkpoint.load(path).fingerprint == source:
            return path
        validation = self.validation
        frames = sum(1 for _ in iter_eval_frames(validation))
        stride = max(1, frames // self.plan.calibration_frames)
        detector = fold_norms(checkpoint.load(weights))
        calibration, _ = calibrate_detector(lambda: validation, detector, stride)
        card = checkpoint.read_card(weights) | {SCORE_KEY: calibration.to_card()}
        checkpoint.save(checkpoint.load(weights), path, card, half=True)
        return path


def with_config(detector: Detector, config: DetectorConfig) -> Detector:
    """Return the detector with another configuration, whose tensors have the same shapes; its codebook stays."""
    changed = Detector(replace(config, codebook=detector.config.codebook))
    changed.load_state_dict(detector.state_dict())
    changed.eval().requires_grad_(False)
    changed.fingerprint, changed.token_peaks = checkpoint.fingerprint(changed), detector.token_peaks
    return changed


def _select_stage_facts(card: dict[str, Any]) -> dict[str, Any]:
    return {
        key: card[key]
        for key in ("seed", "steps", "train_seconds", "started_from", "git_commit", "config")
        if key in card
    }


def _check_stage(path: Path, config: DetectorTrainConfig, seed: int, begun: str) -> None:
    """Refuse weights of a stage that do not belong to this run; fields that are newer than the weights have their defaults."""
    card = checkpoint.read_card(path)
    stored = {"config": json.dumps(card.get("config")), "seed": card.get("seed"), "begun": card.get("started_from")}
    differences = RunIdentity(config, seed, begun).list_differences(stored)
    if differences:
        raise CheckpointError(
            f"{path}: belongs to a stage of another run: {'; '.join(differences)}. Give another --out, or delete its folder."
        )


def _wait_for_first() -> None:
    """Wait until the first process has written its files."""
    if dist.is_initialized():
        dist.barrier()
