# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's incremental fusion of graphs (CrowdMap 2.3): elements of the map and of one observation are nodes of one graph.

The paper fuses sparse graphs "incrementally across agents and across time": nodes are elements with their points and scores,
edges their relations, overlapping elements are registered by rigid CPD onto the most plausible. It gives neither the relations
nor thresholds. Interpretation here: observations come in the order of time. Each makes a graph with the elements of the map so
far. A new element and an element of the map are one where they overlap over most of either, and where CPD brings the common
interval of one onto that of the other. The one that covers the other stays; of two that cover each other, the one of higher score.
Elements of one observation that face each other apart never become one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.baselines._common import BaselineRules, Floats, Ints, MergedElement, filter_elements, to_vector_map
from manyeyes.maps.baselines.cpd import CpdConfig, register
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.graph import ElementGraph, GraphConfig, build_element_graph
from manyeyes.maps.registry import register_map_fusion
from manyeyes.ops.polyline import cut_line, resample
from manyeyes.ops.polyline_distance import chamfer_distance


@dataclass(frozen=True)
class CrowdMapGraphConfig:
    """Configuration of the baseline.

    graph: relations of elements. min_overlap_fraction: of the length of either element, that both have in common.
    max_registered_chamfer_m: largest Chamfer distance of the common intervals after registration. num_samples: points per
    interval. cpd: of the registration. rules: pre-filter, score and state.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    min_overlap_fraction: float = 0.6
    max_registered_chamfer_m: float = 0.75
    num_samples: int = 50
    cpd: CpdConfig = field(default_factory=CpdConfig)
    rules: BaselineRules = field(default_factory=BaselineRules)


@register_map_fusion("crowdmap-graph", CrowdMapGraphConfig)
def fuse(
    observations: Sequence[Observation],
    config: CrowdMapGraphConfig = CrowdMapGraphConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Return the map after the last observation."""
    pool = filter_elements(observations, config.rules)
    bounds = pool.elements.bounds()
    # Rows of the pool that are one element of the map; the first gives its shape.
    groups: list[list[int]] = []
    for owner in range(len(pool.observations)):
        rows = pool.sort_by_plausibility(np.flatnonzero(pool.observation_of_element == owner))
        if len(rows):
            heads = np.array([g[0] for g in groups], np.int64)
            low = bounds[rows, :2].min(0) - config.graph.max_overlap_offset_m
            high = bounds[rows, 2:].max(0) + config.graph.max_overlap_offset_m
            near = np.flatnonzero((bounds[heads, :2] <= high).all(1) & (bounds[heads, 2:] >= low).all(1))
            nodes = np.concatenate((heads[near], rows))
            owners = np.where(np.arange(len(nodes)) < len(near), -1, owner)
            graph = build_element_graph(pool.elements.take(nodes), owners, config.graph)
            known = [groups[n] for n in near]
            groups = [g for n, g in enumerate(groups) if n not in near] + merge_nodes(graph, nodes, known, config)
    merged = [MergedElement(pool.elements.polyline(g[0]), int(pool.elements.kind[g[0]]), np.array(g)) for g in groups]
    return to_vector_map(pool, merged, config.rules, frame)


def merge_nodes(
    graph: ElementGraph, rows: Ints, known: Sequence[list[int]], config: CrowdMapGraphConfig
) -> list[list[int]]:
    """Merge the new nodes of a graph into the known ones, and return the groups of rows of both.

    Args:
        graph: the nodes of known elements, then new ones, the most plausible first. rows: (N,) of the nodes in the pool.
        known: the rows behind each known element.
    """
    overlaps = graph.select_relation("overlap")
    length, score = graph.nodes.lengths(), graph.nodes.score
    distinct = {(int(i), int(j)) for i, j in graph.edge[graph.cannot_link]}
    groups = [list(g) for g in known]
    joined: list[list[int]] = [[] for _ in known]
    for new in range(len(known), len(rows)):
        group = [int(rows[new])]
        edges = np.flatnonzero((overlaps.edge[:, 1] == new) & (overlaps.edge[:, 0] < len(known)))
        for edge in edges[np.argsort(np.abs(overlaps.lateral[edges]), kind="stable")].tolist():
            node = int(overlaps.edge[edge, 0])
            start_i, end_i, start_j, end_j = overlaps.interval[edge]
            covers_known = end_i - start_i >= config.min_overlap_fraction * length[node]
            covers_new = end_j - start_j >= config.min_overlap_fraction * length[new]
            is_distinct = any((other, new) in distinct for other in joined[node])
            if not groups[node] or is_distinct or not (covers_known or covers_new) or not _fits(overlaps, edge, config):
                continue
            joined[node].append(new)
            if covers_new and not (covers_known and score[new] > score[node]):
                groups[node] += group
                group = []
                break
            group += groups[node]
            groups[node] = []
        groups.append(group)
    return [g for g in groups if g]


def _fits(overlaps: ElementGraph, edge: int, config: CrowdMapGraphConfig) -> bool:
    """Return whether registration brings the common interval of the second node onto that of the first."""
    target, source = (
        _sample_interval(overlaps.nodes, int(node), overlaps.interval[edge, k : k + 2], config.num_samples)
        for node, k in zip(overlaps.edge[edge], (0, 2))
    )
    moved = register(target, source, config.cpd).apply(source)
    ends = np.array([0, config.num_samples])
    distance = chamfer_distance(moved, ends, target, ends, np.zeros((1, 2), np.int64))
    return bool(distance[0] <= config.max_registered_chamfer_m)


def _sample_interval(elements: MapElements, row: int, interval: Floats, num_samples: int) -> Floats:
    """Return (num_samples, 2) points of an element between two stations; of the whole of a ring."""
    line = elements.polyline(row)
    line = (
        np.vstack((line, line[:1])) if elements.closed[row] else cut_line(line, float(interval[0]), float(interval[1]))
    )
    return resample(line, np.array([0, len(line)]), num_samples)[0]
