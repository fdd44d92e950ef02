# SPDX-License-Identifier: Apache-2.0
"""Training of the learned matcher: labels of generated scenes, its losses, and the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.cli import main as cli
from manyeyes.models import checkpoint
from manyeyes.models.pose import candidate_verifier
from manyeyes.models.pose.candidate_verifier import NUM_FEATURES, CandidateVerifierConfig
from manyeyes.simulator.fleet.landmark_errors import BoxNoise
from manyeyes.simulator.fleet.landmarks import LandmarkSpec
from manyeyes.training.pose import candidate_scenes
from manyeyes.training.pose.candidate_scenes import LabelledCandidates, build_scenes, make_labelled_candidates
from manyeyes.training.pose.candidate_verifier import (
    CandidateVerifierTask,
    CandidateVerifierTrainConfig,
    choice_loss,
)
from manyeyes.training.trainer import Trainer


def make_separable(count: int) -> LabelledCandidates:
    """Scenes in which the first feature marks the right candidate."""
    rng = np.random.default_rng(2)
    features = rng.standard_normal((count, 3, NUM_FEATURES)).astype(np.float32)
    is_right = features[..., 0] == features[..., 0].max(1, keepdims=True)
    features[..., 0] += 3 * is_right
    return LabelledCandidates(features, np.ones((count, 3), bool), is_right, np.zeros((count, 3), bool))


def test_scenes_are_functions_of_their_seed_and_an_interrupted_build_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidate_scenes, "SCENES_PER_FILE", 3)
    parts = list(build_scenes(tmp_path / "one", 7, 6))
    assert [len(part.exists) for part in parts] == [3, 3]
    other = LabelledCandidates.cat(list(build_scenes(tmp_path / "two", 8, 3)))
    assert (other.features != parts[0].features).any()
    next(build_scenes(tmp_path / "three", 7, 6))
    again = list(build_scenes(tmp_path / "three", 7, 6))
    for part, wanted in zip(again, parts, strict=True):
        np.testing.assert_array_equal(part.features, wanted.features)
        np.testing.assert_array_equal(part.is_right, wanted.is_right)


def test_with_many_common_objects_the_best_candidate_is_right() -> None:
    scene = make_labelled_candidates(LandmarkSpec(10, 4, 4, BoxNoise(0.1, 0.02, 0.0)), 2, 0)
    assert scene.is_right[0, 0] and not scene.is_right[0, 1:].any() and not scene.is_unclear[0, 0]
    assert scene.features.shape == (1, 3, NUM_FEATURES)


def test_at_two_places_no_candidate_is_right() -> None:
    scene = make_labelled_candidates(LandmarkSpec(0, 12, 12, disjoint=True), 2, 0)
    assert scene.exists.any() and not scene.is_right.any()


def test_the_choice_ignores_unclear_candidates_and_is_small_where_it_is_right() -> None:
    odds = torch.tensor([[9.0, -9.0, 30.0], [-9.0, -9.0, -9.0]])
    right = torch.tensor([[True, False, False], [False, False, False]])
    unclear = torch.tensor([[False, False, True], [False, False, False]])
    none = torch.zeros_like(unclear)
    assert choice_loss(odds, right, unclear) < 1e-3
    assert choice_loss(odds, right, none) > 10
    assert choice_loss(-odds, right, unclear) > 8


def test_every_scene_is_drawn_once_before_any_is_drawn_again() -> None:
    task = CandidateVerifierTask(CandidateVerifierTrainConfig(steps=1), make_separable(20), 4)
    rounds = [[task.draw(n) for n in range(first, first + 20)] for first in (0, 20)]
    assert sorted(rounds[0]) == sorted(rounds[1]) == list(range(20)) and rounds[0] != rounds[1]


@pytest.mark.training
def test_training_finds_the_feature_that_marks_the_right_candidate(tmp_path: Path) -> None:
    config = CandidateVerifierTrainConfig(
        steps=150, batch=64, learning_rate=1e-2, warmup_steps=2, net=CandidateVerifierConfig(hidden=16, dropout=0.0)
    )
    trainer = Trainer(CandidateVerifierTask(config, make_separable(500), 3), tmp_path)
    losses = [trainer.advance().loss for _ in range(150)]
    assert np.mean(losses[-10:]) < 0.4 * np.mean(losses[:5])


@pytest.mark.training
def test_the_command_trains_without_recordings_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(candidate_scenes, "SCENES_PER_FILE", 10)
    Path("few.toml").write_text("num_scenes = 20\n")
    words = ["train", "--preset", "pose-verifier-small", "--config", "few.toml", "--batch", "8", "--out", "run"]
    words += ["--seed", "9"]
    assert cli.main([*words, "--steps", "2"]) == 0
    weights = Path("run/weights.safetensors")
    card = checkpoint.read_card(weights, candidate_verifier.FORMAT)
    assert card["seed"] == 9 and candidate_verifier.load(weights).config == CandidateVerifierConfig()
    first = checkpoint.read_state(weights, candidate_verifier.FORMAT)
    assert cli.main([*words, "--steps", "2"]) == 0
    again = checkpoint.read_state(weights, candidate_verifier.FORMAT)
    assert all(torch.equal(again[name], first[name]) for name in first)
    assert cli.main([*words, "--steps", "3"]) == 1
    assert cli.main([*words, "--data", "somewhere"]) == 1
    assert "generated scenes; leave out --data" in capsys.readouterr().err
