# SPDX-License-Identifier: Apache-2.0
"""A fused map: elements with their evidence, state, topology and provenance, as columns."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes.datatypes import ShapeError
from manyeyes.datatypes.map_element import MapElements, check_offsets, freeze, take_rows
from manyeyes.maps.elements.observation import MapFrame

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Digests = NDArray[np.uint8]

STATES = ("candidate", "published", "deprecated", "retired")
CANDIDATE, PUBLISHED, DEPRECATED, RETIRED = range(len(STATES))


@dataclass(frozen=True, eq=False)
class PointEvidence:
    """Evidence at each point of a map, row by row with ``elements.points``.

    support: (P,) int64 observations that saw it. agents: (P,) int64 distinct agents. log_odds: (P,). sigma: (P,) metres
    across the line. t_first, t_last: (P,) int64 nanoseconds since 1970 of the first and last support.
    """

    support: Ints
    agents: Ints
    log_odds: Floats
    sigma: Floats
    t_first: Ints
    t_last: Ints

    def __post_init__(self) -> None:
        _freeze(self, {"log_odds": np.float64, "sigma": np.float64})
        for f in fields(self):
            if getattr(self, f.name).shape != self.support.shape or self.support.ndim != 1:
                raise ShapeError(
                    f"PointEvidence.{f.name} needs shape {self.support.shape}; got {getattr(self, f.name).shape}."
                )

    def __len__(self) -> int:
        return len(self.support)

    def take(self, rows: Ints) -> PointEvidence:
        """Return the chosen points, in the order given."""
        return PointEvidence(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Topology:
    """How elements of a map lie to each other, as pairs of rows.

    successor: (S, 2), the second continues the first where it ends. left: (L, 2) and right: (R, 2), the second is the
    nearest line on the left or right hand of the first, by the first's own direction. branch: (B, 2) node and element that
    ends there; branch_xy: (M, 2) metres, where each node stands.
    """

    successor: Ints
    left: Ints
    right: Ints
    branch: Ints
    branch_xy: Floats

    def __post_init__(self) -> None:
        _freeze(self, {"branch_xy": np.float64})
        for f in fields(self):
            if getattr(self, f.name).ndim != 2 or getattr(self, f.name).shape[1] != 2:
                raise ShapeError(f"Topology.{f.name} needs shape (K, 2); got {getattr(self, f.name).shape}.")

    @classmethod
    def empty(cls) -> Topology:
        """Make a topology without relations."""
        pairs = np.zeros((0, 2), np.int64)
        return cls(pairs, pairs, pairs, pairs, np.zeros((0, 2)))

    def renumber(self, new_rows: Ints) -> Topology:
        """Map row k to new_rows[k]; drop pairs with a row that becomes -1, and nodes without elements."""
        successor, left, right = (
            _drop_invalid_pairs(new_rows[pairs]) for pairs in (self.successor, self.left, self.right)
        )
        ends = _drop_invalid_pairs(np.stack((self.branch[:, 0], new_rows[self.branch[:, 1]]), 1))
        nodes, ends[:, 0] = np.unique(ends[:, 0], return_inverse=True)
        return Topology(successor, left, right, ends, self.branch_xy[nodes])


@dataclass(frozen=True, eq=False)
class VectorMap:
    """A map of N elements in one frame.

    elements: in the map's frame, lines with stations about 1 m apart. id: (N, 16) uint8, stable from release to release.
    state: (N,) int64, index into STATES. log_odds: (N,). supporters: (N,) int64 observations; agents: (N,) int64 distinct
    agents. t_first, t_last: (N,) int64 ns. point_evidence: evidence per point. topology: pairs of rows. observations: (U, 16)
    uint8 ids, ascending; element i came from ``observations[sources[source_offsets[i]:source_offsets[i + 1]]]``.
    """

    frame: MapFrame
    elements: MapElements
    id: Digests
    state: Ints
    log_odds: Floats
    supporters: Ints
    agents: Ints
    t_first: Ints
    t_last: Ints
    point_evidence: PointEvidence
    topology: Topology
    observations: Digests
    source_offsets: Ints
    sources: Ints

    def __post_init__(self) -> None:
        arrays = ("id", "observations", "log_odds", *_COUNTS, "source_offsets", "sources")
        _freeze(self, {"id": np.uint8, "observations": np.uint8, "log_odds": np.float64}, arrays)
        n = len(self.elements)
        for name in ("log_odds", *_COUNTS):
            if getattr(self, name).shape != (n,):
                raise ShapeError(f"VectorMap.{name} needs shape {(n,)}; got {getattr(self, name).shape}.")
        if self.id.shape != (n, 16) or self.observations.ndim != 2 or self.observations.shape[1] != 16:
            raise ShapeError(
                f"VectorMap needs id {(n, 16)}, observations (U, 16); got {self.id.shape}, {self.observations.shape}."
            )
        if len(self.point_evidence) != len(self.elements.points):
            raise ShapeError(
                f"VectorMap.point_evidence needs {len(self.elements.points)} rows; got {len(self.point_evidence)}."
            )
        check_offsets("VectorMap.sources", self.source_offsets, len(self.sources))
        if len(self.source_offsets) != n + 1:
            raise ShapeError(f"VectorMap.source_offsets needs shape {(n + 1,)}; got {self.source_offsets.shape}.")

    @classmethod
    def of(
        cls,
        elements: MapElements,
        frame: MapFrame | None = None,
        sources: Sequence[Sequence[str]] | None = None,
        agents: ArrayLike = 1,
        times_ns: tuple[ArrayLike, ArrayLike] = (0, 0),
        log_odds: ArrayLike = 0.0,
    ) -> VectorMap:
        """Return a published map of elements with the same evidence at all their points; sources: ids of each one's
        observations.
        """
        n = len(elements)
        sorted_sources = [sorted(set(s)) for s in sources] if sources is not None else [[] for _ in range(n)]
        observation_ids = sorted({s for one in sorted_sources for s in one})
        place = {s: k for k, s in enumerate(observation_ids)}
        counts = np.array([len(one) for one in sorted_sources], np.int64)
        t_first, t_last = (np.broadcast_to(np.asarray(t, np.int64), (n,)) for t in times_ns)
        columns = {
            "log_odds": np.broadcast_to(np.asarray(log_odds, np.float64), (n,)),
            "agents": np.broadcast_to(np.asarray(agents, np.int64), (n,)),
            "t_first": t_first,
            "t_last": t_last,
        }
        supporters = counts if sources is not None else np.ones(n, np.int64)
        at_points = {name: np.repeat(column, elements.counts) for name, column in columns.items()}
        return cls(
            frame=frame or MapFrame(),
            elements=elements,
            id=compute_content_ids(elements),
            state=np.full(n, PUBLISHED),
            supporters=supporters,
            point_evidence=PointEvidence(
                support=np.repeat(supporters, elements.counts), sigma=elements.sigma, **at_points
            ),
            topology=Topology.empty(),
            observations=np.frombuffer(bytes.fromhex("".join(observation_ids)), np.uint8).reshape(-1, 16),
            source_offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
            sources=np.array([place[s] for one in sorted_sources for s in one], np.int64),
            **columns,
        )

    @classmethod
    def empty(cls, frame: MapFrame | None = None) -> VectorMap:
        """Make a map without elements."""
        return cls.of(MapElements.empty(), frame)

    def __len__(self) -> int:
        return len(self.elements)

    def sources_of(self, i: int) -> list[str]:
        """Return the ids of the observations that element i came from, in hexadecimal."""
        rows = self.sources[self.source_offsets[i] : self.source_offsets[i + 1]]
        return [row.tobytes().hex() for row in self.observations[rows]]

    def with_state(self, state: ArrayLike) -> VectorMap:
        """Return the same map with other states (N,)."""
        return replace(self, state=np.asarray(state))

    def select_published(self) -> VectorMap:
        """Return the map of the published elements."""
        return self.take(self.state == PUBLISHED)

    def take(self, rows: ArrayLike) -> VectorMap:
        """Return the chosen elements, by index in the order given (each once) or by a mask; relations to others are left out."""
        index = np.asarray(rows)
        index = np.flatnonzero(index) if index.dtype == np.bool_ else index.astype(np.int64)
        new_rows = np.full(len(self), -1, np.int64)
        new_rows[index] = np.arange(len(index))
        _, points = take_rows(self.elements.offsets, index)
        source_offsets, places = take_rows(self.source_offsets, index)
        used, sources = np.unique(self.sources[places], return_inverse=True)
        return VectorMap(
            frame=self.frame,
            elements=self.elements.take(index),
            id=self.id[index],
            log_odds=self.log_odds[index],
            point_evidence=self.point_evidence.take(points),
            topology=self.topology.renumber(new_rows),
            observations=self.observations[used],
            source_offsets=source_offsets,
            sources=sources,
            **{name: getattr(self, name)[index] for name in _COUNTS},
        )

    @classmethod
    def cat(cls, maps: Sequence[VectorMap], frame: MapFrame | None = None) -> VectorMap:
        """Return maps of one frame as one, in order; an element that stands in two of them stands twice."""
        if not maps:
            return cls.empty(frame)
        if any(m.frame != maps[0].frame for m in maps):
            raise ShapeError("VectorMap.cat needs maps of one frame; got several: move them into one first.")
        starts = np.cumsum([0, *(len(m) for m in maps)])
        nodes = np.cumsum([0, *(len(m.topology.branch_xy) for m in maps)])
        ids = np.concatenate([m.observations for m in maps])
        digests, place = np.unique(ids, axis=0, return_inverse=True)
        seen = np.cumsum([0, *(len(m.observations) for m in maps)])
        counts = np.concatenate([np.diff(m.source_offsets) for m in maps])
        successor, left, right = (
            np.concatenate([getattr(m.topology, name) + start for m, start in zip(maps, starts)])
            for name in ("successor", "left", "right")
        )
        branch = [m.topology.branch + (node, start) for m, node, start in zip(maps, nodes, starts)]
        return cls(
            frame=maps[0].frame,
            elements=MapElements.cat([m.elements for m in maps]),
            id=np.concatenate([m.id for m in maps]),
            log_odds=np.concatenate([m.log_odds for m in maps]),
            point_evidence=PointEvidence(
                *(np.concatenate([getattr(m.point_evidence, f.name) for m in maps]) for f in fields(PointEvidence))
            ),
            topology=Topology(
                successor, left, right, np.concatenate(branch), np.concatenate([m.topology.branch_xy for m in maps])
            ),
            observations=digests,
            source_offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
            sources=np.concatenate([place.reshape(-1)[start + m.sources] for m, start in zip(maps, seen)]),
            **{name: np.concatenate([getattr(m, name) for m in maps]) for name in _COUNTS},
        )

    def quantised_hash(self, cell_cm: float = 1.0) -> str:
        """Compute BLAKE2b-128 over kind, state and geometry on a grid of cell_cm; order, direction and a ring's start have no
        effect.
        """
        return ContentSum.of(self, cell_cm).hexdigest()


@dataclass(frozen=True)
class ContentSum:
    """The sum of the digests of a map's elements modulo 2^128, and their number: sums of parts add up to that of the whole."""

    total: int = 0
    count: int = 0

    @classmethod
    def of(cls, vector_map: VectorMap, cell_cm: float = 1.0) -> ContentSum:
        """Return the sum of a map, or of a part of one."""
        digests = compute_element_digests(vector_map.elements, vector_map.state, cell_cm)
        return cls(sum(int.from_bytes(row.tobytes(), "little") for row in digests) % (1 << 128), len(digests))

    def __add__(self, other: ContentSum) -> ContentSum:
        return ContentSum((self.total + other.total) % (1 << 128), self.count + other.count)

    def hexdigest(self) -> str:
        """Return BLAKE2b-128 of both, in hexadecimal."""
        data = self.total.to_bytes(16, "little") + self.count.to_bytes(8, "little")
        return hashlib.blake2b(data, digest_size=16).hexdigest()


