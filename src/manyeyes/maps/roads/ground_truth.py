# SPDX-License-Identifier: Apache-2.0
"""The true vector map of a road network: each physical line once, whole, and cut where junctions begin.

Files store a line as often as lanes border on it, in pieces as long as a road's record, and with lines through junctions that
are not painted. The elements of the ground truth depend on the choices below, each of which changes the AP of dividers;
benchmarks publish them with their results.

1. divider: painted lines. A double line is its middle, style "double". Paint inside junctions is virtual and is dropped.
2. boundary: the edge of the paved ground, out of the file's edges (Argoverse 2, Lanelet2) or as the outline of the union of
   all paved lanes and their shoulders (OpenDRIVE, whose curbs are incomplete). Where the map itself ends there is no edge, and
   edges farther than ``max_lane_distance_m`` from any drivable lane (Argoverse 2 has ground without lanes) belong to no road.
3. A line within ``merge_radius_m`` and ``max_merge_heading_rad`` of a longer one of its class is the same line; what of it stands
out stays.
4. Lines whose ends lie within ``max_gap_m`` and continue each other's direction are one line.
5. Cut policy ``junction``: boundaries are cut at the outline of each junction's lanes, widened by ``junction_margin_m``.
   :func:`cut_elements` does the same to anybody's map. ``none``: a boundary goes on around the corners of junctions, since no
   sensor measures where a junction begins. Attributes (style) do not cut.
6. crossing: open rings, anticlockwise. stop_line: as drawn.
Order and direction are canonical: elements by class and first point, lines from the lexicographically smaller end.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, KINDS, STYLES, MapElements
from manyeyes.maps.roads.road_network import PAVED, Lane, RoadMark, RoadNetwork

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "The truth of a map")

Array = NDArray[np.float64]

ROADWAY = (*PAVED, "shoulder", "border")
_STEP_M = 0.5
_END_M = 2.0
_SIMPLIFY_M = 0.02
_CAP_M = 3.0


@dataclass(frozen=True)
class GroundTruthPolicy:
    """What counts as one element; the numbers of the module's list. Lengths in metres, angles in radians, areas in m²."""

    boundary: Literal["marks", "pavement"] = "marks"
    boundary_cut: Literal["junction", "none"] = "junction"
    merge_radius_m: float = 0.3
    max_merge_heading_rad: float = 0.26
    max_gap_m: float = 0.5
    max_gap_heading_rad: float = 0.175
    junction_margin_m: float = 1.5
    max_lane_distance_m: float = 15.0
    min_line_length_m: float = 5.0
    min_crossing_area_m2: float = 3.0
    min_island_area_m2: float = 10.0


@dataclass(frozen=True, eq=False)
class _StyledLine:
    """A line on its way: points (M, 2) and metres of it in each of STYLES (S,)."""

    points: Array
    style: Array

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def build_ground_truth_map(network: RoadNetwork, policy: GroundTruthPolicy = GroundTruthPolicy()) -> MapElements:
    """Return all true elements of a road network, in its world frame, by the rules of this module."""
    _shapely()
    paint = [mark for mark in network.marks if mark.kind in ("solid", "broken")]
    dividers = _clip_outside(_merge_double_lines(paint), compute_junction_region(network, policy.merge_radius_m))
    dividers = chain_lines(merge_duplicates(dividers, policy), policy)
    if policy.boundary == "pavement":
        edges = _trace_pavement(network, policy)
    else:
        edges = [_StyledLine(mark.line[:, :2], _one_hot_style("none")) for mark in network.marks if mark.kind == "curb"]
    edges = _keep_near_lanes(_drop_map_ends(edges, network), network, policy)
    boundaries = chain_lines(merge_duplicates(edges, policy), policy)
    if policy.boundary_cut == "junction":
        region = compute_junction_region(network, policy.junction_margin_m)
        boundaries = [piece for line in boundaries for piece in _split_line(line, region, policy.min_line_length_m)]
    stops = [_StyledLine(mark.line[:, :2], _one_hot_style("none")) for mark in network.marks if mark.kind == "stop"]
    found: list[tuple[str, _StyledLine]] = []
    found += [("divider", line) for line in dividers if line.length_m >= policy.min_line_length_m]
    found += [("boundary", line) for line in boundaries if line.length_m >= policy.min_line_length_m]
    found += [("crossing", line) for line in _select_crossings(network, policy)]
    found += [("stop_line", line) for line in stops if line.length_m >= 1.0]
    return _to_elements(found)


