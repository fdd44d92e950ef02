# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning: steps by frames; the codebook is fitted again or kept; what ships has the configuration it began with."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_SMALL, COSTR_TINY
from manyeyes.training.detector.finetune import MAX_STEPS, MIN_STEPS, choose_steps, make_finetune_plan
from manyeyes.training.detector.plan import PlanRun, TrainPlan

pytestmark = pytest.mark.training

CODED = replace(COSTR_TINY, codebook=CodebookConfig(2, 16))


def test_more_frames_take_more_steps_within_bounds():
    counts = [choose_steps(n) for n in (0, 1, 20, 80, 500, 10**6)]
    assert counts == sorted(counts) and counts[0] == MIN_STEPS and counts[-1] == MAX_STEPS
    assert (choose_steps(20), choose_steps(80), choose_steps(500)) == (120, 240, 600)


def test_the_plan_keeps_the_released_configuration():
    detector = replace(COSTR_SMALL, codebook=CodebookConfig(2))
    plan = make_finetune_plan(detector, 10)
    assert plan.released == detector and plan.codebook == CodebookConfig(2) and plan.steps == 10
    assert make_finetune_plan(detector, 10, codebook="keep").codebook == "start"
    assert make_finetune_plan(COSTR_SMALL, 10, codebook="keep").codebook == CodebookConfig()
    ((_, config),) = plan.stages
    assert config.augment.sensors is None and config.detector.codebook is None


def test_classes_are_added_to_those_of_the_weights():
    plan = make_finetune_plan(COSTR_SMALL, 10, classes=("vehicle", "pedestrian"))
    ((_, config),) = plan.stages
    assert plan.released.classes == config.detector.classes == ("vehicle", "pedestrian")
    with pytest.raises(ConfigError, match="detect vehicle, too; name it"):
        make_finetune_plan(COSTR_SMALL, 10, classes=("cyclist",))
    with pytest.raises(ConfigError, match="each once"):
        make_finetune_plan(COSTR_SMALL, 10, classes=("vehicle", "vehicle"))


@pytest.fixture
def start(tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(2)
        detector = Detector(CODED)
    detector.codebook.centres.normal_(generator=torch.Generator().manual_seed(0))
    checkpoint.save(detector, tmp_path / "start.safetensors", {}, half=True)
    return tmp_path / "start.safetensors"


@pytest.mark.slow
@pytest.mark.parametrize("codebook", ["refit", "keep"])
def test_the_codebook_is_fitted_again_or_kept(toy, tmp_path, start, codebook):
    recording = toy(agents_n=2, points_per_car=20, ground_points=60)
    plan = make_finetune_plan(CODED, 2, codebook=codebook)
    weights = PlanRun(plan, recording, 0, tmp_path / codebook, start, recording).run()
    before, after = checkpoint.load(start), checkpoint.load(weights)
    assert after.config == before.config and after.score_calibration is not None
    is_kept = torch.equal(before.codebook.centres, after.codebook.centres)
    assert is_kept == (codebook == "keep")
    assert not torch.equal(before.head.out.weight, after.head.out.weight)


def test_a_kept_codebook_needs_weights_that_have_one(toy, tmp_path):
    with torch.random.fork_rng():
        checkpoint.save(Detector(COSTR_TINY), tmp_path / "plain.safetensors", {})
    run = PlanRun(
        TrainPlan((("one", make_finetune_plan(COSTR_TINY, 1).stages[0][1]),), codebook="start"), toy(), 0, tmp_path
    )
    for start in (None, tmp_path / "plain.safetensors"):
        with pytest.raises(ConfigError, match="no codebook that could be kept"):
            replace(run, start=start)._load_start()
