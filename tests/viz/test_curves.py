# SPDX-License-Identifier: Apache-2.0
"""Curves as an image: the drawn parts depend on the input, and no temporary file is left."""

import math
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.viz import curves
from manyeyes.viz.curves import Curve, CurvePanel, save_curves


def at(*values: float, half: float = 0.01) -> tuple[Interval, ...]:
    return tuple(Interval(v, v - half, v + half, 0.95, 5) for v in values)


def drawn(panels: list[CurvePanel], path) -> np.ndarray:
    save_curves(panels, path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_a_wider_interval_and_another_level_are_other_pictures(tmp_path) -> None:
    def panel(half: float, level: float) -> list[CurvePanel]:
        curves = (Curve("late", at(0.8, 0.7, half=half), (0.0, 0.4)), Curve("none", at(level)))
        return [CurvePanel("Delay", "seconds", "AP@0.5", curves)]

    first, wider, other = (drawn(panel(*p), tmp_path / "x.png") for p in ((0.01, 0.75), (0.05, 0.75), (0.01, 0.72)))
    assert first.shape == wider.shape == other.shape
    assert np.abs(first - wider).any() and np.abs(first - other).any()


@pytest.mark.slow
@pytest.mark.parametrize("values", [(0.5, 0.9), (math.nan, 0.9)])
def test_bytes_have_their_logarithm_on_top_and_ticks_their_names(tmp_path, values) -> None:
    panels = [
        CurvePanel("Bytes", "bytes", "AP", (Curve("a", at(*values), (900.0, 40000.0)),), in_bytes=True),
        CurvePanel("Branches", "", "AP", (Curve("a", at(*values), (0.0, 1.0)),), ticks=("first", "second")),
    ]
    assert drawn(panels, tmp_path / "x.png").shape[1] > 1.5 * drawn(panels[:1], tmp_path / "x.png").shape[1]


@pytest.mark.parametrize("names", (("a", "b", "c"), tuple(f"a long name of a branch {k}" for k in range(8))))
def test_names_below_an_axis_stand_apart(names: tuple[str, ...]) -> None:
    figure = Figure(figsize=(6.4, 4.5), layout="constrained")
    axes = figure.add_subplot()
    curve = Curve("c", at(*[0.5] * len(names)), tuple(map(float, range(len(names)))))
    curves._draw(axes, CurvePanel("", "", "AP", (curve,), ticks=names), ["c"])
    FigureCanvasAgg(figure).draw()
    labels = axes.get_xticklabels()
    assert [label.get_text() for label in labels] == list(names)
    # Lines of writing at one angle do not meet if they are a line's height apart; level ones, if their boxes are.
    steep = math.sin(math.radians(labels[0].get_rotation()))
    for one, other in pairwise(labels):
        way = other.get_transform().transform(other.get_position()) - one.get_transform().transform(one.get_position())
        height = one.get_fontsize() * figure.dpi / 72
        assert way[0] * steep > height or not one.get_window_extent().overlaps(other.get_window_extent())


def test_agents_are_counted_in_whole_numbers() -> None:
    axes = Figure().add_subplot()
    curves._draw(axes, CurvePanel("", "agents", "AP", (Curve("c", at(0.5, 0.6, 0.7), (1.0, 2.0, 3.0)),)), ["c"])
    assert all(float(tick).is_integer() for tick in axes.get_xticks())


def test_the_legend_of_one_panel_is_not_cut_off(tmp_path) -> None:
    names = ("calibrated", *(f"{name}-temporal" for name in ("no-fusion", "late", "intermediate", "early")))
    curves = tuple(Curve(name, at(0.8, 0.7 - 0.1 * k), (0.0, 0.4)) for k, name in enumerate(names))
    pixels = drawn([CurvePanel("Reliability", "score", "fraction", curves)], tmp_path / "x.png")
    legend = pixels[-75:]
    assert (legend[:, :4] == 255).all() and (legend[:, -4:] == 255).all() and (legend < 255).any()


def test_no_two_of_many_labels_are_drawn_alike() -> None:
    labels = [f"method {k}" for k in range(23)]
    axes = Figure().add_subplot()
    curves._draw(axes, CurvePanel("", "", "AP", tuple(Curve(n, at(0.5, 0.6), (0.0, 1.0)) for n in labels)), labels)
    styles = {(line.get_color(), line.get_marker()) for line in axes.get_lines()}
    assert len(axes.get_lines()) == len(styles) == len(labels)
