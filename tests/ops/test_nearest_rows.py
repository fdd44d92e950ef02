# SPDX-License-Identifier: Apache-2.0
"""The nearest points of a set: order, range, scenes and too few points."""

import torch

from manyeyes.ops.nearest_rows import nearest_rows


def test_nearest_points_come_first_and_far_ones_not_at_all() -> None:
    """Points at 1, 3, 2 and 9 m of the origin, within 5 m; the other position has none."""
    points = torch.tensor([[1.0, 0.0], [0.0, 3.0], [-2.0, 0.0], [9.0, 0.0]])
    where = torch.tensor([[0.0, 0.0], [0.0, -40.0]])
    scene = torch.zeros(4, dtype=torch.int64)
    assert nearest_rows(where, scene[:2], points, scene, 2, 5.0).tolist() == [[0, 2], [-1, -1]]
    assert nearest_rows(where, scene[:2], points, scene, 6, 5.0).tolist() == [[0, 2, 1, -1, -1, -1], [-1] * 6]


def test_many_positions_are_worked_off_in_chunks() -> None:
    g = torch.Generator().manual_seed(0)
    where, points = 20 * torch.rand(1100, 2, generator=g), 20 * torch.rand(300, 2, generator=g)
    found = nearest_rows(where, torch.zeros(1100), points, torch.zeros(300), 3, 100.0)
    distance = torch.cdist(where, points)
    assert torch.allclose(distance.gather(1, found), distance.sort(dim=1).values[:, :3])


def test_points_of_other_scenes_are_not_found() -> None:
    points, where = torch.zeros(3, 2), torch.zeros(2, 2)
    found = nearest_rows(where, torch.tensor([0, 1]), points, torch.tensor([1, 0, 1]), 2, 1.0)
    assert found.tolist() == [[1, -1], [0, 2]]
    assert nearest_rows(where[:0], torch.zeros(0), points, torch.zeros(3), 2, 1.0).shape == (0, 2)
