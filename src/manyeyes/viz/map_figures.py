# SPDX-License-Identifier: Apache-2.0
"""Maps on paper: misalignments between two observations before and after (CrowdMap, Fig. 3), maps side by side (Fig. 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_replace
from manyeyes.datatypes import MissingExtraError
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.evaluation.maps.matching import MatchingProtocol, resample_lines
from manyeyes.evaluation.maps.metrics import select_lines
from manyeyes.ops.nearest_line import find_nearest_line
from manyeyes.viz.map_page import KIND_COLOURS

Floats = NDArray[np.float64]
ARROW_SPACING_M, MAX_ARROW_M = 2.0, 3.0
TRUTH_COLOUR, ARROW_COLOUR = "#b9c3c8", "#d50000"


@dataclass(frozen=True)
class MapPanel:
    """One picture of a figure. background: drawn pale below; arrows: (K, 4) x, y, dx, dy metres."""

    title: str
    elements: MapElements
    background: MapElements | None = None
    arrows: Floats | None = None
    area: tuple[float, float, float, float] | None = None


def compute_misalignment(source: MapElements, target: MapElements) -> Floats:
    """Return (K, 4) x, y, dx, dy: from the lines of one observation, every 2 m, to the nearest point of the other's, within 3
    m.
    """
    arrows = []
    for kind in KINDS:
        source_points = resample_lines(
            select_lines(source, kind), MatchingProtocol("arrows", spacing_m=ARROW_SPACING_M)
        )
        target_points = resample_lines(select_lines(target, kind), MatchingProtocol("fine", spacing_m=0.05))
        near = find_nearest_line(source_points.points, target_points.points, target_points.offsets, MAX_ARROW_M)
        for row in np.flatnonzero(near.line >= 0):
            line = target_points.line(int(near.line[row]))
            step = line - source_points.points[row]
            arrows.append([*source_points.points[row], *step[np.hypot(*step.T).argmin()]])
    return np.array(arrows).reshape(-1, 4)


def save_figure(panels: Sequence[MapPanel], path: Path, columns: int = 2, width_in: float = 6.0) -> None:
    """The panels as one PNG, whole or not at all."""
    pyplot = _import_pyplot()
    rows = -(-len(panels) // columns)
    ratio = np.mean([_aspect_ratio(panel) for panel in panels])
    size = (width_in * columns, (width_in * ratio + 0.5) * rows)
    figure, axes = pyplot.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    for axis in axes.ravel()[len(panels) :]:
        axis.set_axis_off()
    for panel, axis in zip(panels, axes.ravel()):
        _draw(panel, axis)
    handles = [pyplot.Line2D([], [], color=c, lw=2, label=k.replace("_", " ")) for k, c in KIND_COLOURS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    # Without the date of the drawing: the same map is the same file.
    with atomic_replace(path, durable=False) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
    pyplot.close(figure)


def _draw(panel: MapPanel, axis: Any) -> None:
    axis.set_title(panel.title, fontsize=11, loc="left")
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#e3e8eb")
    if panel.background is not None:
        for row in range(len(panel.background)):
            axis.plot(
                *_close_rings(panel.background, row).T, color=TRUTH_COLOUR, lw=3.0, solid_capstyle="round", zorder=1
            )
    for row in range(len(panel.elements)):
        colour = KIND_COLOURS[KINDS[int(panel.elements.kind[row])]]
        axis.plot(*_close_rings(panel.elements, row).T, color=colour, lw=1.2, solid_capstyle="round", zorder=2)
    if panel.arrows is not None and len(panel.arrows):
        x, y, dx, dy = panel.arrows.T
        axis.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=1.0, width=0.003, color=ARROW_COLOUR, zorder=3)
    x0, y0, x1, y1 = _get_area(panel)
    axis.set_xlim(x0, x1)
    axis.set_ylim(y0, y1)
    bar = 10.0 ** np.floor(np.log10(max(x1 - x0, 1e-3) / 3))
    axis.plot([x0 + 0.03 * (x1 - x0), x0 + 0.03 * (x1 - x0) + bar], [y0 + 0.03 * (y1 - y0)] * 2, color="#263238", lw=2)
    axis.annotate(f"{bar:g} m", (x0 + 0.03 * (x1 - x0), y0 + 0.045 * (y1 - y0)), fontsize=8, color="#263238")


def _close_rings(elements: MapElements, row: int) -> Floats:
    points = elements.polyline(row)
    return np.vstack((points, points[:1])) if elements.kind[row] == CROSSING else points


def _get_area(panel: MapPanel) -> tuple[float, float, float, float]:
    """Return the panel's area, or everything in it with a margin."""
    if panel.area is not None:
        return panel.area
    point_sets = [e.points for e in (panel.elements, panel.background) if e is not None and len(e.points)]
    points = np.concatenate(point_sets) if point_sets else np.array([[-10.0, -10.0], [10.0, 10.0]])
    low, high = points.min(0), points.max(0)
    margin = 0.03 * float((high - low).max()) + 1.0
    return float(low[0]) - margin, float(low[1]) - margin, float(high[0]) + margin, float(high[1]) + margin


def _aspect_ratio(panel: MapPanel) -> float:
    x0, y0, x1, y1 = _get_area(panel)
    return min(2.0, max(0.3, (y1 - y0) / (x1 - x0)))


def _import_pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("view", "Drawing a map") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot
