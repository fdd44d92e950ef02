# SPDX-License-Identifier: Apache-2.0
"""Curves of a study with their 95 % intervals, panels side by side, one colour and marker a label throughout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import atomic_replace
from manyeyes.datatypes import MissingExtraError
from manyeyes.evaluation.statistics.bootstrap import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 2
_LEGEND_COLUMNS = 3
"""Names side by side below each panel."""
_MAX_UPRIGHT_LETTERS = 40
"""Letters below an axis beyond which names are written aslant."""
_NUM_COLOURS = 10
_MARKERS = "os^Dvx"
"""Of labels that have the same colour."""
_BYTES_TICKS = (1 << 9, 1 << 11, 1 << 13, 1 << 15, 1 << 17, 1 << 19)


@dataclass(frozen=True)
class Curve:
    """One line: y at each x. Without x it is a level, drawn from edge to edge, of y[0]."""

    label: str
    y: tuple[Interval, ...]
    x: tuple[float, ...] = ()


@dataclass(frozen=True)
class CurvePanel:
    """Curves on common axes. in_bytes: x is logarithmic, with its base-2 logarithm on top.

    ticks: names of the places 0, 1, 2, … on the x axis, for what is no number.
    """

    title: str
    xlabel: str
    ylabel: str
    curves: tuple[Curve, ...]
    in_bytes: bool = False
    ticks: tuple[str, ...] = ()


def save_curves(panels: Sequence[CurvePanel], path: Path) -> None:
    """The panels as one PNG, whole or not at all."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("view", "Drawing curves") from error
    columns = min(_COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(6.4 * columns, 0.6 + 3.9 * rows), layout="constrained")
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    for place, panel in enumerate(panels):
        _draw(figure.add_subplot(rows, columns, place + 1), panel, labels)
    handles = {h.get_label(): h for axes in figure.axes for h in axes.get_legend_handles_labels()[0]}
    shown_labels = [name for name in labels if name in handles]
    figure.legend(
        [handles[name] for name in shown_labels],
        shown_labels,
        frameon=False,
        fontsize=9,
        loc="outside lower center",
        ncols=_LEGEND_COLUMNS * columns,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_replace(path, durable=False) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def _draw(axes: Axes, panel: CurvePanel, labels: Sequence[str]) -> None:
    from matplotlib.ticker import MaxNLocator

    for curve in panel.curves:
        lap, number = divmod(labels.index(curve.label), _NUM_COLOURS)
        colour, marker = f"C{number}", _MARKERS[lap % len(_MARKERS)]
        if not curve.x:
            axes.axhline(curve.y[0].value, color=colour, lw=1.2, ls="--", label=curve.label)
            continue
        order = sorted(range(len(curve.x)), key=lambda i: curve.x[i])
        x, y = [curve.x[i] for i in order], [curve.y[i] for i in order]
        axes.plot(
            x,
            [v.value for v in y],
            color=colour,
            marker=marker,
            ms=4,
            lw=1.6,
            ls="-" if lap == 0 else "-.",
            label=curve.label,
        )
        if any(v.num_scenarios > 1 for v in y):
            axes.fill_between(x, [v.low for v in y], [v.high for v in y], color=colour, alpha=0.15, lw=0)
    axes.set(xlabel=panel.xlabel, ylabel=panel.ylabel)
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    if panel.ticks:
        slant = (
            {"rotation": 25, "ha": "right", "rotation_mode": "anchor"}
            if sum(map(len, panel.ticks)) > _MAX_UPRIGHT_LETTERS
            else {}
        )
        axes.set_xticks(range(len(panel.ticks)), panel.ticks, **slant)
    elif not panel.in_bytes and all(float(x).is_integer() for curve in panel.curves for x in curve.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if panel.in_bytes:
        axes.set_xscale("log", base=2)
        axes.set_xticks(_BYTES_TICKS, [f"{t / 1024:g} KiB" for t in _BYTES_TICKS])
        top = axes.secondary_xaxis("top")
        top.set_xticks(_BYTES_TICKS, [f"{math.log2(t):g}" for t in _BYTES_TICKS])
        top.set_xlabel("log2(bytes)", fontsize=8)
