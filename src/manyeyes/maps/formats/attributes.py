# SPDX-License-Identifier: Apache-2.0
"""The attributes of an element that every export format has, as columns; and geometry in degrees."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import KINDS, STYLES, MapElements
from manyeyes.maps.elements.vector_map import STATES, VectorMap
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Attributes:
    """N rows: id (hexadecimal), kind, state, style (the likeliest), numbers as in VectorMap, sigma_m the mean of its points.

    confidence: the probability that belongs to the log-odds; score: what ranks the element in an evaluation. t_first, t_last:
    ISO 8601 in UTC, to the millisecond.
    """

    id: NDArray[np.str_]
    kind: NDArray[np.str_]
    state: NDArray[np.str_]
    style: NDArray[np.str_]
    score: Floats
    confidence: Floats
    supporters: Ints
    agents: Ints
    sigma_m: Floats
    length_m: Floats
    t_first: NDArray[np.str_]
    t_last: NDArray[np.str_]

    @classmethod
    def of(cls, vector_map: VectorMap) -> Attributes:
        """Return the columns of a map, row by row with its elements."""
        e = vector_map.elements
        count = np.maximum(e.counts, 1)
        return cls(
            id=np.array(to_hex_ids(vector_map.id), dtype=np.str_).reshape(-1),
            kind=np.array(KINDS)[e.kind],
            state=np.array(STATES)[vector_map.state],
            style=np.array(STYLES)[e.style.argmax(1)] if len(e) else np.zeros(0, np.str_),
            score=np.round(e.score, 6),
            confidence=np.round(1.0 / (1.0 + np.exp(-vector_map.log_odds)), 6),
            supporters=vector_map.supporters,
            agents=vector_map.agents,
            sigma_m=np.round(np.bincount(e.element_of_point, vector_map.point_evidence.sigma, len(e)) / count, 4),
            length_m=np.round(e.lengths(), 3),
            t_first=to_iso_times(vector_map.t_first),
            t_last=to_iso_times(vector_map.t_last),
        )

    def columns(self) -> Iterator[tuple[str, NDArray]]:
        """Name and values of each column, in the order of the class."""
        for f in fields(self):
            yield f.name, getattr(self, f.name)


def to_iso_times(times_ns: Ints) -> NDArray[np.str_]:
    """Return (N,) ISO 8601 texts of nanoseconds since 1970, UTC, such as 2026-03-01T08:00:00.000Z."""
    text = np.datetime_as_string(times_ns.astype("datetime64[ns]"), unit="ms").astype(np.str_)
    return np.char.add(text, "Z")


def to_hex_ids(digests: NDArray[np.uint8]) -> list[str]:
    """Return the rows of (N, 16) bytes as hexadecimal."""
    text = np.ascontiguousarray(digests).tobytes().hex()
    return [text[k : k + 32] for k in range(0, len(text), 32)]


def to_degrees(vector_map: VectorMap) -> MapElements:
    """Return the map's elements with points as longitude, latitude (degrees, WGS 84); rings run counter-clockwise."""
    elements = orient_counter_clockwise(vector_map.elements)
    origin = (vector_map.frame.latitude, vector_map.frame.longitude)
    return elements.with_points(degrees_from_metres(elements.points, origin)[:, ::-1])


def orient_counter_clockwise(elements: MapElements) -> MapElements:
    """Return the same elements with every ring counter-clockwise, from the same first point on."""
    rings = np.flatnonzero(elements.closed)
    if not len(rings):
        return elements
    start, end, owner = elements.segments()
    a, b = elements.points[start], elements.points[end]
    area = np.bincount(owner, a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1], len(elements))
    points = elements.points.copy()
    for row in rings[area[rings] < 0].tolist():
        first, last = elements.offsets[row], elements.offsets[row + 1]
        points[first + 1 : last] = points[first + 1 : last][::-1]
    return elements.with_points(points)
