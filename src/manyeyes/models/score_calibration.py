# SPDX-License-Identifier: Apache-2.0
"""Monotone maps from scores of boxes to the fraction of boxes that are correct, kept in the card of a detector's weights.

One map for each form of result (:data:`ScoreForm`): boxes of one agent's cloud, merged boxes, boxes of merged clouds, boxes of
fused tokens. A map is applied to the final boxes of an agent, not to what is sent. It is strictly increasing, and the identity up
to MIN_CALIBRATED_SCORE, the score threshold of the evaluation protocol: neither the ranking nor the set of evaluated boxes
changes but for ties of rounding, so that AP is the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, CheckpointError, ConfigError

ScoreForm = Literal["own", "late", "early", "fused"]
SCORE_FORMS: tuple[ScoreForm, ...] = get_args(ScoreForm)
CARD_KEY = "score_calibration"
MIN_CALIBRATED_SCORE = 0.05
"""Score up to which a map is the identity."""
DEFAULT_DRAWING_SCORE = 0.4
"""Minimum score of a drawn box, of weights without calibration."""
_MAX_KNOTS = 64


@dataclass(frozen=True)
class ScoreMap:
    """A piecewise linear map of scores.

    Attributes:
        raw: scores of the knots, from 0 to 1, strictly increasing.
        calibrated: their values, from 0 to 1, strictly increasing; equal to raw up to MIN_CALIBRATED_SCORE.
        min_drawn: calibrated score from which a box is drawn by default.

    Raises:
        ConfigError: a value is out of order or out of range.
    """

    raw: tuple[float, ...]
    calibrated: tuple[float, ...]
    min_drawn: float

    def __post_init__(self) -> None:
        in_order = all(a < b for values in (self.raw, self.calibrated) for a, b in pairwise(values))
        ends = {values[:1] + values[-1:] for values in (self.raw, self.calibrated)}
        is_identity = all(a == b for a, b in zip(self.raw, self.calibrated) if a <= MIN_CALIBRATED_SCORE)
        fits = len(self.raw) == len(self.calibrated) <= _MAX_KNOTS and ends == {(0.0, 1.0)}
        if not (in_order and fits and is_identity and 0 <= self.min_drawn <= 1):
            raise ConfigError(
                f"ScoreMap needs up to {_MAX_KNOTS} knots that rise strictly from 0 to 1, equal up to {MIN_CALIBRATED_SCORE}, and "
                f"min_drawn in [0, 1]; got {self}."
            )

    def apply(self, score: Tensor) -> Tensor:
        """Return calibrated scores (N,) in [0, 1] of raw ones, in their dtype."""
        x, y = (
            torch.tensor(values, dtype=torch.float64, device=score.device) for values in (self.raw, self.calibrated)
        )
        s = score.double().clamp(0.0, 1.0)
        row = (torch.searchsorted(x, s, right=True) - 1).clamp(0, len(x) - 2)
        mapped = y[row] + (s - x[row]) * ((y[row + 1] - y[row]) / (x[row + 1] - x[row]))
        return torch.where(s <= MIN_CALIBRATED_SCORE, s, mapped).to(score.dtype)


@dataclass(frozen=True)
class ScoreCalibration:
    """The maps of some or all forms; a form without one keeps its scores."""

    own: ScoreMap | None = None
    late: ScoreMap | None = None
    early: ScoreMap | None = None
    fused: ScoreMap | None = None

    def get(self, form: ScoreForm) -> ScoreMap | None:
        """Return the map of a form; None where it is not calibrated."""
        return getattr(self, form)

    def to_card(self) -> dict[str, Any]:
        """Return the value of CARD_KEY in a card."""
        maps = {form: self.get(form) for form in SCORE_FORMS}
        return {
            form: {"raw": list(m.raw), "calibrated": list(m.calibrated), "min_drawn": m.min_drawn}
            for form, m in maps.items()
            if m is not None
        }


def read_score_calibration(card: dict[str, Any], path: Path) -> ScoreCalibration | None:
    """Return the maps of a card of weights; None where it has none.

    Raises:
        CheckpointError: they are no maps.
    """
    stored = card.get(CARD_KEY)
    if stored is None:
        return None
    try:
        if not isinstance(stored, dict) or not set(stored) <= set(SCORE_FORMS):
            raise ConfigError(f"it needs forms among {', '.join(SCORE_FORMS)}.")
        return ScoreCalibration(**{form: _read_map(value) for form, value in stored.items()})
    except ConfigError as error:
        raise CheckpointError(
            f"{path}: {CARD_KEY} of its card: {error} Copy the file again, or calibrate again."
        ) from error


def _read_map(stored: Any) -> ScoreMap:
    if not isinstance(stored, dict) or set(stored) != {"raw", "calibrated", "min_drawn"}:
        raise ConfigError("each map needs raw, calibrated and min_drawn.")
    columns = [stored["raw"], stored["calibrated"], [stored["min_drawn"]]]
    for values in columns:
        if not isinstance(values, list) or not all(isinstance(v, int | float) and math.isfinite(v) for v in values):
            raise ConfigError("its values need to be finite numbers.")
    raw, calibrated, (min_drawn,) = (tuple(map(float, values)) for values in columns)
    return ScoreMap(raw, calibrated, min_drawn)


def calibrate_boxes(detector: object, form: ScoreForm, boxes: Boxes) -> Boxes:
    """Return the boxes with calibrated scores, in their order; unchanged where a detector has no map of the form."""
    score_map = _find_map(detector, form)
    return boxes if score_map is None else replace(boxes, score=score_map.apply(boxes.score))


def default_drawing_score(detector: object, form: ScoreForm) -> float:
    """Return the minimum score of boxes that are drawn by default."""
    score_map = _find_map(detector, form)
    return DEFAULT_DRAWING_SCORE if score_map is None else score_map.min_drawn


def has_score_map(detector: object, form: ScoreForm) -> bool:
    """Return whether the scores of a form are calibrated."""
    return _find_map(detector, form) is not None


def _find_map(detector: object, form: ScoreForm) -> ScoreMap | None:
    calibration = getattr(detector, "score_calibration", None)
    return calibration.get(form) if isinstance(calibration, ScoreCalibration) else None
