# SPDX-License-Identifier: Apache-2.0
"""Presets of the published data sets: ranges of their protocols, and a run of each that is stopped and goes on."""

from dataclasses import replace

import pytest
import torch

from manyeyes.evaluation.detection.average_precision import PROTOCOLS
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

PUBLISHED = ("costr-opv2v", "costr-v2xset", "costr-dair", "costr-v2x-real")
RANGES_M = {"costr-opv2v": 140.8, "costr-v2xset": 140.8, "costr-dair": 102.4, "costr-v2x-real": 140.8}


def config_of(name: str) -> DetectorTrainConfig:
    return DETECTOR_TRAINING_PRESETS[name]


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_preset_has_the_range_and_the_schedule_of_its_paper(name):
    config = config_of(name)
    grid = config.detector.output_range or config.detector.grid
    assert (grid.x_min, grid.x_max) == (-RANGES_M[name], RANGES_M[name])
    assert (config.steps, config.epochs, config.learning_rate) == (0, 90.0, 2e-4)
    assert config.detector.encoder.head_stride == 8


def test_people_are_detected_in_v2x_real_alone():
    named = {name: config_of(name).detector.classes for name in PUBLISHED}
    assert named.pop("costr-v2x-real") == ("vehicle", "pedestrian")
    assert set(named.values()) == {("vehicle",)}


@pytest.mark.parametrize("protocol", ["costr-dair", "costr-dair-centred", "heal-dair", "coalign", "sparsealign-dair"])
def test_weights_of_dair_cover_the_range_of_every_protocol(protocol):
    grid = config_of("costr-dair").detector.output_range
    low, high = PROTOCOLS[protocol].gt_range[:2], PROTOCOLS[protocol].gt_range[3:5]
    assert grid is not None
    assert grid.x_min <= low[0] and grid.y_min <= low[1] and high[0] <= grid.x_max and high[1] <= grid.y_max


@pytest.mark.training
@pytest.mark.parametrize("name", PUBLISHED[1:])
def test_a_run_takes_a_step_and_goes_on(toy, tmp_path, name):
    def make_trainer() -> Trainer:
        config = replace(config_of(name), steps=2, batch=1)
        return Trainer(DetectorTask(config, toy(agents_n=2, points_per_car=30, ground_points=60), 0), tmp_path)

    begun = make_trainer()
    first = begun.advance()
    begun.save()
    expected = begun.advance()
    resumed = make_trainer()
    assert resumed.step == 1
    found = resumed.advance()
    assert (first.step, found.step) == (1, 2) and found.loss == expected.loss
    pairs = zip(resumed.model.state_dict().values(), begun.model.state_dict().values(), strict=True)
    assert all(torch.equal(mine, theirs) for mine, theirs in pairs)
