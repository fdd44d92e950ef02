# SPDX-License-Identifier: Apache-2.0
"""What changed from one map to another, kind by kind, on ground that the observations of both saw.

Elements by their stable ids: kept (in both, the same geometry to 1 cm), changed (in both, another geometry), added, removed. And
independent of ids and cuts, by length: what of the new map has no line of its kind within 0.3 m in the old one, and the reverse.
A line is new only where the old map's ground was observed, and gone only where the new one's was; what lies elsewhere is counted
apart, and an element belongs where at least half of its points lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.map_discrepancy import MIN_SEGMENT_LENGTH_M, find_unmatched_segments
from manyeyes.maps.elements.vector_map import VectorMap, compute_element_digests
from manyeyes.maps.formats.reframe import move_to_frame
from manyeyes.maps.fusion.observed_ground import ObservedGround

Floats = NDArray[np.float64]
MAX_SAME_DISTANCE_M = 0.3


@dataclass(frozen=True)
class KindChange:
    """Elements by id, and metres by place, of one kind. outside_old: on ground that only the new map covers; outside_new: only
    the old one.
    """

    kind: str
    num_unchanged: int
    num_changed: int
    num_added: int
    num_removed: int
    added_length_m: float
    removed_length_m: float
    num_outside_old: int = 0
    num_outside_new: int = 0
    outside_old_length_m: float = 0.0
    outside_new_length_m: float = 0.0


@dataclass(frozen=True)
class MapChange:
    """One row a kind, and the pieces of lines that are new or gone, or outside the other map's ground (each (n, 2) metres)."""

    kinds: tuple[KindChange, ...]
    added: Sequence[Floats]
    removed: Sequence[Floats]
    outside_old: Sequence[Floats] = ()
    outside_new: Sequence[Floats] = ()


def compare_maps(
    old: VectorMap, new: VectorMap, old_ground: ObservedGround | None = None, new_ground: ObservedGround | None = None
) -> MapChange:
    """Compare the published elements of two maps, in the frame of the new one.

    Args:
        old, new: maps, of one frame or of two. old_ground, new_ground: what each covers; everything without one.
    """
    old = move_to_frame(old.select_published(), new.frame)
    new = new.select_published()
    rows, pieces = [], tuple[list[Floats], ...](([], [], [], []))
    seen_old, seen_new = (_is_on_ground(m, ground) for m, ground in ((new, old_ground), (old, new_ground)))
    before, after = _content_by_id(old), _content_by_id(new)
    for kind, name in enumerate(KINDS):
        old_content = {k: v[1] for k, v in before.items() if v[0] == kind}
        new_content = {k: v[1] for k, v in after.items() if v[0] == kind}
        both = old_content.keys() & new_content.keys()
        num_unchanged = sum(old_content[k] == new_content[k] for k in both)
        only_new, only_old = new_content.keys() - both, old_content.keys() - both
        num_added, num_removed = sum(seen_old[k] for k in only_new), sum(seen_new[k] for k in only_old)
        one, other = (m.elements.take(m.elements.kind == kind) for m in (old, new))
        added, outside_old = _split(find_unmatched_segments(other, one, MAX_SAME_DISTANCE_M), old_ground, new)
        removed, outside_new = _split(find_unmatched_segments(one, other, MAX_SAME_DISTANCE_M), new_ground, new)
        rows.append(
            KindChange(
                kind=name,
                num_unchanged=num_unchanged,
                num_changed=len(both) - num_unchanged,
                num_added=num_added,
                num_removed=num_removed,
                added_length_m=_length(added),
                removed_length_m=_length(removed),
                num_outside_old=len(only_new) - num_added,
                num_outside_new=len(only_old) - num_removed,
                outside_old_length_m=_length(outside_old),
                outside_new_length_m=_length(outside_new),
            )
        )
        for found, those in zip(pieces, (added, removed, outside_old, outside_new)):
            found += those
    return MapChange(tuple(rows), *pieces)


def _is_on_ground(vector_map: VectorMap, ground: ObservedGround | None) -> dict[bytes, bool]:
    """Return by id whether at least half of an element's points lie on the ground of the other map."""
    e = vector_map.elements
    inside = np.ones(len(e.points)) if ground is None else ground.covers(e.points, vector_map.frame).astype(np.float64)
    fraction = np.bincount(e.element_of_point, inside, len(e)) / np.maximum(e.counts, 1)
    return {vector_map.id[k].tobytes(): bool(fraction[k] >= 0.5) for k in range(len(vector_map))}


def _split(
    pieces: Sequence[Floats], ground: ObservedGround | None, vector_map: VectorMap
) -> tuple[list[Floats], list[Floats]]:
    """Split pieces of lines at the border of a ground: what lies on it, and what does not; short pieces are left out."""
    if ground is None:
        return list(pieces), []
    inside: list[Floats] = []
    outside: list[Floats] = []
    for piece in pieces:
        on = ground.covers(piece, vector_map.frame)
        edges = np.flatnonzero(np.diff(np.concatenate(([-1], on.astype(np.int64), [-1]))))
        for start, stop in pairwise(edges.tolist()):
            part = piece[start:stop]
            if len(part) > 1 and _length([part]) >= MIN_SEGMENT_LENGTH_M:
                (inside if on[start] else outside).append(part)
    return inside, outside


def _content_by_id(vector_map: VectorMap) -> dict[bytes, tuple[int, bytes]]:
    """Kind and geometry at 1 cm by id."""
    digests = compute_element_digests(vector_map.elements, np.zeros(len(vector_map), np.int64), 1.0)
    kinds = vector_map.elements.kind.tolist()
    return {vector_map.id[k].tobytes(): (kinds[k], digests[k].tobytes()) for k in range(len(vector_map))}


def _length(pieces: Sequence[Floats]) -> float:
    return float(sum(np.hypot(*np.diff(piece, axis=0).T).sum() for piece in pieces))
