# SPDX-License-Identifier: Apache-2.0
"""Heat-map buffer merge: all lines drawn thick into one picture, the picture thinned back to lines.

The paper names "HBM" and cites Douglas and Peucker (1973), who only simplify; this is the reading of specs/maps.md section 4:
buffer every line, add the scores up on a raster by kind, smooth, threshold, take components, thin them, walk the skeleton's
longest way, simplify. Crossings: drawn filled, a component becomes its least rotated rectangle. The threshold is a share of how
many observations could see a cell, so that one setting serves 20 observations and 200. ``walks="all"`` takes what a component
has besides its longest way too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.maps.baselines._common import Floats, Ints, Merged, Pool, Rules, as_map, pool
from manyeyes.maps.baselines._raster import components, draw_lines, draw_rings, longest_walks, thinned
from manyeyes.maps.baselines.polymerge import blurred, rectangle
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.ops.polyline import feet, near_pairs_between, resample_spaced, simplify

_MOST_CELLS = 64_000_000


@dataclass(frozen=True)
class Config:
    """cell_m: of the raster. buffer_m: half a line's drawn width. smooth_m: of the Gaussian. share: of the views of a cell, and
    least_heat, summed scores, that the heat must reach. shortest_m: of a walk. simplify_m: of lines. walks: of a component.
    rules: pre-filter, score and state.
    """

    cell_m: float = 0.2
    buffer_m: float = 0.75
    smooth_m: float = 0.4
    share: float = 0.2
    least_heat: float = 0.5
    shortest_m: float = 8.0
    simplify_m: float = 0.25
    walks: Literal["longest", "all"] = "all"
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        if self.walks not in ("longest", "all"):
            raise ConfigError(f"heatmap_buffer.walks: expected longest or all; got {self.walks!r}. Choose one of them.")


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Where the raster lies: its corner (2,), its shape, its cell in metres."""

    low: Floats
    shape: tuple[int, int]
    cell_m: float

    def middles(self, cells: Ints) -> Floats:
        """(K, 2) metres of cells (K, 2)."""
        return self.low + (cells + 0.5) * self.cell_m


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The map of the picture."""
    seen = pool(observations, config.rules)
    if not len(seen.elements):
        return as_map(seen, [], config.rules, frame)
    sheet = _sheet(seen, config)
    views = _views(seen.observations, sheet)
    merged = []
    for kind in range(len(KINDS)):
        rows = np.flatnonzero(seen.elements.kind == kind)
        if len(rows):
            shapes = (
                _crossings(seen, rows, sheet, views, config)
                if kind == CROSSING
                else _lines(seen, rows, sheet, views, config)
            )
            merged += _supported(seen, rows, shapes, kind, config)
    return as_map(seen, merged, config.rules, frame)


def _sheet(of: Pool, config: Config) -> _Sheet:
    margin = config.buffer_m + 4 * config.smooth_m
    low = of.elements.points.min(0) - margin
    # Anchored at whole cells of the map, so that a farther observation does not shift the picture.
    low = np.floor(low / config.cell_m) * config.cell_m
    wide, high = np.ceil((of.elements.points.max(0) + margin - low) / config.cell_m).astype(int) + 1
    if wide * high > _MOST_CELLS:
        raise ConfigError(
            f"heatmap_buffer.cell_m: expected a raster of at most {_MOST_CELLS} cells; got {wide} x {high}. Use larger cells."
        )
    return _Sheet(low, (int(wide), int(high)), config.cell_m)


def _views(observations: Sequence[Observation], sheet: _Sheet) -> Floats:
    """(H, W) how many observations' views hold each cell."""
    rings = [MapElements.of([o.view], CROSSING).transform(*o.pose.tolist()).points for o in observations]
    first = np.concatenate(([0], np.cumsum([len(r) for r in rings]))).astype(np.int64)
    views = np.zeros(sheet.shape)
    draw_rings(views, np.concatenate(rings), first, np.ones(len(rings)), sheet.low, sheet.cell_m)
    return views


def _hot(heat: Floats, views: Floats, config: Config) -> np.ndarray:
    """(H, W) where the smoothed heat reaches the threshold."""
    smooth = blurred(heat, config.smooth_m / config.cell_m)
    return smooth >= np.maximum(config.least_heat, config.share * views)


def _lines(of: Pool, rows: Ints, sheet: _Sheet, views: Floats, config: Config) -> list[Floats]:
    """The lines of one kind in the picture."""
    part = of.elements.take(rows)
    heat = np.zeros(sheet.shape)
    columns = (np.array(part.points), np.array(part.first), np.array(part.score))
    draw_lines(heat, *columns, sheet.low, sheet.cell_m, config.buffer_m)
    skeleton = thinned(_hot(heat, views, config))
    least = max(int(config.shortest_m / config.cell_m), 2)
    clear = int(np.ceil(config.buffer_m / config.cell_m))
    cells, first = longest_walks(skeleton, least, clear, config.walks == "all")
    walks = np.split(sheet.middles(cells), first[1:-1]) if len(first) > 1 else []
    return [simplify(walk, config.simplify_m) for walk in walks]


def _crossings(of: Pool, rows: Ints, sheet: _Sheet, views: Floats, config: Config) -> list[Floats]:
    """The rectangles of the crossings in the picture."""
    part = of.elements.take(rows)
    heat = np.zeros(sheet.shape)
    draw_rings(heat, np.array(part.points), np.array(part.first), np.array(part.score), sheet.low, sheet.cell_m)
    label = components(_hot(heat, views, config))
    cells = np.argwhere(label >= 0)
    cells = cells[np.argsort(label[cells[:, 0], cells[:, 1]], kind="stable")]
    number = label[cells[:, 0], cells[:, 1]]
    corners = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
    found = []
    for group in np.split(cells, np.flatnonzero(np.diff(number)) + 1) if len(cells) else []:
        if len(group) * config.cell_m**2 >= 1.0:
            found.append(rectangle(sheet.middles((group[:, None] + corners).reshape(-1, 2))))
    return found


def _supported(of: Pool, rows: Ints, shapes: Sequence[Floats], kind: int, config: Config) -> list[Merged]:
    """Each shape with the rows that lie along it for half of their length or more; without any it is left out."""
    part = of.elements.take(rows)
    drawn = MapElements.of(shapes, kind)
    samples, first = resample_spaced(part.points, part.first, 1.0)
    reach = config.buffer_m + 0.5
    pairs = near_pairs_between(drawn.bounds(), part.bounds(), reach)
    start = np.searchsorted(pairs[:, 0], np.arange(len(shapes) + 1))
    out = []
    for k, shape in enumerate(shapes):
        line = np.concatenate((shape, shape[:1])) if kind == CROSSING else shape
        own = [
            row
            for row in pairs[start[k] : start[k + 1], 1].tolist()
            if (feet(samples[first[row] : first[row + 1]], line).distance <= reach).mean() >= 0.5
        ]
        if own:
            out.append(Merged(shape, kind, rows[np.array(own)]))
    return out
