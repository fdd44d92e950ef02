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
from manyeyes.evaluation.maps.map_discrepancy import away
from manyeyes.maps.elements.vector_map import VectorMap, element_digests

Floats = NDArray[np.float64]
SAME_WITHIN_M = 0.3


@dataclass(frozen=True)
class KindChange:
    """Elements by id, and metres by place, of one kind."""

    kind: str
    kept: int
    changed: int
    added: int
    removed: int
    new_m: float
    gone_m: float


@dataclass(frozen=True)
class MapChange:
    """One row a kind, and the pieces of lines that are new or gone (each (n, 2) metres)."""

    kinds: tuple[KindChange, ...]
    new: Sequence[Floats]
    gone: Sequence[Floats]


def map_change(old: VectorMap, new: VectorMap) -> MapChange:
    """From the published elements of one map to those of another in the same frame."""
    if old.frame != new.frame:
        raise ConfigError(
            f"Maps are compared in one frame; got {old.frame} and {new.frame}: move one into the other's."
        )
    old, new = old.published(), new.published()
    before, after = _content(old), _content(new)
    rows, fresh, lost = [], [], []
    for kind, name in enumerate(KINDS):
        was = {k: v[1] for k, v in before.items() if v[0] == kind}
        now = {k: v[1] for k, v in after.items() if v[0] == kind}
        both = was.keys() & now.keys()
        kept = sum(was[k] == now[k] for k in both)
        one, other = (m.elements.take(m.elements.kind == kind) for m in (old, new))
        pieces_new, pieces_gone = away(other, one, SAME_WITHIN_M), away(one, other, SAME_WITHIN_M)
        rows.append(
            KindChange(
                name,
                kept,
                len(both) - kept,
                len(now) - len(both),
                len(was) - len(both),
                _length(pieces_new),
                _length(pieces_gone),
            )
        )
        fresh += pieces_new
        lost += pieces_gone
    return MapChange(tuple(rows), fresh, lost)


def _content(of: VectorMap) -> dict[bytes, tuple[int, bytes]]:
    """Kind and geometry at 1 cm by id."""
    digests = element_digests(of.elements, np.zeros(len(of), np.int64), 1.0)
    kinds = of.elements.kind.tolist()
    return {of.id[k].tobytes(): (kinds[k], digests[k].tobytes()) for k in range(len(of))}


def _length(pieces: Sequence[Floats]) -> float:
    return float(sum(np.hypot(*np.diff(piece, axis=0).T).sum() for piece in pieces))
