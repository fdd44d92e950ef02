# SPDX-License-Identifier: Apache-2.0
"""Clusters by Frechet distance: lines of one kind that follow each other from end to end become one.

CrowdMap names this baseline "FDC" and cites a review of distances (Besse et al., IEEE T-ITS 17(11), 2016) that contains no such
algorithm; this is an interpretation. Distances are discrete Frechet on equally spaced samples, the smaller of both directions
(rings: from the sample nearest to the other's first). Clusters join by single, average or complete linkage up to
``max_frechet_m``. The result is the cluster's medoid, or the mean of its samples in one direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import (
    BaselineRules,
    ElementPool,
    Floats,
    Ints,
    MergedElement,
    filter_elements,
    to_vector_map,
)
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion
from manyeyes.maps.roads.lane_links import connected_components
from manyeyes.ops.polyline import find_near_pairs, resample
from manyeyes.ops.polyline_distance import frechet_distance


@dataclass(frozen=True)
class FrechetClusteringConfig:
    """Configuration of the baseline.

    max_frechet_m: largest distance that joins. num_samples: points per line.
    linkage: distance between clusters. representative: result of a cluster. rules: pre-filter, score and state.
    """

    max_frechet_m: float = 1.75
    num_samples: int = 20
    linkage: Literal["single", "average", "complete"] = "average"
    representative: Literal["mean", "medoid"] = "mean"
    rules: BaselineRules = field(default_factory=BaselineRules)

    def __post_init__(self) -> None:
        if self.linkage not in ("single", "average", "complete") or self.representative not in ("mean", "medoid"):
            raise ConfigError(
                "FrechetClusteringConfig: expected linkage single, average or complete and representative mean or medoid; "
                f"got {self.linkage!r} and {self.representative!r}. Choose of those."
            )


@register_map_fusion("frechet-clustering", FrechetClusteringConfig)
def fuse(
    observations: Sequence[Observation],
    config: FrechetClusteringConfig = FrechetClusteringConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Return the map of clusters."""
    element_pool = filter_elements(observations, config.rules)
    line = _sample_elements(element_pool, config.num_samples)
    # A Frechet distance is never below the gap between two boxes along an axis; means may hold distances beyond the gate.
    pairs = find_near_pairs(element_pool.elements.bounds(), 2 * config.max_frechet_m)
    pairs = pairs[element_pool.elements.kind[pairs[:, 0]] == element_pool.elements.kind[pairs[:, 1]]]
    gap = compute_frechet_distances(line, pairs, element_pool.elements.kind == CROSSING)
    close = gap <= config.max_frechet_m
    label = connected_components(len(line), pairs[close])
    if config.linkage != "single":
        label = _link_clusters(label, pairs, gap, config)
    merged = []
    for rows, inner in _iterate_clusters(label, pairs):
        kind = int(element_pool.elements.kind[rows[0]])
        best = _find_medoid(rows, pairs[inner], gap[inner])
        if config.representative == "medoid" or len(rows) == 1:
            shape = element_pool.elements.polyline(best)
        else:
            shape = np.mean([_align_direction(line[k], line[best], kind == CROSSING) for k in rows], axis=0)
        merged.append(MergedElement(shape, kind, rows))
    return to_vector_map(element_pool, merged, config.rules, frame)


def compute_frechet_distances(line: Floats, pairs: Ints, ring: np.ndarray) -> Floats:
    """Return (K,) Frechet distances of pairs of sampled lines (N, S, 2); rings (N,) are turned to start beside each other."""
    count, samples = len(line), line.shape[1]
    offsets = np.arange(count + 1) * samples
    out = frechet_distance(line.reshape(-1, 2), offsets, line.reshape(-1, 2), offsets, pairs)
    for k in np.flatnonzero(ring[pairs[:, 0]]).tolist():
        one, two = line[pairs[k]]
        ends = np.array([0, samples])
        # A closed walk ends where it began.
        out[k] = frechet_distance(
            one, ends, _align_direction(two, one, True), ends, np.zeros((1, 2), np.int64), either_way=False
        )[0]
    return out


