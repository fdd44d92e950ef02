# SPDX-License-Identifier: Apache-2.0
"""Heat-map buffer merge: all lines are drawn into one raster, which is thinned back to lines.

CrowdMap names this baseline "HBM" and cites Douglas and Peucker (1973), who only simplify; this is an interpretation: buffer
every line, add the scores on a raster by kind, smooth, threshold, label components, skeletonize, take the longest path,
simplify. Crossings: drawn filled, a component becomes its minimum rotated rectangle. The threshold is a fraction of the number
of observations that cover a cell, so that one setting serves 20 observations and 200. ``walks="all"`` takes a component's other
paths too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.maps.baselines._common import (
    BaselineRules,
    ElementPool,
    Floats,
    Ints,
    MergedElement,
    filter_elements,
    to_vector_map,
)
from manyeyes.maps.baselines._raster import draw_lines, draw_rings, find_longest_walks, label_components, skeletonize
from manyeyes.maps.baselines.polymerge import blur_image, fit_rectangle
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion
from manyeyes.ops.polyline import find_near_pairs_between, project_onto_line, resample_spaced, simplify

_MAX_CELLS = 64_000_000


@dataclass(frozen=True)
class HeatmapBufferConfig:
    """Configuration of the baseline.

    cell_m: of the raster. buffer_m: half width of a drawn line. smoothing_sigma_m: of the Gaussian.
    min_view_fraction: threshold of the heat as a fraction of the views of a cell; min_heat: smallest summed score.
    min_walk_length_m: shortest path. simplify_m: of lines. walks: paths of a component. rules: pre-filter, score and state.
    """

    cell_m: float = 0.2
    buffer_m: float = 0.75
    smoothing_sigma_m: float = 0.4
    min_view_fraction: float = 0.2
    min_heat: float = 0.5
    min_walk_length_m: float = 8.0
    simplify_m: float = 0.25
    walks: Literal["longest", "all"] = "all"
    rules: BaselineRules = field(default_factory=BaselineRules)

    def __post_init__(self) -> None:
        if self.walks not in ("longest", "all"):
            raise ConfigError(f"heatmap_buffer.walks: expected longest or all; got {self.walks!r}. Choose one of them.")


@dataclass(frozen=True, eq=False)
class _RasterGrid:
    """Where the raster lies: its corner (2,), its shape, its cell in metres."""

    origin: Floats
    shape: tuple[int, int]
    cell_m: float

    def cell_centers(self, cells: Ints) -> Floats:
        """Return (K, 2) metres of cells (K, 2)."""
        return self.origin + (cells + 0.5) * self.cell_m


@register_map_fusion("heatmap-buffer", HeatmapBufferConfig)
def fuse(
    observations: Sequence[Observation],
    config: HeatmapBufferConfig = HeatmapBufferConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Return the map of the picture."""
    element_pool = filter_elements(observations, config.rules)
    if not len(element_pool.elements):
        return to_vector_map(element_pool, [], config.rules, frame)
    raster = _make_raster(element_pool, config)
    views = _count_views(element_pool.observations, raster)
    merged = []
    for kind in range(len(KINDS)):
        rows = np.flatnonzero(element_pool.elements.kind == kind)
        if len(rows):
            shapes = (
                _extract_crossings(element_pool, rows, raster, views, config)
                if kind == CROSSING
                else _extract_lines(element_pool, rows, raster, views, config)
            )
            merged += _attach_sources(element_pool, rows, shapes, kind, config)
    return to_vector_map(element_pool, merged, config.rules, frame)


def _make_raster(pool: ElementPool, config: HeatmapBufferConfig) -> _RasterGrid:
    margin = config.buffer_m + 4 * config.smoothing_sigma_m
    low = pool.elements.points.min(0) - margin
    # Anchored at whole cells of the map, so that a farther observation does not shift the picture.
    low = np.floor(low / config.cell_m) * config.cell_m
    wide, high = np.ceil((pool.elements.points.max(0) + margin - low) / config.cell_m).astype(int) + 1
    if wide * high > _MAX_CELLS:
        raise ConfigError(
            f"heatmap_buffer.cell_m: expected a raster of at most {_MAX_CELLS} cells; got {wide} x {high}. Use larger cells."
        )
    return _RasterGrid(low, (int(wide), int(high)), config.cell_m)


