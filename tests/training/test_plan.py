# SPDX-License-Identifier: Apache-2.0
"""Plans of stages: each begins from the one before; a killed plan ends with the same weights; other runs are refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manyeyes.datatypes import CheckpointError, ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.plan import PlanRun, TrainPlan
from manyeyes.training.detector.samples import AugmentConfig
from manyeyes.training.detector.task import DetectorTrainConfig
from manyeyes.training.monitor import Progress
from manyeyes.training.presets import TRAINING_PLANS, TRAINING_PRESETS

pytestmark = pytest.mark.training

STAGE = DetectorTrainConfig(
    COSTR_TINY, steps=3, batch=1, warmup_steps=1, save_every=1, augment=AugmentConfig(max_agents=2)
)
LATER = replace(STAGE, steps=2, learning_rate=1e-3)
RELEASED = replace(COSTR_TINY, prune_threshold=0.07)
PLAN = TrainPlan((("one", STAGE), ("two", LATER)), released=RELEASED, codebook=CodebookConfig(2, 16), codebook_frames=2)


def road(toy):
    return toy(agents_n=2, points_per_car=20, ground_points=60, frames=3)


class KilledError(Exception):
    """A process that ends."""


def kill_at(stage: str, step: int):
    def report(name: str, progress: Progress) -> None:
        if (name, progress.step) == (stage, step):
            raise KilledError

    return report


def equal_weights(first: Path, second: Path) -> bool:
    one, other = checkpoint.read_state(first), checkpoint.read_state(second)
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    from tests.training.conftest import ToyRecording

    folder = tmp_path_factory.mktemp("plan")
    PlanRun(PLAN, road(ToyRecording), 5, folder).run({"command": "x"})
    return folder


@pytest.mark.slow
def test_the_final_weights_hold_the_stages_the_codebook_and_their_seeds(finished):
    weights = finished / "weights.safetensors"
    detector, card = checkpoint.load(weights), checkpoint.read_card(weights)
    assert detector.config == replace(RELEASED, codebook=CodebookConfig(2, 16)) and detector.codebook is not None
    assert [(stage["name"], stage["seed"], stage["steps"]) for stage in card["stages"]] == [
        ("one", 5, 3),
        ("two", 6, 2),
    ]
    assert (card["seed"], card["steps"], card["command"], card["codebook"]["seed"]) == (5, 5, "x", 7)
    assert card["codebook"]["tokens"] > 0 and len(detector.token_peaks or ()) == detector.token_channels
    first, second = (checkpoint.load(finished / name / "weights.safetensors") for name in ("one", "two"))
    assert card["stages"][0]["started_from"] == "" and card["stages"][1]["started_from"] == first.fingerprint.hex()
    for name, value in second.state_dict().items():
        assert torch.equal(detector.state_dict()[name], value), name


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "step"), [("one", 2), ("two", 1)])
def test_a_killed_plan_ends_with_the_same_weights(finished, toy, tmp_path, stage, step):
    run = PlanRun(PLAN, road(toy), 5, tmp_path)
    with pytest.raises(KilledError):
        run.run(report=kill_at(stage, step))
    trained: list[str] = []
    weights = run.run(report=lambda name, progress: trained.append(name))
    assert trained == (["one"] * 2 + ["two"] * 2 if stage == "one" else ["two"] * 2)
    assert equal_weights(weights, finished / "weights.safetensors")


@pytest.mark.slow
def test_finished_stages_need_only_their_weights(finished, toy, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        shutil.copy(finished / name / "weights.safetensors", tmp_path / name)
    weights = PlanRun(PLAN, road(toy), 5, tmp_path).run(report=lambda name, progress: pytest.fail(name))
    assert equal_weights(weights, finished / "weights.safetensors")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "seed", "reason"),
    [
        (PLAN.change_stages(learning_rate=0.5), 5, "learning_rate is .* there and 0.5 here"),
        (PLAN, 6, "the seed is 5 there and 6 here"),
    ],
)
def test_a_stage_of_another_run_is_refused(finished, toy, changed, seed, reason):
    with pytest.raises(
        CheckpointError, match=rf"one/weights.safetensors: belongs to a stage of another run: {reason}. Give"
    ):
        PlanRun(changed, road(toy), seed, finished).run()


@pytest.mark.slow
def test_a_plan_begins_from_given_weights_and_refuses_those_of_another_run(toy, tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(9)
        for name in ("a", "b"):
            checkpoint.save(Detector(COSTR_TINY), tmp_path / f"{name}.safetensors", {})
    plan = TrainPlan((("only", replace(STAGE, steps=1, learning_rate=0.0)),), codebook=None)
    weights = PlanRun(plan, road(toy), 0, tmp_path / "run", tmp_path / "a.safetensors").run()
    given, trained = checkpoint.read_state(tmp_path / "a.safetensors"), checkpoint.read_state(weights)
    assert torch.allclose(trained["head.out.weight"].float(), given["head.out.weight"], atol=1e-3)
    assert checkpoint.load(weights).codebook is None
    with pytest.raises(CheckpointError, match=r"initial weights are \w+ there and \w+ here"):
        PlanRun(plan, road(toy), 0, tmp_path / "run", tmp_path / "b.safetensors").run()


@pytest.mark.slow
def test_scores_are_calibrated_on_the_recording_of_validation(finished, toy, tmp_path):
    for name in ("one", "two", "codebook"):
        shutil.copytree(finished / name, tmp_path / name)
    weights = PlanRun(PLAN, road(toy), 5, tmp_path, validation=road(toy)).run()
    detector, plain = checkpoint.load(weights), checkpoint.load(finished / "weights.safetensors")
    assert detector.score_calibration is not None and plain.score_calibration is None
    assert detector.fingerprint == plain.fingerprint and checkpoint.read_card(weights)["steps"] == 5


@pytest.mark.parametrize("name", [name for name in TRAINING_PLANS if not name.startswith("costr-tiny")])
def test_the_last_stages_of_plans_that_ship_mix_sensors(name):
    assert all(config.augment.sensors is not None for _, config in TRAINING_PLANS[name].stages[-2:])


def test_every_stage_has_a_name_of_its_own():
    for stages in ((), (("one", STAGE), ("one", LATER)), (("codebook", STAGE),)):
        with pytest.raises(ConfigError, match=r"TrainPlan\.stages needs names"):
            TrainPlan(stages)


@pytest.mark.parametrize("name", TRAINING_PLANS)
def test_plans_that_ship_build_models_that_fit_each_other(name):
    """Every stage can begin from the one before, and the released configuration has the tensors of the last stage."""
    plan = TRAINING_PLANS[name]
    assert name not in TRAINING_PRESETS and plan.steps > 0
    shapes = [{n: v.shape for n, v in Detector(config.detector).state_dict().items()} for _, config in plan.stages]
    released = Detector(plan.released or plan.stages[-1][1].detector)
    assert all(shape == shapes[0] for shape in (*shapes, {n: v.shape for n, v in released.state_dict().items()}))
    for _, config in plan.stages:
        stored = checkpoint.config_from_json(DetectorTrainConfig, checkpoint.config_to_json(config))
        assert stored == config