def compute_junction_region(network: RoadNetwork, margin_m: float) -> BaseGeometry:
    """Return the ground of all junctions' drivable lanes, widened by a margin (shapely geometry, network frame)."""
    shapely = _shapely()
    inside = [lane for lane in network.lanes if lane.junction_id is not None and lane.is_drivable]
    ground = shapely.union_all(shapely.buffer(_lane_polygons(inside), 0.05))
    return shapely.simplify(shapely.buffer(ground, margin_m - 0.05, join_style="mitre"), 0.05)


def cut_elements(elements: MapElements, region: BaseGeometry, min_line_length_m: float = 5.0) -> MapElements:
    """Return the elements with lines cut where they enter or leave the region; crossings stay whole, pieces keep score and style.

    A cut that would leave a piece shorter than min_line_length_m is not made.
    """
    shapely = _shapely()
    if not len(elements):
        return elements
    parts, sigmas, source = [], [], []
    shapely.prepare(region)
    for k in range(len(elements)):
        line = elements.polyline(k)
        ring = elements.kind[k] == CROSSING
        sigma = elements.sigma[elements.offsets[k] : elements.offsets[k + 1]]
        for part in [line] if ring else _split(line, region, min_line_length_m):
            parts.append(part)
            source.append(k)
            # The nearest own point's sigma: cuts add points, they do not move any.
            sigmas.append(sigma[np.linalg.norm(part[:, None] - line, axis=2).argmin(1)])
    own = np.array(source, np.int64)
    sigma = np.concatenate(sigmas) if sigmas else np.zeros(0)
    return MapElements.of(parts, elements.kind[own], elements.score[own], sigma, elements.style[own])


def merge_duplicates(lines: Sequence[_StyledLine], policy: GroundTruthPolicy) -> list[_StyledLine]:
    """Return each physical line once: a stretch that runs along a longer line of the list is left out."""
    shapely = _shapely()
    ranked = sorted((line for line in lines if line.length_m > 0.1), key=lambda line: (-line.length_m, *_ends(line)))
    if not ranked:
        return []
    shapes = [shapely.LineString(line.points) for line in ranked]
    tree = shapely.STRtree(shapes)
    kept = []
    for rank, line in enumerate(ranked):
        near = np.sort(tree.query(shapes[rank], predicate="dwithin", distance=policy.merge_radius_m))
        near = near[near < rank]
        covered = np.zeros(0, bool)
        points = line.points
        if len(near):
            points = _densify(line.points, _STEP_M / 2)
            covered = np.zeros(len(points), bool)
            for other in near.tolist():
                covered |= _is_duplicate(points, shapes[other], policy)
        kept += [_StyledLine(part, line.style) for part in _split_runs(points, ~covered)] if covered.any() else [line]
    return [line for line in kept if line.length_m >= 2 * _STEP_M]


def _is_duplicate(points: Array, shape: BaseGeometry, policy: GroundTruthPolicy) -> NDArray[np.bool_]:
    """Return (M,) whether each point lies within merge_radius_m beside a line, not beyond its ends, and has its direction."""
    shapely = _shapely()
    probe = shapely.points(points)
    close = shapely.distance(probe, shape) <= policy.merge_radius_m
    if close.any():
        along = shapely.line_locate_point(shape, probe[close])
        ahead = shapely.get_coordinates(shapely.line_interpolate_point(shape, np.minimum(along + 0.25, shape.length)))
        behind = shapely.get_coordinates(shapely.line_interpolate_point(shape, np.maximum(along - 0.25, 0.0)))
        step = np.gradient(points, axis=0)[close]
        turn = np.abs(_angle(step) - _angle(ahead - behind)) % np.pi
        beside = (along > 1e-6) & (along < shape.length - 1e-6)
        close[close] = beside & (np.minimum(turn, np.pi - turn) <= policy.max_merge_heading_rad)
    return close


