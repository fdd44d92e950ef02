# SPDX-License-Identifier: Apache-2.0
"""Fuse many observations into one map: align poses, build stations, link them to lines, keep their evidence.

The steps are :func:`manyeyes.maps.fusion.pose_optimization.solve_poses`, :func:`manyeyes.maps.fusion.stations.build_stations`,
:func:`manyeyes.maps.fusion.block_linking.link_in_blocks` and :func:`assemble_linked`. The first three are local and may run tile by
tile. The fourth takes the linked stations of all blocks, so no line is cut at a border. The map is a pure function of the set of
observations: repetition and order have no effect, and removing an observation gives the map without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, I64x1, njit
from manyeyes.datatypes.map_element import MapElements, take_rows
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import (
    CANDIDATE,
    PUBLISHED,
    RETIRED,
    PointEvidence,
    Topology,
    VectorMap,
    compute_content_ids,
)
from manyeyes.maps.fusion.block_linking import LinkedStations, link_in_blocks
from manyeyes.maps.fusion.coverage import cut_unobserved
from manyeyes.maps.fusion.existence import EvidenceTable
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays
from manyeyes.maps.fusion.parallel_extension import ParallelExtensionConfig
from manyeyes.maps.fusion.polyline_linking import LinkConfig, smooth_chains, trace_chains
from manyeyes.maps.fusion.pose_config import PoseSolverConfig
from manyeyes.maps.fusion.pose_optimization import solve_poses
from manyeyes.maps.fusion.pose_solution import PoseSolution
from manyeyes.maps.fusion.stations import (
    Area,
    StationConfig,
    StationTable,
    build_stations,
    normalize_style,
)
from manyeyes.maps.fusion.topology import build_topology

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class MapFusionConfig:
    """Configuration of the fusion.

    pose_solver, stations, link, parallel_extension, topology: of the steps.
    min_length_m: shortest line by kind (divider, boundary, crossing, stop line).
    full_score_length_m: by kind, length from which a line's score is not lowered.
    """

    pose_solver: PoseSolverConfig = field(default_factory=PoseSolverConfig)
    stations: StationConfig = field(default_factory=StationConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    parallel_extension: ParallelExtensionConfig = field(default_factory=ParallelExtensionConfig)
    min_length_m: tuple[float, float, float, float] = (2.0, 4.0, 0.0, 2.0)
    full_score_length_m: tuple[float, float, float, float] = (20.0, 20.0, 0.0, 3.0)


def fuse(
    observations: Sequence[Observation], config: MapFusionConfig = MapFusionConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Fuse the observations into a map in their frame."""
    return fuse_at_poses(observations, solve_poses(observations, config.pose_solver), None, config, frame)


