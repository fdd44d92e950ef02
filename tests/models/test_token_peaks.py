# SPDX-License-Identifier: Apache-2.0
"""The range of tokens in the card of weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from manyeyes.agents.token_codec import make_token_format
from manyeyes.comms.token_format import MAX_TOKEN_VALUE
from manyeyes.datatypes import CheckpointError
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.token_peaks import measure_token_peaks


def saved(folder: Path, card: dict[str, Any]) -> Path:
    path = folder / "weights.safetensors"
    checkpoint.save(Detector(COSTR_TINY), path, card)
    return path


def test_peaks_are_the_largest_magnitudes_of_each_channel() -> None:
    tokens = [torch.tensor([[1.0, -4.0], [-3.0, 2.0]]), torch.zeros(0, 2), torch.tensor([[2.0, 0.0]])]
    assert measure_token_peaks(tokens, 2) == [3.0, 4.0]
    assert measure_token_peaks([torch.zeros(0, 2)], 2) is None


def test_peaks_bound_the_tokens_that_a_loaded_detector_accepts(tmp_path: Path) -> None:
    channels = Detector(COSTR_TINY).token_channels
    detector = checkpoint.load(saved(tmp_path, {"token_peaks": [3.0] * channels}))
    assert detector.token_peaks == (3.0,) * channels
    assert make_token_format(detector).max_values.tolist() == [12.0] * channels


def test_weights_without_peaks_have_the_default_range(tmp_path: Path) -> None:
    detector = checkpoint.load(saved(tmp_path, {"seed": 1}))
    assert detector.token_peaks is None
    assert set(make_token_format(detector).max_values.tolist()) == {MAX_TOKEN_VALUE}


@pytest.mark.parametrize("peaks", [[1.0], "all", [float("nan")] * 999, [-1.0] * 999])
def test_damaged_peaks_are_an_error_that_names_file_and_field(tmp_path: Path, peaks: Any) -> None:
    channels = Detector(COSTR_TINY).token_channels
    with pytest.raises(CheckpointError, match=r"weights.safetensors: token_peaks of its card needs"):
        checkpoint.load(saved(tmp_path, {"token_peaks": peaks[:channels] if len(peaks) == 999 else peaks}))


def test_the_shipped_weights_have_peaks() -> None:
    assert make_token_format(pretrained.load()).peaks is not None
    assert pretrained.load_map_model().token_peaks is not None
