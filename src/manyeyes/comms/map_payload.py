# SPDX-License-Identifier: Apache-2.0
"""Map elements to bytes and back: lines as differences of whole units, as :mod:`manyeyes.comms.wire` lays down.

Delta-coded coordinates as varints are the code of Google's encoded polylines and of Mapbox's vector tiles; a unit of 2 cm loses
less than any map model errs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.comms import primitives
from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes import WireError
from manyeyes.datatypes.map_element import CROSSING, KINDS, STYLES, MapElements, Polygons
from manyeyes.datatypes.message import LocalMap

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

UNIT_M = 0.02
MAX_RINGS = 32
"""The view and what hides parts of it."""
_MAX_UNITS = 16383
_SIGMA_M = (0.01, 20.0)
_STYLE_PROB_STEPS = 15
_HEAD_BYTES = 3


@dataclass(frozen=True, eq=False)
class ElementRows:
    """Some elements, as they stand in the packet. rings: the bytes of the view and of what hides parts of it; head: (N, 3) bytes
    of what each element is; lines: N of (n, 2) whole units.
    """

    rings: bytes
    head: NDArray[np.uint8]
    lines: tuple[Ints, ...]


def pack_element_bodies(local_map: LocalMap, capacity: int) -> list[bytes]:
    """Return bodies of whole elements, the highest score first, each with all rings; no elements are one body with rings alone.

    An element that is shorter than the unit is left out.
    """
    rings = _pack_rings([local_map.view, *(local_map.occluders.ring(i) for i in range(len(local_map.occluders)))])
    if len(rings) > capacity:
        raise WireError(
            f"The view and what hides parts of it take {len(rings)} bytes, a body {capacity}: simplify them or raise the mtu."
        )
    rows = [row for row in _pack_elements(local_map.elements) if row]
    bodies, body = [], rings
    for row in rows:
        if len(rings) + len(row) > capacity:
            raise WireError(
                f"One element takes {len(row)} bytes, a body {capacity} with {len(rings)} of its view: simplify it."
            )
        if len(body) + len(row) > capacity:
            bodies.append(body)
            body = rings
        body += row
    return [*bodies, body]


def _pack_rings(rings: Sequence[Floats]) -> bytes:
    lines = [_units(ring, True) for ring in rings]
    if len(lines) > MAX_RINGS or any(len(line) < 3 for line in lines):
        raise WireError(
            f"Message.local_map has one view and up to {MAX_RINGS - 1} occluders, rings of 3 points that are "
            f"{UNIT_M} m apart or more; got {[len(line) for line in lines]} points: leave small ones out."
        )
    return bytes([len(lines)]) + b"".join(_pack_line(line) for line in lines)


def _pack_elements(elements: MapElements) -> list[bytes]:
    """Return each element's bytes, the highest score first; none of one that is too short to be sent."""
    if not all(np.isfinite(column).all() for column in (elements.score, elements.sigma, elements.style)):
        raise WireError("Message.local_map has NaN or infinite values; drop those elements before sending.")
    likeliest = elements.style.argmax(1)
    style_prob = (
        np.rint((elements.style.max(1, initial=0.25) - 0.25) / 0.75 * _STYLE_PROB_STEPS)
        .clip(0, _STYLE_PROB_STEPS)
        .astype(np.int64)
    )
    sigma = np.bincount(elements.element_of_point, elements.sigma, len(elements)) / np.maximum(elements.counts, 1)
    head = np.stack(
        (
            elements.kind | likeliest << 2 | style_prob << 4,
            np.rint(elements.score.clip(0, 1) * 255).astype(np.int64),
            primitives.log_codes(sigma, *_SIGMA_M),
        ),
        1,
    ).astype(np.uint8)
    out = []
    for row in np.argsort(-elements.score, kind="stable").tolist():
        ring = bool(elements.closed[row])
        line = _units(elements.polyline(row), ring)
        out.append(head[row].tobytes() + _pack_line(line) if len(line) >= 2 + ring else b"")
    return out


