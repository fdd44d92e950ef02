# SPDX-License-Identifier: Apache-2.0
"""Maps of scores: the order and the evaluated set of boxes stay; damaged cards are refused; without maps nothing changes."""

import dataclasses
from pathlib import Path

import pytest
import torch

from manyeyes.datatypes import Boxes, CheckpointError, ConfigError
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.score_calibration import (
    CARD_KEY,
    DEFAULT_DRAWING_SCORE,
    ScoreCalibration,
    ScoreMap,
    calibrate_boxes,
    default_drawing_score,
    read_score_calibration,
)

MAP = ScoreMap((0.0, 0.05, 0.4, 0.8, 1.0), (0.0, 0.05, 0.1, 0.9, 1.0), 0.3)


def boxes(score: torch.Tensor) -> Boxes:
    zero = torch.zeros(len(score))
    return Boxes.of(torch.zeros(len(score), 3), torch.ones(len(score), 3), zero, score)


def test_knots_and_midpoints_by_hand():
    raw = torch.tensor([0.0, 0.02, 0.05, 0.4, 0.6, 0.8, 0.9, 1.0])
    assert torch.allclose(MAP.apply(raw), torch.tensor([0.0, 0.02, 0.05, 0.1, 0.5, 0.9, 0.95, 1.0]))
    assert MAP.apply(raw).dtype == torch.float32 and MAP.apply(raw.double()).dtype == torch.float64


def test_the_order_and_the_set_above_the_threshold_of_the_protocol_stay():
    score = torch.rand(5000, generator=torch.Generator().manual_seed(0), dtype=torch.float64).sort().values
    mapped = MAP.apply(score)
    assert (mapped.diff() > 0).all() and torch.equal(mapped > 0.05, score > 0.05)
    assert torch.equal(MAP.apply(torch.zeros(0)), torch.zeros(0))


@pytest.mark.parametrize(
    ("raw", "calibrated", "min_drawn"),
    [
        ((0.0, 1.0), (0.0, 0.9), 0.5),
        ((0.0, 0.5, 0.5, 1.0), (0.0, 0.5, 0.6, 1.0), 0.5),
        ((0.0, 0.5, 0.6, 1.0), (0.0, 0.5, 0.5, 1.0), 0.5),
        ((0.0, 0.04, 1.0), (0.0, 0.03, 1.0), 0.5),
        ((0.0, 1.0), (0.0, 1.0), 1.5),
        ((0.0, 0.5, 1.0), (0.0, 1.0), 0.5),
        ((), (), 0.5),
    ],
)
def test_knots_out_of_order_or_range_are_refused(raw, calibrated, min_drawn):
    with pytest.raises(ConfigError, match="ScoreMap needs"):
        ScoreMap(raw, calibrated, min_drawn)


def test_only_calibrated_forms_of_a_detector_change():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        detector = Detector(COSTR_TINY)
    given = boxes(torch.tensor([0.9, 0.6]))
    assert calibrate_boxes(detector, "fused", given) is given and calibrate_boxes(object(), "own", given) is given
    assert default_drawing_score(detector, "fused") == DEFAULT_DRAWING_SCORE
    detector.score_calibration = ScoreCalibration(fused=MAP)
    assert torch.allclose(calibrate_boxes(detector, "fused", given).score, torch.tensor([0.95, 0.5]))
    assert calibrate_boxes(detector, "own", given) is given
    assert (default_drawing_score(detector, "fused"), default_drawing_score(detector, "own")) == (0.3, 0.4)


def test_weights_keep_their_maps_and_their_fingerprint(tmp_path: Path):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        detector = Detector(COSTR_TINY).eval()
    for name, card in (("plain", {}), ("calibrated", {CARD_KEY: ScoreCalibration(own=MAP).to_card()})):
        checkpoint.save(detector, tmp_path / f"{name}.safetensors", card)
    plain, calibrated = (checkpoint.load(tmp_path / f"{name}.safetensors") for name in ("plain", "calibrated"))
    assert plain.score_calibration is None and calibrated.score_calibration == ScoreCalibration(own=MAP)
    assert plain.fingerprint == calibrated.fingerprint
    folded = pretrained.load(tmp_path / "calibrated.safetensors")
    assert default_drawing_score(folded, "own") == 0.3


@pytest.mark.parametrize(
    "stored",
    [
        [],
        {"other": {}},
        {"own": {"raw": [0, 1]}},
        {"own": {"raw": [0, "x"], "calibrated": [0, 1], "min_drawn": 0.5}},
        {"own": {"raw": [0, 1], "calibrated": [0, float("nan")], "min_drawn": 0.5}},
        {"own": {"raw": [0, 1], "calibrated": [1, 0], "min_drawn": 0.5}},
    ],
)
def test_a_damaged_card_is_refused(stored):
    with pytest.raises(CheckpointError, match=r"w\.safetensors: score_calibration of its card"):
        read_score_calibration({CARD_KEY: stored}, Path("w.safetensors"))


def test_maps_return_from_a_card():
    maps = ScoreCalibration(own=MAP, fused=dataclasses.replace(MAP, min_drawn=0.5))
    assert read_score_calibration({CARD_KEY: maps.to_card()}, Path("w")) == maps
