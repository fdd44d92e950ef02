# SPDX-License-Identifier: Apache-2.0
"""A set of observations as arrays: sorted, without duplicates, elements sampled to points, views ready for queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, I64x1, njit
from manyeyes.datatypes.map_element import CROSSING, MapElements, freeze
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.point_grid import hash_coordinates, resample_lines

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

DAY_NS = 86_400_000_000_000


class ObservationRings(NamedTuple):
    """Polygons of O observations, in the agents' frames.

    Ring r is ``xy[ring_offsets[r]:ring_offsets[r + 1]]``; observation o has rings
    ``observation_offsets[o]:observation_offsets[o + 1]``.
    """

    xy: F64x2
    ring_offsets: I64x1
    observation_offsets: I64x1


class FieldsOfView(NamedTuple):
    """Visible areas of O observations: the polygons of their views, and the occluders that hide parts of them."""

    views: ObservationRings
    occluders: ObservationRings


@dataclass(frozen=True, eq=False)
class ObservationArrays:
    """O observations, ordered by time and then by id, and the P points of their E elements, in the agents' frames.

    ids: (O,) hexadecimal. drives: (O,) names; a drive belongs to one agent. agent, time_ns, trusted: (O,).
    pose: (O, 3) prior pose; covariance: (O, 3, 3) of it.
    radius_m: (O,) from the agent to the farthest point or corner of the view.
    observation_offsets: (O + 1,) offsets of points. observation_of_point, element_of_point, kind_of_point: (P,).
    xy, tangent: (P, 2). sigma: (P,) metres. priority: (P,) of :func:`~manyeyes.maps.fusion.point_grid.hash_coordinates`.
    elements: all; observation_of_element: (E,); element_offsets: (E + 1,) offsets of points.
    agents: names, ascending; ``agent`` counts in them.
    """

    ids: tuple[str, ...]
    drives: tuple[str, ...]
    agents: tuple[str, ...]
    agent: Ints
    time_ns: Ints
    pose: Floats
    covariance: Floats
    trusted: Flags
    radius_m: Floats
    observation_offsets: Ints
    observation_of_point: Ints
    element_of_point: Ints
    kind_of_point: Ints
    xy: Floats
    tangent: Floats
    sigma: Floats
    priority: NDArray[np.uint64]
    elements: MapElements
    observation_of_element: Ints
    element_offsets: Ints
    view: ObservationRings
    occluders: ObservationRings

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def digests(self) -> NDArray[np.uint8]:
        """The ids as bytes (O, 16)."""
        return np.frombuffer(bytes.fromhex("".join(self.ids)), np.uint8).reshape(-1, 16)

    def to_world(self, pose: Floats) -> tuple[Floats, Floats]:
        """Transform points and tangents (P, 2) to the map's frame with agents at pose (O, 3)."""
        return _to_world(self.xy, self.tangent, self.observation_offsets, np.ascontiguousarray(pose))

    def view_corners_in_world(self, pose: Floats) -> Floats:
        """Transform the corners (Q, 2) of all views to the map's frame with agents at pose (O, 3)."""
        owner = np.repeat(
            np.repeat(np.arange(len(self)), np.diff(self.view.observation_offsets)), np.diff(self.view.ring_offsets)
        )
        at = pose[owner]
        c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
        x, y = self.view.xy[:, 0], self.view.xy[:, 1]
        return np.stack((c * x - s * y + at[:, 0], s * x + c * y + at[:, 1]), 1)


@njit(cache=True, nogil=True)
def _to_world(
    xy: F64x2, tangent: F64x2, offsets: I64x1, pose: F64x2
) -> tuple[F64x2, F64x2]:  # pragma: no cover - compiled
    """Transform points and tangents (P, 2) of observations, those of o from first[o] on, at pose (O, 3) to the map's frame."""
    out, turned = np.empty_like(xy), np.empty_like(tangent)
    for o in range(len(offsets) - 1):
        c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
        for p in range(offsets[o], offsets[o + 1]):
            x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
            out[p, 0], out[p, 1] = c * x - s * y + pose[o, 0], s * x + c * y + pose[o, 1]
            turned[p, 0], turned[p, 1] = c * u - s * v, s * u + c * v
    return out, turned


