# SPDX-License-Identifier: Apache-2.0
"""Training of the learned matcher: labels of generated scenes, its losses, and the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.cli import main as cli
from manyeyes.models import checkpoint
from manyeyes.models.pose import candidate_matcher
from manyeyes.models.pose.candidate_matcher import CandidateMatcherConfig, CandidateOdds
from manyeyes.simulator.fleet.landmark_errors import BoxNoise
from manyeyes.simulator.fleet.landmarks import LandmarkSpec
from manyeyes.training.pose.candidate_matcher import (
    CandidateMatcherTask,
    CandidateMatcherTrainConfig,
    choice_loss,
    pair_loss,
)
from manyeyes.training.pose.candidate_scenes import draw_labelled_candidates, make_labelled_candidates
from manyeyes.training.trainer import Trainer

SMALL = CandidateMatcherConfig(width=16, relation_width=8, context_layers=1, pair_layers=1, heads=2)


def test_a_scene_is_a_function_of_seed_and_number() -> None:
    first, again, other = (draw_labelled_candidates(7, n) for n in (5, 5, 6))
    np.testing.assert_array_equal(first.candidates.a, again.candidates.a)
    np.testing.assert_array_equal(first.is_right, again.is_right)
    assert first.candidates.a.shape != other.candidates.a.shape or (first.candidates.a != other.candidates.a).any()


def test_with_many_common_objects_the_best_candidate_is_right_and_its_pairs_are_matches() -> None:
    scene = make_labelled_candidates(LandmarkSpec(10, 4, 4, BoxNoise(0.1, 0.02, 0.0)), 2, 0)
    assert scene.is_right[0] and not scene.is_right[1:].any() and not scene.is_unclear[0]
    assert scene.is_match[0].sum() >= 9
    is_pair = scene.candidates.pairs[..., 0] >= 0
    assert not scene.is_match[~is_pair].any()


def test_at_two_places_no_candidate_is_right_and_no_pair_matches() -> None:
    scene = make_labelled_candidates(LandmarkSpec(0, 12, 12, disjoint=True), 2, 0)
    assert not scene.is_right.any() and not scene.is_match.any()


def test_the_choice_ignores_unclear_candidates_and_is_small_where_it_is_right() -> None:
    odds = torch.tensor([[9.0, -9.0, 30.0], [-9.0, -9.0, -9.0]])
    right = torch.tensor([[True, False, False], [False, False, False]])
    unclear = torch.tensor([[False, False, True], [False, False, False]])
    none = torch.zeros_like(unclear)
    assert choice_loss(odds, right, unclear) < 1e-3
    assert choice_loss(odds, right, none) > 10
    assert choice_loss(-odds, right, unclear) > 8


def test_the_loss_of_pairs_leaves_out_padding() -> None:
    pair = torch.tensor([[[8.0, -8.0, -1e4]]])
    is_match, is_pair = torch.tensor([[[True, False, False]]]), torch.tensor([[[True, True, False]]])
    odds = CandidateOdds(torch.zeros(1, 1), pair)
    assert pair_loss(odds, is_match, is_pair) < 1e-3
    assert pair_loss(odds, ~is_match & is_pair, is_pair) == pytest.approx(8.0, abs=0.01)


@pytest.mark.training
def test_training_lowers_the_loss_on_its_own_scenes(tmp_path: Path) -> None:
    config = CandidateMatcherTrainConfig(steps=40, batch=8, learning_rate=5e-3, warmup_steps=2, net=SMALL)
    task = CandidateMatcherTask(config, 3)
    scenes = [task.draw(n) for n in range(8)]
    task.draw = lambda number: scenes[number % 8]
    trainer = Trainer(task, tmp_path)
    losses = [trainer.advance().loss for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])


@pytest.mark.training
def test_the_command_trains_without_recordings_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["train", "--preset", "pose-matcher-small", "--batch", "4", "--out", "run", "--seed", "9"]
    assert cli.main([*words, "--steps", "2"]) == 0
    weights = Path("run/weights.safetensors")
    card = checkpoint.read_card(weights, candidate_matcher.FORMAT)
    assert card["seed"] == 9 and candidate_matcher.load(weights).config == CandidateMatcherConfig()
    content = weights.read_bytes()
    assert cli.main([*words, "--steps", "2"]) == 0 and weights.read_bytes() == content
    assert cli.main([*words, "--steps", "3"]) == 1 and "Another" not in capsys.readouterr().out
    assert cli.main([*words, "--data", "somewhere"]) == 1
    assert "generated scenes; leave out --data" in capsys.readouterr().err