def _units(points: Floats, ring: bool) -> Ints:
    """Return (n, 2) whole units, none as the one before it; of a ring the first is not as the last."""
    codes = np.rint(np.asarray(points, np.float64) / UNIT_M)
    if not (np.abs(codes) <= _MAX_UNITS).all():
        raise WireError(
            f"Map elements are sent within {_MAX_UNITS * UNIT_M} m of the agent; these are not: cut them first."
        )
    line = codes.astype(np.int64)
    line = line[np.concatenate(([True], (np.diff(line, axis=0) != 0).any(1)))] if len(line) else line
    return line[:-1] if ring and len(line) > 1 and (line[0] == line[-1]).all() else line


def _pack_line(line: Ints) -> bytes:
    steps = np.diff(line, axis=0, prepend=np.zeros((1, 2), np.int64)).ravel()
    return primitives.pack_varints(np.concatenate(([len(line)], steps << 1 ^ steps >> 63)))


def read_elements(body: bytes) -> ElementRows:
    """Return the rows of a body, checked; whatever is wrong is a PacketError with a reason."""
    if not body or not 1 <= body[0] <= MAX_RINGS:
        raise PacketError("garbage", f"A body of map elements begins with its rings, 1 to {MAX_RINGS}.")
    at = 1
    for _ in range(body[0]):
        _, at = _read_line(body, at, True)
    rings, head, lines = body[:at], [], []
    while at < len(body):
        kind = body[at] & 3
        line, end = _read_line(body, at + _HEAD_BYTES, kind == CROSSING)
        head.append(np.frombuffer(body, np.uint8, _HEAD_BYTES, at))
        lines.append(line)
        at = end
    return ElementRows(rings, np.array(head, np.uint8).reshape(-1, _HEAD_BYTES), tuple(lines))


def _read_line(body: bytes, at: int, ring: bool) -> tuple[Ints, int]:
    """Return a line (n, 2) of whole units from a place in a body on, and the place after it."""
    (count,), used = primitives.unpack_varints(body[at : at + 5], 1)
    min_points = 2 + ring
    # Each point takes two bytes or more: what is announced beyond that is not read, hence not made room for.
    if not min_points <= count <= (len(body) - at - used) // 2:
        raise PacketError("garbage", f"A line of {count} points does not lie in {len(body) - at} bytes.")
    first, max_bytes = at + used, 2 * int(count) * primitives.VARINT_BYTES
    values, more = primitives.unpack_varints(body[first : first + max_bytes], 2 * int(count))
    steps = (values >> 1 ^ -(values & 1)).reshape(-1, 2)
    line = steps.cumsum(0)
    again = (steps[1:] == 0).all(1).any() or (ring and bool((line[0] == line[-1]).all()))
    if again or (np.abs(line) > _MAX_UNITS).any():
        raise PacketError("implausible", "A line of the map repeats a point, or exceeds the maximum range.")
    return line, at + used + more


def merge_elements(parts: list[ElementRows]) -> LocalMap | None:
    """Return the elements of several packets of one message, in that order; None of none."""
    if not parts:
        return None
    rings, at = [], 1
    for _ in range(parts[0].rings[0]):
        ring, at = _read_line(parts[0].rings, at, True)
        rings.append(ring * UNIT_M)
    head = np.concatenate([part.head for part in parts]).astype(np.int64)
    lines = [line * UNIT_M for part in parts for line in part.lines]
    sigma = primitives.log_values(head[:, 2].astype(np.uint8), *_SIGMA_M)
    likeliest, style_prob = head[:, 0] >> 2 & 3, 0.25 + 0.75 * (head[:, 0] >> 4) / _STYLE_PROB_STEPS
    style = np.repeat((1 - style_prob)[:, None] / (len(STYLES) - 1), len(STYLES), 1)
    style[np.arange(len(head)), likeliest] = style_prob
    elements = MapElements.of(
        lines, head[:, 0] & 3, head[:, 1] / 255, np.repeat(sigma, [len(line) for line in lines]), style
    )
    return LocalMap(elements, rings[0], Polygons.of(rings[1:]))


assert len(KINDS) == len(STYLES) == 4, "two bits each"
