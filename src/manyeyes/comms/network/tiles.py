# SPDX-License-Identifier: Apache-2.0
"""Tiles: squares of a lattice in the world frame that scope what agents receive on a network."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from manyeyes.datatypes import ConfigError

TILE_M = 500.0
"""Side of a tile."""
HYSTERESIS_M = 50.0
"""An agent leaves a tile when it is this far outside of it."""
_NAME = re.compile(r"g(-?\d{1,6})_(-?\d{1,6})")


class NetworkTile(NamedTuple):
    """The square from (i, j) to (i + 1, j + 1), times TILE_M, in the world frame."""

    i: int
    j: int

    @classmethod
    def at(cls, x: float, y: float) -> NetworkTile:
        """Return the tile of a position, metres."""
        return cls(math.floor(x / TILE_M), math.floor(y / TILE_M))

    @classmethod
    def of_name(cls, name: str) -> NetworkTile:
        """Return the tile of a name.

        Raises:
            ConfigError: it is no name of a tile.
        """
        found = _NAME.fullmatch(name)
        if found is None:
            raise ConfigError(f"A tile is named g<i>_<j>, such as g0_-3; got {name!r}.")
        return cls(int(found[1]), int(found[2]))

    @property
    def name(self) -> str:
        """The name in keys of a network."""
        return f"g{self.i}_{self.j}"

    def with_neighbours(self) -> frozenset[NetworkTile]:
        """Return the tile and the eight around it."""
        return frozenset(NetworkTile(self.i + di, self.j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1))

    def is_next_to(self, other: NetworkTile) -> bool:
        """Return whether another tile is this one or one of the eight around it."""
        return max(abs(self.i - other.i), abs(self.j - other.j)) <= 1

    def move_to(self, x: float, y: float) -> NetworkTile:
        """Return the tile of an agent that was in this one: another one only beyond HYSTERESIS_M."""
        outside = max(self.i * TILE_M - x, x - (self.i + 1) * TILE_M, self.j * TILE_M - y, y - (self.j + 1) * TILE_M)
        return NetworkTile.at(x, y) if outside > HYSTERESIS_M else self
