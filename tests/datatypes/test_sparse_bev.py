# SPDX-License-Identifier: Apache-2.0
"""Occupied cells: which keys are some, and where the cells lie."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, ShapeError, Sites

GRID = BevGrid(-10.3, -6.4, -3.0, 12.1, 6.4, 1.0)


@pytest.mark.parametrize("stride", [1, 2, 8])
def test_places_are_those_of_the_grid_to_the_last_digit(stride: int) -> None:
    grid = GRID.at(stride)
    rows, columns = grid.shape
    random = torch.Generator().manual_seed(stride)
    for share in (1.0, 0.2, 0.0):
        key = (torch.rand(3 * rows * columns, generator=random) < share).nonzero()[:, 0]
        sites = Sites(key, grid, 3)
        assert torch.equal(sites.xy, grid.centers(sites.yx))


@pytest.mark.parametrize("keys", [[-1, 3], [3, 3], [4, 3], [0, 3584]])
def test_keys_that_are_no_sites_are_refused(keys: list[int]) -> None:
    assert GRID.shape == (32, 56)
    with pytest.raises(ShapeError, match="strictly ascending and inside the grid"):
        Sites(torch.tensor(keys), GRID, 2)


def test_the_first_and_the_last_cell_are_sites_and_so_is_none() -> None:
    assert len(Sites(torch.tensor([0, 3583]), GRID, 2)) == 2
    assert len(Sites(torch.zeros(0, dtype=torch.int64), GRID, 2)) == 0