def _count_views(observations: Sequence[Observation], raster: _RasterGrid) -> Floats:
    """Return (H, W) how many observations' views hold each cell."""
    rings = [MapElements.of([o.view], CROSSING).transform(*o.pose.tolist()).points for o in observations]
    offsets = np.concatenate(([0], np.cumsum([len(r) for r in rings]))).astype(np.int64)
    views = np.zeros(raster.shape)
    draw_rings(views, np.concatenate(rings), offsets, np.ones(len(rings)), raster.origin, raster.cell_m)
    return views


def _threshold_heat(heat: Floats, views: Floats, config: HeatmapBufferConfig) -> np.ndarray:
    """Return (H, W) where the smoothed heat reaches the threshold."""
    smooth = blur_image(heat, config.smoothing_sigma_m / config.cell_m)
    return smooth >= np.maximum(config.min_heat, config.min_view_fraction * views)


def _extract_lines(
    pool: ElementPool, rows: Ints, raster: _RasterGrid, views: Floats, config: HeatmapBufferConfig
) -> list[Floats]:
    """Return the lines of one kind in the picture."""
    part = pool.elements.take(rows)
    heat = np.zeros(raster.shape)
    columns = (np.array(part.points), np.array(part.offsets), np.array(part.score))
    draw_lines(heat, *columns, raster.origin, raster.cell_m, config.buffer_m)
    skeleton = skeletonize(_threshold_heat(heat, views, config))
    min_cells = max(int(config.min_walk_length_m / config.cell_m), 2)
    clear_cells = int(np.ceil(config.buffer_m / config.cell_m))
    cells, offsets = find_longest_walks(skeleton, min_cells, clear_cells, config.walks == "all")
    walks = np.split(raster.cell_centers(cells), offsets[1:-1]) if len(offsets) > 1 else []
    return [simplify(walk, config.simplify_m) for walk in walks]


def _extract_crossings(
    pool: ElementPool, rows: Ints, raster: _RasterGrid, views: Floats, config: HeatmapBufferConfig
) -> list[Floats]:
    """Return the rectangles of the crossings in the picture."""
    part = pool.elements.take(rows)
    heat = np.zeros(raster.shape)
    draw_rings(heat, np.array(part.points), np.array(part.offsets), np.array(part.score), raster.origin, raster.cell_m)
    label = label_components(_threshold_heat(heat, views, config))
    cells = np.argwhere(label >= 0)
    cells = cells[np.argsort(label[cells[:, 0], cells[:, 1]], kind="stable")]
    number = label[cells[:, 0], cells[:, 1]]
    corners = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
    found = []
    for group in np.split(cells, np.flatnonzero(np.diff(number)) + 1) if len(cells) else []:
        if len(group) * config.cell_m**2 >= 1.0:
            found.append(fit_rectangle(raster.cell_centers((group[:, None] + corners).reshape(-1, 2))))
    return found


def _attach_sources(
    pool: ElementPool, rows: Ints, shapes: Sequence[Floats], kind: int, config: HeatmapBufferConfig
) -> list[MergedElement]:
    """Return each shape with the rows that lie along it for half of their length or more; without any it is left out."""
    part = pool.elements.take(rows)
    drawn = MapElements.of(shapes, kind)
    samples, offsets = resample_spaced(part.points, part.offsets, 1.0)
    max_distance = config.buffer_m + 0.5
    pairs = find_near_pairs_between(drawn.bounds(), part.bounds(), max_distance)
    start = np.searchsorted(pairs[:, 0], np.arange(len(shapes) + 1))
    out = []
    for k, shape in enumerate(shapes):
        line = np.concatenate((shape, shape[:1])) if kind == CROSSING else shape
        supporting_rows = [
            row
            for row in pairs[start[k] : start[k + 1], 1].tolist()
            if (project_onto_line(samples[offsets[row] : offsets[row + 1]], line).distance_m <= max_distance).mean()
            >= 0.5
        ]
        if supporting_rows:
            out.append(MergedElement(shape, kind, rows[np.array(supporting_rows)]))
    return out
