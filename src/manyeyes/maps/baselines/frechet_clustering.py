# SPDX-License-Identifier: Apache-2.0
"""Clusters by Frechet distance: lines of one kind that follow each other from end to end become one.

The paper names "FDC" and cites a review of distances (Besse et al., IEEE T-ITS 17(11), 2016) that has no such algorithm; this is
the reading of specs/maps.md section 4. Distances are discrete Frechet on equally spaced samples, the lesser of both directions
(rings: from the sample nearest to the other's first). Clusters join by single, average or complete linkage up to ``gate_m``; what
comes out is the cluster's medoid, or the mean of its samples brought into one direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import Floats, Ints, Merged, Pool, Rules, as_map, pool
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.roads.lane_links import components
from manyeyes.ops.polyline import near_pairs, resample
from manyeyes.ops.polyline_distance import frechet


@dataclass(frozen=True)
class Config:
    """gate_m: greatest distance that joins. samples: points a line. linkage: how clusters measure. take: what a cluster becomes.

    rules: pre-filter, score and state.
    """

    gate_m: float = 1.75
    samples: int = 20
    linkage: Literal["single", "average", "complete"] = "average"
    take: Literal["mean", "medoid"] = "mean"
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        if self.linkage not in ("single", "average", "complete") or self.take not in ("mean", "medoid"):
            raise ConfigError(
                "frechet_clustering.Config: expected linkage single, average or complete and take mean or medoid; "
                f"got {self.linkage!r} and {self.take!r}. Choose of those."
            )


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The map of clusters."""
    seen = pool(observations, config.rules)
    line = _samples(seen, config.samples)
    # A Frechet distance is never below the gap between two boxes along an axis; means may hold distances beyond the gate.
    pairs = near_pairs(seen.elements.bounds(), 2 * config.gate_m)
    pairs = pairs[seen.elements.kind[pairs[:, 0]] == seen.elements.kind[pairs[:, 1]]]
    gap = distances(line, pairs, seen.elements.kind == CROSSING)
    close = gap <= config.gate_m
    label = components(len(line), pairs[close])
    if config.linkage != "single":
        label = _linked(label, pairs, gap, config)
    merged = []
    for rows, inner in _members(label, pairs):
        kind = int(seen.elements.kind[rows[0]])
        best = _medoid(rows, pairs[inner], gap[inner])
        if config.take == "medoid" or len(rows) == 1:
            shape = seen.elements.polyline(best)
        else:
            shape = np.mean([_brought(line[k], line[best], kind == CROSSING) for k in rows], axis=0)
        merged.append(Merged(shape, kind, rows))
    return as_map(seen, merged, config.rules, frame)


def distances(line: Floats, pairs: Ints, ring: np.ndarray) -> Floats:
    """(K,) Frechet distances of pairs of sampled lines (N, S, 2); rings (N,) are turned to start beside each other."""
    count, samples = len(line), line.shape[1]
    first = np.arange(count + 1) * samples
    out = frechet(line.reshape(-1, 2), first, line.reshape(-1, 2), first, pairs)
    for k in np.flatnonzero(ring[pairs[:, 0]]).tolist():
        one, two = line[pairs[k]]
        ends = np.array([0, samples])
        # A closed walk ends where it began.
        out[k] = frechet(one, ends, _brought(two, one, True), ends, np.zeros((1, 2), np.int64), either_way=False)[0]
    return out


def _samples(of: Pool, samples: int) -> Floats:
    """(N, S, 2) equally spaced samples; a ring's stand for its corners from its first on, without the repeated one."""
    closed = of.elements.closed
    counts = np.where(closed, samples + 1, samples)
    points, first = resample(*of.lines(), counts)
    keep = np.ones(len(points), bool)
    keep[first[1:][closed] - 1] = False
    return points[keep].reshape(-1, samples, 2)


def _brought(line: Floats, onto: Floats, ring: bool) -> Floats:
    """The samples (S, 2) in the direction of another's, a ring's from the sample nearest to the other's first on."""
    if not ring:
        straight, turned = (np.square(way - onto).sum() for way in (line, line[::-1]))
        return line if straight <= turned else line[::-1]
    best = line
    for way in (line, line[::-1]):
        rolled = np.roll(way, -int(np.square(way - onto[0]).sum(1).argmin()), axis=0)
        if np.square(rolled - onto).sum() < np.square(best - onto).sum():
            best = rolled
    return best


def _members(label: Ints, pairs: Ints) -> Iterator[tuple[Ints, Ints]]:
    """For each label: its rows, ascending, and which of the pairs lie within it."""
    order = np.argsort(label, kind="stable")
    within = np.flatnonzero(label[pairs[:, 0]] == label[pairs[:, 1]])
    within = within[np.argsort(label[pairs[within, 0]], kind="stable")]
    names, start = np.unique(label[order], return_index=True)
    first, last = (np.searchsorted(label[pairs[within, 0]], names, side=side) for side in ("left", "right"))
    for k, rows in enumerate(np.split(order, start[1:]) if len(names) else []):
        yield rows, within[first[k] : last[k]]


def _linked(label: Ints, pairs: Ints, gap: Floats, config: Config) -> Ints:
    """(N,) labels after average or complete linkage within each component; what was not measured counts as twice the gate."""
    gate_m = config.gate_m
    out = label.copy()
    for rows, inner in _members(label, pairs):
        if len(rows) < 3:
            continue
        apart = np.full((len(rows), len(rows)), 2 * gate_m)
        a, b = np.searchsorted(rows, pairs[inner]).T
        apart[a, b] = apart[b, a] = np.minimum(gap[inner], 2 * gate_m)
        np.fill_diagonal(apart, np.inf)
        size = np.ones(len(rows))
        own = np.arange(len(rows))
        while True:
            i, j = np.divmod(int(apart.argmin()), len(rows))
            if not apart[i, j] <= gate_m:
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


def _medoid(rows: Ints, pairs: Ints, gap: Floats) -> int:
    """The row with the least sum of distances to its cluster; a pair that was not measured costs more than any that was."""
    most = float(gap.max()) + 1.0 if len(gap) else 0.0
    total = np.full(len(rows), most * (len(rows) - 1))
    for side in range(2):
        np.add.at(total, np.searchsorted(rows, pairs[:, side]), gap - most)
    return int(rows[total.argmin()])
