# SPDX-License-Identifier: Apache-2.0
"""Validation during training: what is measured and logged, which weights are the result, and runs that are interrupted."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from manyeyes.datasets.base import iter_eval_frames
from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.detector.validation import select_frames
from manyeyes.training.presets import TRAINING_PRESETS
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training

TINY = TRAINING_PRESETS["costr-tiny"]
assert isinstance(TINY, DetectorTrainConfig)
CONFIG = replace(TINY, steps=5, batch=1, save_every=3, validate_every=2, validate_frames=2)


class RatedTask(DetectorTask):
    """Measures are given, by number of step."""

    def validate(self, weights):
        return {"ap50_intermediate": {2: 0.3, 4: 0.5, 5: 0.5}[checkpoint.read_card(weights)["step"]], "ap50_none": 0.1}


def lines(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_the_best_weights_are_the_result_also_of_an_interrupted_run(toy, tmp_path):
    def make(name):
        return Trainer(RatedTask(CONFIG, toy(), 0, None, toy()), tmp_path / name)

    def stop(progress):
        if progress.step == 4:
            raise OSError

    whole, broken = make("whole"), make("broken")
    weights = whole.run()
    with pytest.raises(OSError):
        broken.run(report=stop)
    again = make("broken")
    assert again.step == 2 or again.step == 3
    states = [checkpoint.read_state(path) for path in (weights, again.run(), whole.best_path)]
    assert all(torch.equal(value, state[name]) for state in states[1:] for name, value in states[0].items())
    assert any(not torch.equal(v.half(), states[0][n]) for n, v in whole.average.state_dict().items() if n in states[0])
    card = checkpoint.read_card(weights)
    assert card["best_validation"] == {"step": 4, "ap50_intermediate": 0.5, "ap50_none": 0.1}
    assert lines(tmp_path / "whole") == lines(tmp_path / "broken")
    assert [line["step"] for line in lines(tmp_path / "whole") if "validation" in line] == [2, 4, 5]
    assert not (tmp_path / "whole" / "candidate.safetensors").exists()


@pytest.mark.slow
def test_averaged_weights_are_evaluated_on_frames_of_validation(toy, tmp_path):
    task = DetectorTask(replace(CONFIG, steps=1, validate_every=1), toy(), 0, None, toy())
    run = Trainer(task, tmp_path)
    threads = torch.get_num_threads()
    run.run()
    (line,) = lines(tmp_path)
    assert list(line["validation"]) == ["ap50_intermediate", "ap50_none"]
    assert all(0 <= value <= 1 for value in line["validation"].values())
    assert torch.get_num_threads() == threads


def test_frames_are_few_and_spread_over_scenarios(toy):
    recording = toy(frames=10, scenarios=tuple(f"toy_{k}" for k in range(8)))
    few = select_frames(recording, 2)
    assert few.scenarios == ("toy_2", "toy_6") and len(list(iter_eval_frames(few))) == 2
    assert len(list(iter_eval_frames(select_frames(recording, 16)))) == 16
    assert len(list(iter_eval_frames(select_frames(toy(), 100)))) == 4
    long = select_frames(toy(frames=200, scenarios=("toy_0",)), 3)
    assert list(long.eval_indices("toy_0")) == [0, 5, 10]


def test_validation_needs_a_recording(toy):
    with pytest.raises(ConfigError, match="validate_every needs a recording of validation"):
        DetectorTask(CONFIG, toy(), 0)
