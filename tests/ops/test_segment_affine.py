# SPDX-License-Identifier: Apache-2.0
"""The pass that keeps no row for a point against the one that does."""

import pytest
import torch

from manyeyes.ops.segment_affine import affine_segment_max, affine_segment_max_reference


@pytest.mark.parametrize(("points", "segments", "inputs", "channels"), [(500, 40, 4, 16), (40, 40, 3, 1), (1, 1, 4, 7)])
def test_equals_the_slow_twin(points, segments, inputs, channels):
    random = torch.Generator().manual_seed(points)
    row = torch.cat((torch.arange(segments), torch.randint(segments, (points - segments,), generator=random)))
    x, origin, weight = (
        torch.randn(n, m, generator=random) for n, m in ((points, inputs), (segments, inputs), (channels, inputs))
    )
    got = affine_segment_max(x, origin, weight, row)
    assert torch.allclose(got, affine_segment_max_reference(x, origin, weight, row), atol=1e-5)


def test_worked_by_hand():
    # Segment 0 has the points 1 and 3 around 1, segment 1 the point -2 around 0; channels are x and -x.
    points, row = torch.tensor([[1.0], [-2.0], [3.0]]), torch.tensor([0, 1, 0])
    got = affine_segment_max(points, torch.tensor([[1.0], [0.0]]), torch.tensor([[1.0], [-1.0]]), row)
    assert got.tolist() == [[2.0, 0.0], [-2.0, 2.0]]


def test_other_types_take_the_slow_way():
    points, row = torch.tensor([[1.0], [3.0]], dtype=torch.float64), torch.tensor([0, 0])
    got = affine_segment_max(points, torch.zeros(1, 1).double(), torch.ones(1, 1).double(), row)
    assert got.dtype == torch.float64 and got.tolist() == [[3.0]]


def test_no_points_no_segments():
    empty = torch.zeros(0, 4)
    assert affine_segment_max(empty, empty, torch.ones(3, 4), torch.zeros(0, dtype=torch.int64)).shape == (0, 3)