def to_observation_arrays(observations: Sequence[Observation], spacing_m: float) -> ObservationArrays:
    """Convert observations to arrays, independent of their order and of duplicates.

    Elements are sampled about every spacing_m. Observations are ordered by time, then id.
    """
    unique = {o.id: o for o in observations}
    chosen = sorted(unique.values(), key=lambda o: (o.time_ns, o.id))
    count = len(chosen)
    agents = tuple(sorted({o.agent for o in chosen}))
    number = {name: k for k, name in enumerate(agents)}
    elements = MapElements.cat([o.elements for o in chosen])
    owner = np.repeat(np.arange(count), [len(o.elements) for o in chosen]).astype(np.int64)
    first, xy, tangent, sigma = resample_lines(
        elements.offsets, elements.points, elements.sigma, elements.closed, spacing_m
    )
    element = np.repeat(np.arange(len(elements)), np.diff(first))
    observation = owner[element]
    view = _rings([o.view for o in chosen], np.arange(count + 1))
    occluder_rings = [o.occluders.ring(r) for o in chosen for r in range(len(o.occluders))]
    occluders = _rings(occluder_rings, np.cumsum([0, *(len(o.occluders) for o in chosen)]))
    radius = np.zeros(count)
    np.maximum.at(radius, observation, np.hypot(xy[:, 0], xy[:, 1]))
    np.maximum.at(
        radius, np.repeat(np.arange(count), np.diff(view.ring_offsets)), np.hypot(view.xy[:, 0], view.xy[:, 1])
    )
    return ObservationArrays(
        ids=tuple(o.id for o in chosen),
        drives=tuple(f"{o.agent}\n{o.pass_id}" for o in chosen),
        agents=agents,
        agent=freeze([number[o.agent] for o in chosen], np.int64),
        time_ns=freeze([o.time_ns for o in chosen], np.int64),
        pose=freeze(np.reshape([o.pose for o in chosen], (-1, 3)), np.float64),
        covariance=freeze(np.reshape([o.covariance for o in chosen], (-1, 3, 3)), np.float64),
        trusted=freeze([o.trusted for o in chosen], np.bool_),
        radius_m=radius,
        observation_offsets=np.searchsorted(observation, np.arange(count + 1)).astype(np.int64),
        observation_of_point=freeze(observation, np.int64),
        element_of_point=freeze(element, np.int64),
        kind_of_point=freeze(np.asarray(elements.kind)[element], np.int64),
        xy=freeze(xy, np.float64),
        tangent=freeze(tangent, np.float64),
        sigma=freeze(sigma, np.float64),
        priority=freeze(hash_coordinates(xy), np.uint64),
        elements=elements,
        observation_of_element=owner,
        element_offsets=first,
        view=view,
        occluders=occluders,
    )


def is_line(kind: Ints) -> Flags:
    """Return which kinds (N,) are lines; a crossing is a ring."""
    return np.asarray(kind) != CROSSING


@njit(cache=True, nogil=True)
def compute_visibility(
    x: float, y: float, o: int, view: ObservationRings, occluders: ObservationRings, margin: float
) -> float:  # pragma: no cover - compiled
    """Compute the visibility of point x, y, in its own frame, from observation o: from 0 (outside or occluded) to 1.

    It rises linearly within ``margin`` metres of the border, where a miss is less significant.
    """
    xy, ring_offsets, observation_offsets = view
    best = -1.0
    for r in range(observation_offsets[o], observation_offsets[o + 1]):
        inside, distance = _inside(x, y, xy, ring_offsets[r], ring_offsets[r + 1])
        if inside:
            best = max(best, distance)
    if best < 0.0:
        return 0.0
    xy, ring_offsets, observation_offsets = occluders
    for r in range(observation_offsets[o], observation_offsets[o + 1]):
        inside, distance = _inside(x, y, xy, ring_offsets[r], ring_offsets[r + 1])
        if inside or _occludes(x, y, xy, ring_offsets[r], ring_offsets[r + 1]):
            return 0.0
        best = min(best, distance)
    return min(1.0, best / margin)


@njit(cache=True, nogil=True)
def _inside(x: float, y: float, xy: F64x2, a: int, b: int) -> tuple[bool, float]:  # pragma: no cover - compiled
    """Return whether x, y lies in the ring of points a..b, and its distance from the border."""
    inside, nearest = False, np.inf
    j = b - 1
    for i in range(a, b):
        x0, y0, x1, y1 = xy[j, 0], xy[j, 1], xy[i, 0], xy[i, 1]
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            inside = not inside
        dx, dy = x1 - x0, y1 - y0
        norm = dx * dx + dy * dy
        t = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / norm)) if norm > 0.0 else 0.0
        ex, ey = x0 + t * dx - x, y0 + t * dy - y
        nearest = min(nearest, ex * ex + ey * ey)
        j = i
    return inside, np.sqrt(nearest)


@njit(cache=True, nogil=True)
def _occludes(x: float, y: float, xy: F64x2, a: int, b: int) -> bool:  # pragma: no cover - compiled
    """Return whether the line of sight from the origin to x, y meets an edge of the ring a..b."""
    j = b - 1
    for i in range(a, b):
        x0, y0, x1, y1 = xy[j, 0], xy[j, 1], xy[i, 0], xy[i, 1]
        if (x * y0 - y * x0) * (x * y1 - y * x1) < 0.0:
            dx, dy = x1 - x0, y1 - y0
            if (dx * (0.0 - y0) - dy * (0.0 - x0)) * (dx * (y - y0) - dy * (x - x0)) < 0.0:
                return True
        j = i
    return False


def _rings(rings: Sequence[Floats], observation_offsets: Ints | NDArray) -> ObservationRings:
    ring_offsets = np.concatenate(([0], np.cumsum([len(ring) for ring in rings], dtype=np.int64))).astype(np.int64)
    xy = np.concatenate(rings) if rings else np.zeros((0, 2))
    return ObservationRings(np.ascontiguousarray(xy), ring_offsets, np.asarray(observation_offsets, np.int64))
