# SPDX-License-Identifier: Apache-2.0
"""Features on the occupied cells of a grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from manyeyes.datatypes._site_kernels import CellLattice, are_valid_keys, compute_centers
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.grid import BevGrid


@dataclass(frozen=True, eq=False)
class Sites:
    """Which cells of a batch of grids are occupied; compared by identity.

    key: (N,) int64, strictly ascending, ``(batch * rows + row) * columns + column``. ``cache`` holds neighbour maps that
    ``ops.sparse_conv`` built for this very set: a pruned or merged set is a new object and starts with none.
    """

    key: Tensor
    grid: BevGrid
    batch_size: int = 1
    cache: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.key.dtype != torch.int64 or self.key.dim() != 1:
            raise ShapeError(f"Sites.key needs int64 (N,); got {self.key.dtype} {tuple(self.key.shape)}.")
        if self.key.numel() and not self._has_valid_keys():
            raise ShapeError("Sites.key must be strictly ascending and inside the grid; use ops.sparse_conv.coalesce.")

    def _has_valid_keys(self) -> bool:
        rows, columns = self.grid.shape
        size = self.batch_size * rows * columns
        if self.key.device.type == "cpu":
            return are_valid_keys(self.key.numpy(), size)
        # Reading keys back would wait for the device. The same code makes them there and on the CPU, where they are checked.
        return True

    def __len__(self) -> int:
        return self.key.shape[0]

    @property
    def batch(self) -> Tensor:
        """(N,) int64: which grid of the batch each site belongs to."""
        rows, columns = self.grid.shape
        return self._keep_on_device("batch", lambda: self.key.div(rows * columns, rounding_mode="floor"))

    @property
    def yx(self) -> Tensor:
        """(N, 2) int64: row and column of each site."""
        rows, columns = self.grid.shape
        within = self.key.remainder(rows * columns)
        return torch.stack((within.div(columns, rounding_mode="floor"), within.remainder(columns)), -1)

    @property
    def xy(self) -> Tensor:
        """(N, 2) float32: metric centres in the agent's frame."""
        if self.key.device.type == "cpu":
            if "xy" not in self.cache:
                grid = self.grid
                corner = float(grid.x_min), float(grid.y_min)
                lattice = CellLattice(*grid.shape, grid.stride, float(grid.pillar), *corner)
                self.cache["xy"] = compute_centers(self.key.numpy(), lattice)
            return torch.from_numpy(self.cache["xy"])
        return self._keep_on_device("xy", lambda: self.grid.centers(self.yx))

    def _keep_on_device(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """Return a tensor of the sites; off the CPU it is computed once, since launching costs more there than memory."""
        if self.key.device.type == "cpu":
            return compute()
        if name not in self.cache:
            self.cache[name] = compute()
        return self.cache[name]

    def to(self, device: torch.device) -> Sites:
        """Return the same sites on a device, without their neighbour maps if it is another one."""
        return self if self.key.device == device else Sites(self.key.to(device), self.grid, self.batch_size)


@dataclass(frozen=True, eq=False)
class SparseBev:
    """features: (N, C), one row a site, in the order of ``sites``."""

    features: Tensor
    sites: Sites

    def __post_init__(self) -> None:
        if self.features.dim() != 2 or self.features.shape[0] != len(self.sites):
            raise ShapeError(f"SparseBev needs features ({len(self.sites)}, C); got {tuple(self.features.shape)}.")

    @property
    def grid(self) -> BevGrid:
        """The lattice that the sites lie on."""
        return self.sites.grid

    def to(self, device: torch.device) -> SparseBev:
        """Return the same map on a device."""
        return self if self.features.device == device else SparseBev(self.features.to(device), self.sites.to(device))

    def with_features(self, features: Tensor) -> SparseBev:
        """Other features on the same sites: neighbour maps are shared."""
        return SparseBev(features, self.sites)

    def keep(self, mask: Tensor) -> SparseBev:
        """Return the sites where mask (N,) is true, as a new set."""
        rows = mask.nonzero()[:, 0]
        sites = Sites(self.sites.key.index_select(0, rows), self.grid, self.sites.batch_size)
        return SparseBev(self.features.index_select(0, rows), sites)

    def dense(self) -> Tensor:
        """Return (B, C, rows, columns), zero where no site is; for figures, tests and dense baselines."""
        rows, columns = self.grid.shape
        out = self.features.new_zeros(self.sites.batch_size * rows * columns, self.features.shape[1])
        out[self.sites.key] = self.features
        return out.view(self.sites.batch_size, rows, columns, -1).permute(0, 3, 1, 2)

    @classmethod
    def from_cells(cls, features: Tensor, yx: Tensor, grid: BevGrid) -> SparseBev:
        """Return one grid's cells (N, 2), each at most once, in any order."""
        rows, columns = grid.shape
        inside = (yx >= 0).all(-1) & (yx[:, 0] < rows) & (yx[:, 1] < columns)
        if not bool(inside.all()):
            raise ShapeError(f"{int((~inside).sum())} cells lie outside the grid of {rows} rows and {columns} columns.")
        key, order = (yx[:, 0] * columns + yx[:, 1]).sort()
        return cls(features[order], Sites(key, grid))
