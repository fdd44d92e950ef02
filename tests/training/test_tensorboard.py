# SPDX-License-Identifier: Apache-2.0
"""Events for TensorBoard: which scalars and pictures a run writes, every step once after a kill, and the missing extra."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor, nn

from manyeyes.datatypes import MissingExtraError
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.tensorboard import STEPS_PER_RATE
from manyeyes.training.trainer import Task, TrainConfig, Trainer

pytest.importorskip("tensorboard")
pytestmark = [pytest.mark.slow, pytest.mark.training]


class Line(nn.Linear):
    def __init__(self) -> None:
        super().__init__(2, 1)
        self.config = TrainConfig(steps=1)


@dataclass
class LineTask(Task[TrainConfig, Line, Tensor]):
    """A loss of one layer, with measures of validation that are given."""

    format = "line"
    config: TrainConfig
    seed: int = 0

    def make_model(self) -> Line:
        return Line()

    def draw(self, number: int) -> Tensor:
        return torch.tensor([float(number % 3), 1.0])

    def loss(self, model: Line, samples: list[Tensor], numbers: range, step: int) -> tuple[Tensor, dict[str, Tensor]]:
        error = (model(torch.stack(samples)) - 1).square().mean()
        return error, {"error": error}

    def validate(self, weights) -> dict[str, float]:
        return {"ap50": 0.25}


CONFIG = TrainConfig(steps=2 * STEPS_PER_RATE + 5, batch=1, save_every=4, validate_every=STEPS_PER_RATE + 2)


def read_events(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "tensorboard"), {"scalars": 0, "images": 0})
    events.Reload()
    return events


def steps_of(folder, tag: str) -> list[int]:
    return [event.step for event in read_events(folder).Scalars(tag)]


def test_a_run_writes_terms_learning_rate_rate_and_validation(tmp_path):
    logged = []
    Trainer(LineTask(CONFIG), tmp_path, tensorboard=True).run(report=logged.append)
    events = read_events(tmp_path)
    assert set(events.Tags()["scalars"]) == {
        "loss/total",
        "loss/error",
        "learning_rate",
        "steps_per_second",
        "validation/ap50",
    }
    for tag, name in (("loss/total", "loss"), ("learning_rate", "learning_rate")):
        assert [(e.step, e.value) for e in events.Scalars(tag)] == [
            (p.step, pytest.approx(getattr(p, name))) for p in logged
        ]
    assert [(e.step, e.value) for e in events.Scalars("validation/ap50")] == [(12, 0.25), (24, 0.25), (25, 0.25)]
    # A step that validates begins a new measurement.
    assert [e.step for e in events.Scalars("steps_per_second")] == [11, 22]
    assert all(e.value > 0 for e in events.Scalars("steps_per_second"))
    assert events.Tags()["images"] == ["loss"] and [e.step for e in events.Images("loss")] == [12, 24, 25]


def test_a_killed_run_that_goes_on_has_every_step_once(tmp_path):
    def stop(progress):
        if progress.step == 15:
            raise OSError

    with pytest.raises(OSError):
        Trainer(LineTask(CONFIG), tmp_path, tensorboard=True).run(report=stop)
    assert steps_of(tmp_path, "loss/total") == list(range(1, 16))
    resumed = Trainer(LineTask(CONFIG), tmp_path, tensorboard=True)
    assert resumed.step == 12
    resumed.run()
    assert steps_of(tmp_path, "loss/total") == list(range(1, CONFIG.steps + 1))
    assert steps_of(tmp_path, "validation/ap50") == [12, 24, 25]


def test_a_run_without_the_option_writes_no_events(tmp_path):
    Trainer(LineTask(replace(CONFIG, steps=2, validate_every=0)), tmp_path).run()
    assert not (tmp_path / "tensorboard").exists()


def test_pictures_of_a_frame_of_validation_show_each_method(toy, tmp_path):
    tiny = TRAINING_PRESETS["costr-tiny"]
    assert isinstance(tiny, DetectorTrainConfig)
    config = replace(tiny, steps=2, batch=1, validate_every=2, validate_frames=2)
    Trainer(DetectorTask(config, toy(), 0, None, toy()), tmp_path, tensorboard=True).run()
    events = read_events(tmp_path)
    assert set(events.Tags()["images"]) == {"loss", "frame/intermediate", "frame/none"}
    (picture,) = events.Images("frame/intermediate")
    assert picture.step == 2 and picture.width == 1024 and picture.height > 300
    assert picture.encoded_image_string[:4] == b"\x89PNG"


def test_a_missing_extra_is_named_before_the_first_step(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    run = Trainer(LineTask(CONFIG), tmp_path, tensorboard=True)
    with pytest.raises(
        MissingExtraError, match=r"--tensorboard needs the 'train' extra: pip install 'manyeyes\[train\]'"
    ):
        run.run()
    assert run.step == 0
