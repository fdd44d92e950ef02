# SPDX-License-Identifier: Apache-2.0
"""Figures as SVG text, light and dark, the same on every run: fixed identifiers, no date, no background."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from manyeyes.datatypes import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HASH_SALT = "manyeyes"
_PANEL_WIDTH_IN, _SINGLE_PANEL_WIDTH_IN, _LEGEND_LINE_IN = 4.1, 7.4, 0.22
_LEGEND_LETTER_IN, _LEGEND_MARK_IN = 0.08, 0.55
"""Width of a letter of a legend, and of a mark with its margins, inches."""
_FORM_SUFFIX = "-temporal"
_LINE_STYLES = ("-", "--", "-.", ":")


@dataclass(frozen=True)
class Theme:
    """Colours of text, grid and series on a page."""

    name: str
    text: str
    grid: str
    series: tuple[str, ...]

    def series_colour(self, place: int) -> str:
        """Return the colour of a series by its place; colours repeat after the last."""
        return self.series[place % len(self.series)]


THEMES = (
    Theme(
        "light",
        "#24292f",
        "#d0d7de",
        ("#0b7285", "#d9480f", "#5f3dc4", "#2b8a3e", "#c2255c", "#868e96", "#1864ab", "#b08900", "#7f4f24", "#343a40"),
    ),
    Theme(
        "dark",
        "#e6edf3",
        "#3d444d",
        ("#3bc9db", "#ff922b", "#b197fc", "#69db7c", "#f783ac", "#adb5bd", "#74c0fc", "#ffd43b", "#e0a96d", "#ffffff"),
    ),
)


@dataclass(frozen=True)
class Panel:
    """One pair of axes. draw: adds the data to the axes with the colours of a theme. min_height_in: for its lines, inches."""

    title: str
    xlabel: str
    ylabel: str
    draw: Callable[[Any, Theme], None]
    min_height_in: float = 0.0


def draw_svg(panels: Sequence[Panel], theme: Theme, height_in: float = 3.1) -> str:
    """Return the SVG text of panels side by side, with one legend below for the labels of all.

    height_in: of the axes with their labels, inches.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("view", "Drawing figures of documents") from error
    settings: dict[Any, Any] = {
        "svg.hashsalt": _HASH_SALT, "svg.fonttype": "none", "font.family": "DejaVu Sans", "font.size": 9,
        "text.color": theme.text, "axes.labelcolor": theme.text, "axes.edgecolor": theme.text, "axes.titlesize": 10,
        "xtick.color": theme.text, "ytick.color": theme.text, "grid.color": theme.grid, "legend.labelcolor": theme.text,
    }  # fmt: skip
    height_in = max(height_in, *(panel.min_height_in for panel in panels))
    with matplotlib.rc_context(settings):
        width = _PANEL_WIDTH_IN * len(panels) if len(panels) > 1 else _SINGLE_PANEL_WIDTH_IN
        figure = Figure(figsize=(width, height_in), layout="constrained")
        figure.patch.set_alpha(0.0)
        for place, panel in enumerate(panels):
            axes = figure.add_subplot(1, len(panels), place + 1)
            axes.patch.set_alpha(0.0)
            axes.grid(lw=0.6)
            axes.set_axisbelow(True)
            axes.spines[["top", "right"]].set_visible(False)
            panel.draw(axes, theme)
            axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
            axes.set_title(panel.title, loc="left")
        handles = {str(h.get_label()): h for a in figure.axes for h in a.get_legend_handles_labels()[0]}
        if handles:
            widest = max(map(len, handles)) * _LEGEND_LETTER_IN + _LEGEND_MARK_IN
            lines = math.ceil(len(handles) / min(len(handles), max(1, int(width / widest))))
            figure.set_size_inches(width, height_in + _LEGEND_LINE_IN * lines)
            figure.legend(
                [*handles.values()], [*handles], frameon=False, loc="outside lower center",
                ncols=math.ceil(len(handles) / lines),
            )  # fmt: skip
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def draw_point(
    axes: Axes, x: float, interval: dict[str, float], colour: str, label: str, *, hollow: bool = False
) -> None:
    """Add a point with the interval of its y value; hollow: an open marker."""
    value = interval["value"]
    errors = [[max(0.0, value - interval["low"])], [max(0.0, interval["high"] - value)]]
    axes.errorbar(
        [x], [value], errors, color=colour, marker="o", ms=6, mfc="none" if hollow else colour, mew=1.5, capsize=2.5,
        ls="none", label=label,
    )  # fmt: skip


def draw_line(
    axes: Axes, x: Sequence[float], intervals: Sequence[dict[str, float]], theme: Theme, place: int, label: str
) -> None:
    """Add a line through values with a band of their intervals, in the order of x.

    place: of the series; lines of neighbouring places differ in colour and in dashes, so that equal values are still two lines.
    """
    order = sorted(range(len(x)), key=lambda i: x[i])
    ordered = [intervals[i] for i in order]
    colour, style = theme.series_colour(place), _LINE_STYLES[place % len(_LINE_STYLES)]
    axes.plot(
        [x[i] for i in order],
        [i["value"] for i in ordered],
        color=colour,
        ls=style,
        marker="o",
        ms=4,
        lw=1.6,
        label=label,
    )
    axes.fill_between(
        [x[i] for i in order], [i["low"] for i in ordered], [i["high"] for i in ordered], color=colour, alpha=0.15, lw=0
    )


def draw_level(axes: Axes, interval: dict[str, float], colour: str, label: str) -> None:
    """Add a dashed level from edge to edge with the band of its interval."""
    axes.axhline(interval["value"], color=colour, lw=1.4, ls="--", label=label)
    axes.axhspan(interval["low"], interval["high"], color=colour, alpha=0.12, lw=0)


def split_form(method: str) -> tuple[str, bool]:
    """Return the name of a method without its form, and whether it has memory."""
    return method.removesuffix(_FORM_SUFFIX), method.endswith(_FORM_SUFFIX)


def spread_points(x: Sequence[float], distance: float) -> list[float]:
    """Move points that are closer than a distance apart, each group about its mean, in the order of the points."""
    moved = [float(value) for value in x]
    groups: list[list[int]] = []
    for i in sorted(range(len(x)), key=lambda i: x[i]):
        if groups and x[i] - x[groups[-1][-1]] < distance:
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in (g for g in groups if len(g) > 1):
        mean = sum(x[i] for i in group) / len(group)
        for rank, i in enumerate(sorted(group)):
            moved[i] = mean + distance * (rank - (len(group) - 1) / 2)
    return moved