def _sample_elements(pool: ElementPool, num_samples: int) -> Floats:
    """Return (N, S, 2) equally spaced samples; a ring's stand for its corners from its first on, without the repeated one."""
    closed = pool.elements.closed
    counts = np.where(closed, num_samples + 1, num_samples)
    points, offsets = resample(*pool.closed_lines(), counts)
    keep = np.ones(len(points), bool)
    keep[offsets[1:][closed] - 1] = False
    return points[keep].reshape(-1, num_samples, 2)


def _align_direction(line: Floats, onto: Floats, ring: bool) -> Floats:
    """Return the samples (S, 2) in the direction of another's, a ring's from the sample nearest to the other's first on."""
    if not ring:
        straight, turned = (np.square(candidate - onto).sum() for candidate in (line, line[::-1]))
        return line if straight <= turned else line[::-1]
    best = line
    for candidate in (line, line[::-1]):
        rolled = np.roll(candidate, -int(np.square(candidate - onto[0]).sum(1).argmin()), axis=0)
        if np.square(rolled - onto).sum() < np.square(best - onto).sum():
            best = rolled
    return best


def _iterate_clusters(label: Ints, pairs: Ints) -> Iterator[tuple[Ints, Ints]]:
    """For each label: its rows, ascending, and which of the pairs lie within it."""
    order = np.argsort(label, kind="stable")
    within = np.flatnonzero(label[pairs[:, 0]] == label[pairs[:, 1]])
    within = within[np.argsort(label[pairs[within, 0]], kind="stable")]
    names, start = np.unique(label[order], return_index=True)
    first, last = (np.searchsorted(label[pairs[within, 0]], names, side=side) for side in ("left", "right"))
    for k, rows in enumerate(np.split(order, start[1:]) if len(names) else []):
        yield rows, within[first[k] : last[k]]


def _link_clusters(label: Ints, pairs: Ints, gap: Floats, config: FrechetClusteringConfig) -> Ints:
    """Return (N,) labels after average or complete linkage within each component; what was not measured counts as twice the
    gate.
    """
    max_frechet_m = config.max_frechet_m
    out = label.copy()
    for rows, inner in _iterate_clusters(label, pairs):
        if len(rows) < 3:
            continue
        apart = np.full((len(rows), len(rows)), 2 * max_frechet_m)
        a, b = np.searchsorted(rows, pairs[inner]).T
        apart[a, b] = apart[b, a] = np.minimum(gap[inner], 2 * max_frechet_m)
        np.fill_diagonal(apart, np.inf)
        size = np.ones(len(rows))
        own = np.arange(len(rows))
        while True:
            i, j = np.divmod(int(apart.argmin()), len(rows))
            if not apart[i, j] <= max_frechet_m:
                break
            i, j = min(i, j), max(i, j)
            if config.linkage == "complete":
                joint = np.maximum(apart[i], apart[j])
            else:
                joint = (size[i] * apart[i] + size[j] * apart[j]) / (size[i] + size[j])
            apart[i], apart[:, i] = joint, joint
            apart[i, i] = apart[j] = apart[:, j] = np.inf
            size[i] += size[j]
            own[own == j] = i
        out[rows] = rows[own]
    return out


def _find_medoid(rows: Ints, pairs: Ints, gap: Floats) -> int:
    """Return the row with the least sum of distances to its cluster; a pair that was not measured costs more than any that
    was.
    """
    unmeasured = float(gap.max()) + 1.0 if len(gap) else 0.0
    total = np.full(len(rows), unmeasured * (len(rows) - 1))
    for side in range(2):
        np.add.at(total, np.searchsorted(rows, pairs[:, side]), gap - unmeasured)
    return int(rows[total.argmin()])
