# SPDX-License-Identifier: Apache-2.0
"""What changed from one map to another, kind by kind.

Elements by their stable ids: kept (in both, the same geometry to 1 cm), changed (in both, another geometry), added, removed. And
independent of ids and cuts, by length: what of the new map has no line of its kind within 0.3 m in the old one, and the reverse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import KINDS
from manyeyes.evaluation.maps.map_discrepancy import find_unmatched_segments
from manyeyes.maps.elements.vector_map import VectorMap, compute_element_digests

Floats = NDArray[np.float64]
MAX_SAME_DISTANCE_M = 0.3


@dataclass(frozen=True)
class KindChange:
    """Elements by id, and metres by place, of one kind."""

    kind: str
    num_unchanged: int
    num_changed: int
    num_added: int
    num_removed: int
    added_length_m: float
    removed_length_m: float


@dataclass(frozen=True)
class MapChange:
    """One row a kind, and the pieces of lines that are new or gone (each (n, 2) metres)."""

    kinds: tuple[KindChange, ...]
    added: Sequence[Floats]
    removed: Sequence[Floats]


def compare_maps(old: VectorMap, new: VectorMap) -> MapChange:
    """From the published elements of one map to those of another in the same frame."""
    if old.frame != new.frame:
        raise ConfigError(
            f"Maps are compared in one frame; got {old.frame} and {new.frame}: move one into the other's."
        )
    old, new = old.select_published(), new.select_published()
    before, after = _content_by_id(old), _content_by_id(new)
    rows, added, removed = [], [], []
    for kind, name in enumerate(KINDS):
        old_content = {k: v[1] for k, v in before.items() if v[0] == kind}
        new_content = {k: v[1] for k, v in after.items() if v[0] == kind}
        both = old_content.keys() & new_content.keys()
        num_unchanged = sum(old_content[k] == new_content[k] for k in both)
        one, other = (m.elements.take(m.elements.kind == kind) for m in (old, new))
        added_pieces, removed_pieces = (
            find_unmatched_segments(other, one, MAX_SAME_DISTANCE_M),
            find_unmatched_segments(one, other, MAX_SAME_DISTANCE_M),
        )
        rows.append(
            KindChange(
                name,
                num_unchanged,
                len(both) - num_unchanged,
                len(new_content) - len(both),
                len(old_content) - len(both),
                _length(added_pieces),
                _length(removed_pieces),
            )
        )
        added += added_pieces
        removed += removed_pieces
    return MapChange(tuple(rows), added, removed)


def _content_by_id(vector_map: VectorMap) -> dict[bytes, tuple[int, bytes]]:
    """Kind and geometry at 1 cm by id."""
    digests = compute_element_digests(vector_map.elements, np.zeros(len(vector_map), np.int64), 1.0)
    kinds = vector_map.elements.kind.tolist()
    return {vector_map.id[k].tobytes(): (kinds[k], digests[k].tobytes()) for k in range(len(vector_map))}


def _length(pieces: Sequence[Floats]) -> float:
    return float(sum(np.hypot(*np.diff(piece, axis=0).T).sum() for piece in pieces))