def fuse_at_poses(
    observations: Sequence[Observation],
    solution: PoseSolution,
    area: Area | None = None,
    config: MapFusionConfig = MapFusionConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Fuse the observations at given poses, from the stations in area (x0, y0, x1, y1), or everywhere."""
    arrays = to_observation_arrays(observations, config.pose_solver.spacing_m)
    return assemble_map(build_stations(arrays, solution, area, config.stations), config, frame)


def assemble_map(
    table: StationTable, config: MapFusionConfig = MapFusionConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Assemble the map from the stations of all areas; retired stations are linked separately."""
    return assemble_linked(link_in_blocks(table, config.link, config.parallel_extension), config, frame)


def assemble_linked(
    stations: LinkedStations, config: MapFusionConfig = MapFusionConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Assemble the map from the linked stations of all blocks."""
    return relate_elements(assemble_elements(stations, config, frame))


def assemble_elements(
    stations: LinkedStations, config: MapFusionConfig = MapFusionConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Assemble lines and crossings from linked stations, without relations among them."""
    table = stations.table
    is_retired = table.line_evidence.state == RETIRED
    parts = [_build_lines(stations, np.flatnonzero(chosen), config) for chosen in (~is_retired, is_retired)]
    whole = _ElementParts.cat([*parts, _build_crossings(table)])
    return _to_vector_map(whole, EvidenceTable.cat([table.line_evidence, table.ring_evidence]), frame or MapFrame())


@dataclass(frozen=True, eq=False)
class _ElementParts:
    """Elements under construction: points (P, 2), offsets (N + 1,), the evidence row of each point (P,), and whether the point
    was observed (P,) or is inferred.
    """

    points: Floats
    offsets: Ints
    evidence_row: Ints
    is_observed: NDArray[np.bool_]
    score: Floats

    @classmethod
    def cat(cls, parts: Sequence[_ElementParts]) -> _ElementParts:
        starts = np.cumsum([0, *(len(m.points) for m in parts)])
        return cls(
            np.concatenate([m.points for m in parts]),
            np.concatenate([m.offsets[:-1] + start for m, start in zip(parts, starts)] + [starts[-1:]]),
            np.concatenate([m.evidence_row for m in parts]),
            np.concatenate([m.is_observed for m in parts]),
            np.concatenate([m.score for m in parts]),
        )


def _build_lines(stations: LinkedStations, rows: Ints, config: MapFusionConfig) -> _ElementParts:
    """Build the lines of the chosen stations, to which they alone are linked."""
    table = stations.table
    line = table.line_evidence
    place = np.full(len(table) + 1, -1)
    place[rows] = np.arange(len(rows))
    offsets, members = trace_chains(place[stations.linked[rows]], line.log_odds[rows])
    members = rows[members]
    points = smooth_chains(table.xy, offsets, members, 1.0 / line.sigma**2, config.link.smoothing_sigma)
    is_inferred = ~stations.is_observed[members]
    offsets, kept_points = cut_unobserved(points, offsets, is_inferred, table.observed_cells)
    points, members = points[kept_points], members[kept_points]
    offsets, order = _canonical_order(offsets, points)
    points, members = points[order], members[order]
    length = _lengths(offsets, points)
    line_kind = line.kind[members[offsets[:-1]]] if len(members) else np.zeros(0, np.int64)
    mean = np.add.reduceat(line.log_odds[members], offsets[:-1]) / np.diff(offsets) if len(members) else np.zeros(0)
    share = np.minimum(1.0, length / np.array(config.full_score_length_m)[line_kind].clip(1e-9))
    score = share / (1.0 + np.exp(-mean / 4.0))
    stays = np.flatnonzero(length >= np.array(config.min_length_m)[line_kind])
    kept_points, places = take_rows(offsets, stays)
    members = members[places]
    return _ElementParts(points[places], kept_points, members, stations.is_observed[members], score[stays])


def _build_crossings(table: StationTable) -> _ElementParts:
    offset = len(table.line_evidence.kind)
    owner = np.repeat(np.arange(len(table.ring_offsets) - 1), np.diff(table.ring_offsets))
    is_observed = np.ones(len(owner), bool)
    return _ElementParts(
        table.ring_xy,
        table.ring_offsets,
        offset + owner,
        is_observed,
        1.0 / (1.0 + np.exp(-table.ring_evidence.log_odds / 4.0)),
    )


def _to_vector_map(parts: _ElementParts, evidence: EvidenceTable, frame: MapFrame) -> VectorMap:
    """Return elements in canonical order with the evidence of the rows behind them."""
    count = len(parts.offsets) - 1
    evidence = normalize_style(evidence)
    owner = np.repeat(np.arange(count), np.diff(parts.offsets))
    head = parts.evidence_row[parts.offsets[:-1]]
    row = parts.evidence_row
    counts = np.maximum(1, np.diff(parts.offsets))
    mean = np.bincount(owner, evidence.log_odds[row], count) / counts
    published = np.bincount(owner, (evidence.state[row] == PUBLISHED).astype(np.float64), count) / counts
    state = np.where(evidence.state[head] == RETIRED, RETIRED, np.where(published >= 0.5, PUBLISHED, CANDIDATE))
    style = np.stack(
        [np.bincount(owner, evidence.style[row, s], count) / counts for s in range(evidence.style.shape[1])], 1
    )
    elements = MapElements(
        evidence.kind[head],
        parts.offsets,
        parts.points,
        parts.score.clip(0.0, 1.0),
        evidence.sigma[row],
        style,
    )
    source_offsets, sources = _collect_sources(owner, row, count, evidence)
    stations = PointEvidence(
        *(getattr(evidence, n)[row] * parts.is_observed for n in ("support", "agents")),
        *(getattr(evidence, n)[row] for n in ("log_odds", "sigma", "t_first", "t_last")),
    )
    t_first, t_last = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(t_first, owner, evidence.t_first[row])
    np.maximum.at(t_last, owner, evidence.t_last[row])
    agents = np.zeros(count, np.int64)
    np.maximum.at(agents, owner, evidence.agents[row])
    return VectorMap(
        frame=frame,
        elements=elements,
        id=compute_content_ids(elements),
        state=state,
        log_odds=mean,
        supporters=np.diff(source_offsets),
        agents=agents,
        t_first=t_first,
        t_last=t_last,
        point_evidence=stations,
        topology=Topology.empty(),
        observations=evidence.observations,
        source_offsets=source_offsets,
        sources=sources,
    )


def relate_elements(vector_map: VectorMap) -> VectorMap:
    """Return the map with the relations among its elements that are not retired."""
    alive = np.flatnonzero(vector_map.state != RETIRED)
    return replace(vector_map, topology=build_topology(vector_map.elements.take(alive)).renumber(alive))


def _collect_sources(owner: Ints, row: Ints, count: int, evidence: EvidenceTable) -> tuple[Ints, Ints]:
    """Return offsets and observations behind each element, each once, ascending."""
    sizes = np.diff(evidence.source_offsets)[row]
    starts = evidence.source_offsets[row]
    element_rows = np.repeat(owner, sizes)
    place = (
        np.arange(int(sizes.sum())) + np.repeat(starts - np.concatenate(([0], np.cumsum(sizes)[:-1])), sizes)
        if len(row)
        else []
    )
    pairs = np.unique(
        element_rows * np.int64(len(evidence.observations) + 1) + evidence.sources[np.asarray(place, np.int64)]
    )
    element, source = np.divmod(pairs, np.int64(len(evidence.observations) + 1))
    offsets = np.concatenate(([0], np.cumsum(np.bincount(element, minlength=count)))).astype(np.int64)
    return offsets, source


def _canonical_order(offsets: Ints, points: Floats) -> tuple[Ints, Ints]:
    """Return offsets and an order of the points in which chains stand by their first point and start at their lesser end."""
    if not len(points):
        return np.zeros(1, np.int64), np.zeros(0, np.int64)
    head, tail = points[offsets[:-1]], points[offsets[1:] - 1]
    turned = (tail[:, 0] < head[:, 0]) | ((tail[:, 0] == head[:, 0]) & (tail[:, 1] < head[:, 1]))
    start = np.where(turned[:, None], tail, head)
    walk = np.lexsort((start[:, 1], start[:, 0]))
    order = _ordered_points(offsets, walk, turned)
    return np.concatenate(([0], np.cumsum(np.diff(offsets)[walk]))).astype(np.int64), order


@njit(cache=True, nogil=True)
def _ordered_points(offsets: I64x1, walk: I64x1, turned: Boolx1) -> I64x1:  # pragma: no cover - compiled
    order, n = np.empty(offsets[-1], np.int64), 0
    for c in walk:
        size = offsets[c + 1] - offsets[c]
        for i in range(size):
            order[n] = offsets[c + 1] - 1 - i if turned[c] else offsets[c] + i
            n += 1
    return order


def _lengths(offsets: Ints, points: Floats) -> Floats:
    """Return (L,) metres along each chain."""
    if len(points) == 0:
        return np.zeros(0)
    step = np.concatenate((np.hypot(*np.diff(points, axis=0).T), [0.0]))
    step[offsets[1:] - 1] = 0.0
    return np.add.reduceat(step, offsets[:-1])
