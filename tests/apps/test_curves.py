# SPDX-License-Identifier: Apache-2.0
"""Curves as a picture: what is drawn depends on what is said, and nothing is left behind."""

import math

import numpy as np
import pytest
from PIL import Image

from manyeyes.apps.viewer.curves import Curve, Panel, save_curves
from manyeyes.evaluation.bootstrap import Interval


def at(*values: float, half: float = 0.01) -> tuple[Interval, ...]:
    return tuple(Interval(v, v - half, v + half, 0.95, 5) for v in values)


def drawn(panels: list[Panel], path) -> np.ndarray:
    save_curves(panels, path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_a_wider_interval_and_another_level_are_other_pictures(tmp_path) -> None:
    def panel(half: float, level: float) -> list[Panel]:
        curves = (Curve("late", at(0.8, 0.7, half=half), (0.0, 0.4)), Curve("alone", at(level)))
        return [Panel("Delay", "seconds", "AP@0.5", curves)]

    first, wider, other = (drawn(panel(*p), tmp_path / "x.png") for p in ((0.01, 0.75), (0.05, 0.75), (0.01, 0.72)))
    assert first.shape == wider.shape == other.shape
    assert np.abs(first - wider).any() and np.abs(first - other).any()


@pytest.mark.parametrize("values", [(0.5, 0.9), (math.nan, 0.9)])
def test_bytes_have_their_logarithm_on_top_and_ticks_their_names(tmp_path, values) -> None:
    panels = [
        Panel("Bytes", "bytes", "AP", (Curve("a", at(*values), (900.0, 40000.0)),), in_bytes=True),
        Panel("Branches", "", "AP", (Curve("a", at(*values), (0.0, 1.0)),), ticks=("first", "second")),
    ]
    assert drawn(panels, tmp_path / "x.png").shape[1] > 1.5 * drawn(panels[:1], tmp_path / "x.png").shape[1]