def chain_lines(lines: Sequence[_StyledLine], policy: GroundTruthPolicy) -> list[_StyledLine]:
    """Return lines joined end to end where two ends are each other's best continuation."""
    shapely = _shapely()
    if not lines:
        return []
    ordered = sorted(lines, key=_ends)
    # End 2k is the start of line k, 2k + 1 its end; out points away from the line.
    place = np.array([p for line in ordered for p in (line.points[0], line.points[-1])])
    out = np.array([_outward(line.points[::direction]) for line in ordered for direction in (1, -1)])
    tree = shapely.STRtree(shapely.points(place))
    one, two = tree.query(shapely.points(place), predicate="dwithin", distance=policy.max_gap_m)
    turn = np.abs(np.angle(-out[one] * np.conj(out[two])))
    fits = (one != two) & (turn <= policy.max_gap_heading_rad)
    one, two, turn = one[fits], two[fits], turn[fits]
    gap = np.linalg.norm(place[one] - place[two], axis=1)
    # A line of one short piece may meet its own other end; only rings longer than that close.
    loop = (one // 2 == two // 2) & (np.array([line.length_m for line in ordered])[one // 2] < 4 * _END_M)
    order = np.lexsort((two, one, np.where(loop, np.inf, gap + turn)))
    partner = np.full(len(place), -1)
    for k in order.tolist():
        if not loop[k] and partner[one[k]] < 0 and partner[two[k]] < 0:
            partner[one[k]], partner[two[k]] = two[k], one[k]
    return _join_chains(ordered, partner)


def _join_chains(lines: Sequence[_StyledLine], partner: NDArray[np.int64]) -> list[_StyledLine]:
    """Return the chains that the partners of ends (2K,) make; rings begin at their smallest line."""
    used = np.zeros(len(lines), bool)
    joined = []
    free = [end for end in range(len(partner)) if partner[end] < 0]
    for start in (*free, *range(0, len(partner), 2)):
        end, points, style = start, [], np.zeros(len(STYLES))
        while end >= 0 and not used[end // 2]:
            used[end // 2] = True
            line = lines[end // 2]
            points.append(line.points if end % 2 == 0 else line.points[::-1])
            style = style + line.style / max(line.style.sum(), 1e-9) * line.length_m
            end = int(partner[end ^ 1])
        if points:
            whole = np.concatenate(points)
            fresh = np.concatenate(([True], np.linalg.norm(np.diff(whole, axis=0), axis=1) > 0.01))
            joined.append(_StyledLine(whole[fresh] if fresh.sum() > 1 else whole[[0, -1]], style))
    return joined


def _merge_double_lines(marks: Sequence[RoadMark]) -> list[_StyledLine]:
    """Painted lines, those of one border that run side by side (a double line) as their middle."""
    groups: dict[tuple[str, int, int, int, tuple[float, ...]], list[RoadMark]] = {}
    for number, mark in enumerate(marks):
        # Only lines of one border and one stretch pair up: same count of points, ends within a few widths.
        key = (mark.road_id, mark.section, mark.lane_id, len(mark.line), tuple(np.round(mark.line[0, :2] / 4).tolist()))
        own_key = (f"#{number}", 0, 0, 0, ())
        groups.setdefault(key if mark.road_id and mark.lane_id is not None else own_key, []).append(mark)
    lines = []
    for group in groups.values():
        while group:
            mark, *rest = group
            pair = next((k for k, other in enumerate(rest) if np.abs(other.line - mark.line)[:, :2].max() < 0.6), None)
            if pair is None:
                name = "solid" if mark.kind == "solid" else "dashed"
                lines.append(_StyledLine(mark.line[:, :2], _one_hot_style(name)))
            else:
                lines.append(_StyledLine((mark.line[:, :2] + rest.pop(pair).line[:, :2]) / 2, _one_hot_style("double")))
            group = rest
    return lines


def _trace_pavement(network: RoadNetwork, policy: GroundTruthPolicy) -> list[_StyledLine]:
    """Return the outline of the union of all paved lanes and shoulders."""
    shapely = _shapely()
    paved = [lane for lane in network.lanes if lane.kind in ROADWAY and lane.width_m.max() > 0.05]
    strips = shapely.buffer(_lane_polygons(paved), 0.1, join_style="mitre")
    ground = shapely.buffer(shapely.union_all(strips), -0.1, join_style="mitre")
    found = []
    for part in shapely.get_parts(ground):
        if part.area < policy.min_island_area_m2:
            continue
        islands = [ring for ring in part.interiors if shapely.Polygon(ring).area >= policy.min_island_area_m2]
        found += [
            _StyledLine(shapely.get_coordinates(ring), _one_hot_style("none")) for ring in (part.exterior, *islands)
        ]
    return found


def _drop_map_ends(lines: Sequence[_StyledLine], network: RoadNetwork) -> list[_StyledLine]:
    """Return edges without those that cross a lane's end where nothing follows: there the map ends, not the road."""
    shapely = _shapely()
    caps = []
    for lane in network.lanes:
        if lane.kind in ROADWAY:
            for linked, row in ((lane.predecessors, 0), (lane.successors, -1)):
                if not linked and np.linalg.norm(lane.left[row] - lane.right[row]) > 0.5:
                    caps.append(np.stack((lane.left[row, :2], lane.right[row, :2])))
    if not caps:
        return list(lines)
    bars = [shapely.LineString(cap) for cap in caps]
    tree = shapely.STRtree(bars)
    heading = np.array([_angle(cap[1:] - cap[:1])[0] for cap in caps])
    kept = []
    for line in lines:
        points = _densify(line.points, _STEP_M)
        probe, bar = tree.query(shapely.points(points), predicate="dwithin", distance=_CAP_M)
        turn = np.abs(_angle(np.gradient(points, axis=0))[probe] - heading[bar]) % np.pi
        across = np.zeros(len(points), bool)
        across[probe[np.minimum(turn, np.pi - turn) < np.pi / 4]] = True
        kept += [_StyledLine(part, line.style) for part in _split_runs(points, ~across)] if across.any() else [line]
    return kept


def _keep_near_lanes(
    lines: Sequence[_StyledLine], network: RoadNetwork, policy: GroundTruthPolicy
) -> list[_StyledLine]:
    """Return edges near drivable lanes, without what runs through the middle of one: a record's end, not an edge."""
    shapely = _shapely()
    lanes = _lane_polygons([lane for lane in network.lanes if lane.is_drivable])
    near = shapely.union_all(shapely.buffer(lanes, policy.max_lane_distance_m))
    return _clip_outside(lines, shapely.union_all(shapely.buffer(lanes, -1.0)), near)


def _select_crossings(network: RoadNetwork, policy: GroundTruthPolicy) -> list[_StyledLine]:
    """Return rings of crossings, the smaller of two that share half of its ground left out."""
    shapely = _shapely()
    rings = [shapely.make_valid(shapely.Polygon(crossing.polygon[:, :2])) for crossing in network.crossings]
    parts = [part for ring in rings for part in shapely.get_parts(ring) if part.geom_type == "Polygon"]
    parts = [shapely.simplify(part, _SIMPLIFY_M) for part in parts if part.area >= policy.min_crossing_area_m2]
    parts.sort(key=lambda part: (-part.area, *part.bounds))
    kept = []
    for part in parts:
        if all(part.intersection(other).area < 0.5 * part.area for other in kept):
            kept.append(part)
    found = []
    for part in kept:
        ring = shapely.get_coordinates(part.exterior)[:-1]
        ring = ring if shapely.is_ccw(part.exterior) else ring[::-1]
        found.append(_StyledLine(np.roll(ring, -int(np.lexsort(ring.T[::-1])[0]), axis=0), _one_hot_style("none")))
    return found


def _to_elements(lines_by_kind: Sequence[tuple[str, _StyledLine]]) -> MapElements:
    """Return lines and rings as a table in canonical order and direction."""
    shapely = _shapely()
    rows = []
    for kind, line in lines_by_kind:
        points = line.points
        if kind != "crossing":
            points = shapely.get_coordinates(shapely.LineString(points).simplify(_SIMPLIFY_M))
            if np.linalg.norm(points[0] - points[-1]) < 0.01:
                ring = points[:-1]
                ring = np.roll(ring, -int(np.lexsort(ring.T[::-1])[0]), axis=0)
                points = np.concatenate((ring, ring[:1]))
            points = points if tuple(points[0]) <= tuple(points[-1]) else points[::-1]
        rows.append((KINDS.index(kind), points, line.style / max(line.style.sum(), 1e-9)))
    rows.sort(key=lambda row: (row[0], *row[1][0].tolist(), *row[1][-1].tolist(), len(row[1])))
    return MapElements.of(
        [row[1] for row in rows],
        np.array([row[0] for row in rows], np.int64),
        sigma=0.0,
        style=np.array([row[2] for row in rows]).reshape(-1, len(STYLES)),
    )


def _clip_outside(
    lines: Sequence[_StyledLine], region: BaseGeometry, within: BaseGeometry | None = None
) -> list[_StyledLine]:
    """What of the lines lies outside a region, and inside another."""
    shapely = _shapely()
    shapely.prepare(region)
    kept = []
    for line in lines:
        shape = shapely.LineString(line.points)
        rest = shape.difference(region) if region.intersects(shape) else shape
        rest = rest if within is None else rest.intersection(within)
        if rest is shape:
            kept.append(line)
            continue
        parts = shapely.get_parts(shapely.line_merge(rest))
        kept += [_StyledLine(shapely.get_coordinates(part), line.style) for part in parts if part.length > 0.0]
    return kept


def _split_line(line: _StyledLine, region: BaseGeometry, min_length_m: float) -> list[_StyledLine]:
    return [_StyledLine(part, line.style) for part in _split(line.points, region, min_length_m)]


def _split(points: Array, region: BaseGeometry, min_length_m: float) -> list[Array]:
    """Return the stretches of a line outside and inside a region, in the line's order, none cut shorter than min_length_m."""
    shapely = _shapely()
    shape = shapely.LineString(points)
    if not region.intersects(shape) or region.contains(shape):
        return [points]
    cuts = shapely.get_coordinates(shapely.intersection(shape, region.boundary))
    along = np.array([shape.project(shapely.Point(c)) for c in cuts], np.float64)
    if len(along) and np.linalg.norm(points[0] - points[-1]) < 0.01:
        # A closed line begins at a cut, not where its file happened to begin.
        before, *after = _cut_along(points, along.min(keepdims=True))
        points = np.concatenate((*after, before[1:])) if after else before
        along = np.mod(along - along.min(), shape.length)
    kept = [0.0]
    for s in np.unique(along.round(6)).tolist():
        if s - kept[-1] >= min_length_m and shape.length - s >= min_length_m:
            kept.append(s)
    return _cut_along(points, np.array(kept[1:]))


def _cut_along(points: Array, along: Array) -> list[Array]:
    """Return a line cut at distances from its start."""
    station = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    edges = np.concatenate(([0.0], along[(along > 1e-3) & (along < station[-1] - 1e-3)], [station[-1]]))
    parts = []
    for low, high in itertools.pairwise(edges):
        s = np.concatenate(([low], station[(station > low + 1e-6) & (station < high - 1e-6)], [high]))
        parts.append(np.stack([np.interp(s, station, points[:, axis]) for axis in (0, 1)], 1))
    return parts


def _densify(points: Array, step_m: float) -> Array:
    """Return the line with points at most a step apart; its own points stay."""
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    station = np.concatenate(([0.0], np.cumsum(length)))
    count = np.maximum(1, np.ceil(length / step_m)).astype(int)
    s = np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in zip(station[:-1], station[1:], count)])
    s = np.append(s, station[-1])
    return np.stack([np.interp(s, station, points[:, axis]) for axis in (0, 1)], 1)


def _split_runs(points: Array, keep: NDArray[np.bool_]) -> list[Array]:
    """Stretches of two or more points that are kept."""
    edge = np.flatnonzero(np.diff(np.concatenate(([False], keep, [False])).astype(np.int8)))
    return [points[a:b] for a, b in zip(edge[::2], edge[1::2]) if b - a >= 2]


def _outward(points: Array) -> complex:
    """Unit direction, as a complex number, in which a line leaves its first point backwards, over its first two metres."""
    away = np.linalg.norm(points - points[0], axis=1)
    far = np.flatnonzero(away >= _END_M)
    step = points[0] - points[far[0] if len(far) else -1]
    return complex(*(step / max(np.linalg.norm(step), 1e-9)))


def _ends(line: _StyledLine) -> tuple[float, ...]:
    return (*line.points[0].tolist(), *line.points[-1].tolist(), float(len(line.points)))


def _angle(step: Array) -> Array:
    return np.arctan2(step[:, 1], step[:, 0])


def _lane_polygons(lanes: Sequence[Lane]) -> NDArray[np.object_]:
    """Return the lanes' surfaces as valid polygons."""
    shapely = _shapely()
    rings = [np.concatenate((lane.left, lane.right[::-1]))[:, :2] for lane in lanes if len(lane.left) > 1]
    return shapely.make_valid(np.array([shapely.Polygon(ring) for ring in rings], object))


def _one_hot_style(name: str) -> Array:
    return np.eye(len(STYLES))[STYLES.index(name)]


__all__ = ["GroundTruthPolicy", "build_ground_truth_map", "compute_junction_region", "cut_elements"]
