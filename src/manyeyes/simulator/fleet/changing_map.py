# SPDX-License-Identifier: Apache-2.0
"""A true map over time: elements that are removed, added or moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements

Indices = NDArray[np.int64]

NEVER_NS = 2**63 - 1


@dataclass(frozen=True)
class Change:
    """A change of one true element (its index in Place.truth) at a time.

    remove: it does not exist from then on. add: it did not exist before. move: it is displaced by shift_m (x, y metres).
    """

    element: int
    at_ns: int
    what: Literal["remove", "add", "move"]
    shift_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ChangingMap:
    """N versions of elements. element_name: (N,) the true element each is a version of; start_ns, end_ns: (N,) nanoseconds,
    half-open.
    """

    elements: MapElements
    element_name: Indices
    start_ns: Indices
    end_ns: Indices

    @classmethod
    def of(cls, truth: MapElements, changes: Sequence[Change] = ()) -> ChangingMap:
        """Return a truth with changes, applied in the order of time."""
        name = list(range(len(truth)))
        start_ns, end_ns = [0] * len(truth), [NEVER_NS] * len(truth)
        moved: list[MapElements] = []
        latest = list(range(len(truth)))
        for change in sorted(changes, key=lambda c: (c.at_ns, c.element)):
            if not 0 <= change.element < len(truth):
                raise ConfigError(f"Change.element: expected 0 to {len(truth) - 1}; got {change.element}.")
            now = latest[change.element]
            if change.what == "remove":
                end_ns[now] = change.at_ns
            elif change.what == "add":
                start_ns[now] = change.at_ns
            else:
                end_ns[now] = change.at_ns
                latest[change.element] = len(name)
                name.append(change.element)
                start_ns.append(change.at_ns)
                end_ns.append(NEVER_NS)
                before = (truth if now < len(truth) else moved[now - len(truth)]).take([now if now < len(truth) else 0])
                moved.append(before.transform(*change.shift_m, 0.0))
        return cls(MapElements.cat([truth, *moved]), np.array(name, np.int64), _times(start_ns), _times(end_ns))

    def rows_at(self, time_ns: int) -> Indices:
        """Return rows of the versions that exist at a time."""
        return np.flatnonzero((self.start_ns <= time_ns) & (time_ns < self.end_ns))

    def at(self, time_ns: int) -> MapElements:
        """Return the true map at a time."""
        return self.elements.take(self.rows_at(time_ns))

    @property
    def epochs(self) -> Indices:
        """(E,) times from which on the map is another, ascending, the first 0."""
        times = np.unique(np.concatenate(([0], self.start_ns, self.end_ns)))
        return times[times < NEVER_NS]


def _times(values: Sequence[int]) -> Indices:
    return np.array(values, np.int64)