_COUNTS = ("state", "supporters", "agents", "t_first", "t_last")


def compute_content_ids(elements: MapElements) -> Digests:
    """Return (N, 16) an id from kind and geometry at 1 cm; equal elements get different ids by their order."""
    digests = compute_element_digests(elements, np.zeros(len(elements), np.int64), 1.0)
    _, place, counts = np.unique(digests, axis=0, return_inverse=True, return_counts=True)
    rank = np.zeros(len(elements), np.int64)
    next_rank: dict[int, int] = {}
    for row in np.flatnonzero(counts[place.reshape(-1)] > 1).tolist():
        group = int(place.reshape(-1)[row])
        rank[row] = next_rank.get(group, 0)
        next_rank[group] = int(rank[row]) + 1
    ids = digests.copy()
    for row in np.flatnonzero(rank).tolist():
        salted = digests[row].tobytes() + int(rank[row]).to_bytes(8, "little")
        ids[row] = np.frombuffer(hashlib.blake2b(salted, digest_size=16).digest(), np.uint8)
    return ids


def compute_element_digests(elements: MapElements, state: Ints, cell_cm: float) -> Digests:
    """Return (N, 16) BLAKE2b-128 of each element's kind, state and points on a grid of cm, the same for a line read backwards."""
    # Neat coordinates (0.5 cm) would sit on the edge of a cell, where the last bit decides; the odd shift moves them off it.
    cells = np.floor(elements.points * (100.0 / cell_cm) + 0.5137).astype("<i8")
    out = np.zeros((len(elements), 16), np.uint8)
    kinds, closed, offsets = elements.kind.tolist(), elements.closed.tolist(), elements.offsets.tolist()
    for i, (kind, ring, here) in enumerate(zip(kinds, closed, state.tolist())):
        line = cells[offsets[i] : offsets[i + 1]]
        if ring and len(line):
            line = _ring_from_min_point(line)
        elif len(line) and line.tolist() > line[::-1].tolist():
            line = line[::-1]
        head = kind.to_bytes(4, "little") + here.to_bytes(4, "little")
        out[i] = np.frombuffer(hashlib.blake2b(head + line.tobytes(), digest_size=16).digest(), np.uint8)
    return out


def _ring_from_min_point(ring: NDArray) -> NDArray:
    """Rotate the ring to its smallest point (x, then y), in the direction of the smaller of its two neighbours."""
    start = int(np.lexsort((ring[:, 1], ring[:, 0]))[0])
    ahead = np.roll(ring, -start, axis=0)
    back = np.roll(ahead[::-1], 1, axis=0)
    return ahead if len(ring) < 3 or tuple(ahead[1]) <= tuple(back[1]) else back


def _drop_invalid_pairs(pairs: Ints) -> Ints:
    return pairs[(pairs >= 0).all(1)]


def _freeze(value: object, dtypes: dict[str, type[np.generic]], names: Sequence[str] | None = None) -> None:
    """Make the named array fields (all, if none are named) contiguous and read-only: int64 unless dtypes names another."""
    for name in names or [f.name for f in fields(value)]:  # pyright: ignore[reportArgumentType]
        object.__setattr__(value, name, freeze(getattr(value, name), dtypes.get(name, np.int64)))
