# SPDX-License-Identifier: Apache-2.0
"""Targets of the map head: every element as equally spaced points, in every equivalent point order.

Source: MapTR (ICLR 2023), permutation-equivalent modelling: a line has two directions; a ring has any start point and
two directions.
The points of a ring are equally spaced without repetition, so that each order is an exact permutation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.models.maps.head import is_ring
from manyeyes.ops.polyline import resample, resample_spaced

MIN_OBSERVED_FRACTION = 0.3
"""Minimum observed fraction of an element's length for it to be a target."""


@dataclass(frozen=True, eq=False)
class MapTarget:
    """G elements of one tile. kind: (G,) int64, index into the head's kinds; ring: (G,) bool.

    orders: (G, 2 P, P, 2), the same P points in 2 P orders, as fractions of the tile. A ring has all shifts in both
    directions; a line
    repeats its two directions, which changes no minimum.
    """

    kind: Tensor
    ring: Tensor
    orders: Tensor

    def __len__(self) -> int:
        return self.kind.shape[0]

    def to(self, device: torch.device) -> MapTarget:
        """Return the same elements on a device."""
        return MapTarget(*(column.to(device) for column in vars(self).values()))

    def repeat(self, times: int) -> MapTarget:
        """Repeat every element, for one-to-many matching."""
        return MapTarget(*(column.repeat(times, *(1,) * (column.dim() - 1)) for column in vars(self).values()))


def make_map_target(truth: MapElements, tile: BevGrid, kinds: Sequence[str], points: int) -> MapTarget:
    """Make targets with this number of points from the elements of these kinds, in the tile's frame and within it."""
    shares, kind, ring = [], [], []
    size = np.array([tile.x_max - tile.x_min, tile.y_max - tile.y_min])
    for row in range(len(truth)):
        name = KINDS[int(truth.kind[row])]
        if name in kinds:
            line = resample_evenly(truth.polyline(row), points, is_ring(name))
            shares.append((line - [tile.x_min, tile.y_min]) / size)
            kind.append(list(kinds).index(name))
            ring.append(is_ring(name))
    places = torch.from_numpy(np.array(shares).reshape(-1, points, 2)).float()
    rings = torch.tensor(ring, dtype=torch.bool, device="cpu")
    return MapTarget(torch.tensor(kind, dtype=torch.int64, device="cpu"), rings, enumerate_orders(places, rings))


def select_observed(truth: MapElements, seen: Tensor, tile: BevGrid) -> MapElements:
    """Select the elements with at least MIN_OBSERVED_FRACTION of their length in observed cells (rows, columns), on the CPU."""
    if not len(truth):
        return truth
    points, first = resample_spaced(truth.points, truth.offsets, tile.cell_size_m / 2)
    cell = np.floor((points - [tile.x_min, tile.y_min]) / tile.cell_size_m).astype(np.int64)
    cell = cell.clip(0, [tile.shape[1] - 1, tile.shape[0] - 1])
    share = np.add.reduceat(seen.numpy()[cell[:, 1], cell[:, 0]].astype(np.float64), first[:-1]) / np.diff(first)
    return truth.take(share >= MIN_OBSERVED_FRACTION)


def resample_evenly(line: NDArray[np.float64], points: int, ring: bool) -> NDArray[np.float64]:
    """Resample to (points, 2) at equal arc length: a line with both ends; a ring from its lexicographically first
    vertex.
    """
    if ring:
        line = np.roll(line, -int(np.lexsort(line.T[::-1])[0]), axis=0)
        line = np.concatenate((line, line[:1]))
    count = points + ring
    return resample(line, np.array([0, len(line)]), np.array([count]))[0][:points]


def enumerate_orders(points: Tensor, ring: Tensor) -> Tensor:
    """Enumerate the equivalent orders of points (G, P, 2): (G, 2 P, P, 2); see MapTarget."""
    count = points.shape[1]
    place = torch.arange(count, device=points.device)
    shifts = (place[:, None] + place) % count
    shifts = torch.cat((shifts, shifts.flip(1)))
    ways = torch.stack((place, place.flip(0))).repeat(count, 1)
    return torch.where(ring[:, None, None, None], points[:, shifts], points[:, ways])
