# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.ops.voxelize import MOMENTS, pillar_moments, pillar_sites, segment_max, segment_mean, segment_sum

GRID = BevGrid(-6.0, -4.0, -3.0, 6.0, 4.0, 1.0)


def cloud(n: int = 600, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Points within and around the grid, of two scenes."""
    random = torch.Generator().manual_seed(seed)
    xyz = torch.randn(n, 3, generator=random) * torch.tensor([3.0, 2.0, 1.5])
    return xyz, torch.randint(0, 2, (n,), generator=random)


def slow_pillars(xyz: Tensor, batch: Tensor, grid: BevGrid) -> list[tuple[int, int, int] | None]:
    """The scene, row and column of every point, None outside; one point at a time, in Python's doubles."""
    rows, columns = grid.shape
    found: list[tuple[int, int, int] | None] = []
    for b, (x, y, z) in zip(batch.tolist(), xyz.tolist(), strict=True):
        row, column = math.floor((y - grid.y_min) / grid.pillar), math.floor((x - grid.x_min) / grid.pillar)
        fits = 0 <= row < rows and 0 <= column < columns and grid.z_min <= z < grid.z_max
        found.append((b, row, column) if fits else None)
    return found


def test_pillars_are_those_of_a_loop_over_points():
    xyz, batch = cloud()
    pillars, wanted = pillar_sites(xyz, batch, GRID, 2), slow_pillars(xyz, batch, GRID)
    assert pillars.inside.tolist() == [w is not None for w in wanted]
    assert 0 < int(pillars.inside.sum()) < len(xyz)
    kept = [w for w in wanted if w is not None]
    cells = list(zip(pillars.sites.batch.tolist(), *pillars.sites.yx.T.tolist(), strict=True))
    assert cells == sorted(set(kept))
    assert [cells[r] for r in pillars.row.tolist()] == kept


def test_a_point_lies_in_the_pillar_whose_centre_is_nearest():
    xyz, batch = cloud(3000)
    pillars = pillar_sites(xyz, batch, GRID, 2)
    away = xyz[pillars.inside, :2] - pillars.sites.xy[pillars.row]
    assert float(away.abs().max()) <= GRID.pillar / 2 + 1e-5
    assert torch.equal(pillars.sites.yx[pillars.row], GRID.cells(xyz[pillars.inside, :2]))


def test_points_on_borders_follow_the_one_formula():
    # In float32 (x + 140.8) / 0.4 and (x + 140.8) * 2.5 disagree on such points.
    grid = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0)
    x = (torch.arange(704, dtype=torch.float64) * 0.4 - 140.8).float()
    xyz = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), 1)
    one, other = ((x + 140.8) / 0.4).floor(), ((x + 140.8) * 2.5).floor()
    assert not torch.equal(one, other)
    batch = torch.zeros(704, dtype=torch.int64)
    pillars = pillar_sites(xyz, batch, grid, 1)
    kept = [w for w in slow_pillars(xyz, batch, grid) if w is not None]
    assert [tuple(c) for c in pillars.sites.yx[pillars.row].tolist()] == [w[1:] for w in kept]
    assert len(kept) == int(pillars.inside.sum())


def test_range_is_half_open():
    xyz = torch.tensor([[-6.0, -4.0, -3.0], [6.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0], [5.99, 3.99, 0.99]])
    pillars = pillar_sites(xyz, torch.zeros(5, dtype=torch.int64), GRID, 1)
    assert pillars.inside.tolist() == [True, False, False, False, True]
    assert pillars.sites.yx.tolist() == [[0, 0], [19, 29]]


def test_only_stride_one_has_pillars():
    with pytest.raises(ConfigError, match=r"stride 4: use grid.at\(1\)"):
        pillar_sites(torch.zeros(1, 3), torch.zeros(1, dtype=torch.int64), GRID.at(4), 1)


SLOW = {
    segment_sum: lambda v: v.sum(0),
    segment_mean: lambda v: v.mean(0),
    segment_max: lambda v: v.amax(0),
}


@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
@pytest.mark.parametrize("fast", SLOW, ids=lambda f: f.__name__)
def test_segments_are_loops_in_values_and_gradients(fast, dtype):
    random = torch.Generator().manual_seed(0)
    row = torch.cat((torch.arange(20), torch.randint(0, 20, (180,), generator=random)))
    # Few distinct values, all negative: ties, and no help from a start at zero.
    values = -torch.randint(1, 5, (200, 3), generator=random).to(dtype)

    def slow(v: Tensor) -> Tensor:
        return torch.stack([SLOW[fast](v[row == r]) for r in range(20)])

    results = []
    for function in (lambda v: fast(v, row, 20), slow):
        leaf = values.clone().requires_grad_()
        out = function(leaf)
        (out * torch.linspace(0.5, 1.5, out.numel(), dtype=dtype).view_as(out)).sum().backward()
        results.append((out.detach(), leaf.grad))
    for got, wanted in zip(*results, strict=True):
        assert torch.allclose(got, wanted, rtol=1e-6)


def test_segment_maximum_gradient_by_finite_differences_and_from_a_transposed_input():
    row = torch.tensor([0, 2, 1, 1, 0, 2])
    values = torch.randn(3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: segment_max(v.T, row, 3), (values,))


def test_segment_maximum_in_half_precision_takes_the_plain_way():
    random = torch.Generator().manual_seed(0)
    row, values = torch.arange(40) % 7, torch.randn(40, 5, generator=random).bfloat16().requires_grad_()
    out = segment_max(values, row, 7)
    assert torch.equal(out.float(), segment_max(values.float(), row, 7))
    out.float().sum().backward()
    assert values.grad is not None and float(values.grad.float().sum()) == pytest.approx(35, rel=0.05)


def test_segment_maximum_does_not_hide_nan():
    values = torch.tensor([[1.0], [torch.nan], [3.0], [2.0]])
    out = segment_max(values, torch.tensor([0, 0, 0, 1]), 2)
    assert math.isnan(float(out[0, 0])) and float(out[1, 0]) == 2.0


def slow_moments(xyz: Tensor, intensity: Tensor, center: Tensor) -> list[float]:
    """The statistics of one pillar in the order of MOMENTS."""
    x, y, z = (xyz.double() - torch.cat((center.double(), torch.zeros(1, dtype=torch.float64)))).T
    dx, dy = x - x.mean(), y - y.mean()
    return [
        math.log1p(len(x)),
        float(x.mean()),
        float(y.mean()),
        float(z.mean()),
        float(z.min()),
        float(z.max()),
        float(z.std(correction=0)),
        float(x.std(correction=0)),
        float(y.std(correction=0)),
        float((dx * dy).mean()),
        float(intensity.double().mean()),
        float(intensity.max()),
    ]


def test_moments_are_those_of_each_pillar_alone():
    xyz, batch = cloud(2000)
    intensity = torch.rand(2000, generator=torch.Generator().manual_seed(1))
    pillars = pillar_sites(xyz, batch, GRID, 2)
    points, bright = xyz[pillars.inside], intensity[pillars.inside]
    got = pillar_moments(points, bright, pillars.row, pillars.sites)
    wanted = [
        slow_moments(points[pillars.row == r], bright[pillars.row == r], center)
        for r, center in enumerate(pillars.sites.xy)
    ]
    assert got.shape == (len(pillars.sites), len(MOMENTS)) and got.dtype == torch.float32
    assert torch.allclose(got.double(), torch.tensor(wanted, dtype=torch.float64), rtol=1e-5, atol=2e-6)


def test_moments_far_from_the_origin_stay_exact_and_carry_no_gradient():
    grid = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0)
    random = torch.Generator().manual_seed(0)
    xyz = torch.tensor([140.2, 38.2, -2.9]) + torch.rand(50, 3, generator=random) * 1e-2
    xyz = xyz.requires_grad_()
    pillars = pillar_sites(xyz.detach(), torch.zeros(50, dtype=torch.int64), grid, 1)
    assert len(pillars.sites) == 1
    got = pillar_moments(xyz, torch.zeros(50), pillars.row, pillars.sites)
    wanted = slow_moments(xyz.detach(), torch.zeros(50), pillars.sites.xy[0])
    assert torch.allclose(got[0].double(), torch.tensor(wanted, dtype=torch.float64), atol=2e-5)
    assert not got.requires_grad


def test_no_points_give_no_pillars():
    none = torch.zeros(0, 3)
    pillars = pillar_sites(none, torch.zeros(0, dtype=torch.int64), GRID, 2)
    assert len(pillars.sites) == 0 and pillars.row.shape == (0,)
    assert pillar_moments(none, torch.zeros(0), pillars.row, pillars.sites).shape == (0, len(MOMENTS))
    for fast in SLOW:
        values = none.clone().requires_grad_()
        fast(values, pillars.row, 0).sum().backward()
        assert values.grad is not None and values.grad.shape == (0, 3)


def test_compiled_loops_place_points_as_whole_tensors_do(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = BevGrid(-4.0, -2.0, -1.0, 4.0, 2.0, 1.0)
    random = torch.Generator().manual_seed(5)
    xyz = (torch.rand(4000, 3, generator=random) - 0.5) * torch.tensor([10.0, 5.0, 3.0])
    xyz[:2000, :2] = (xyz[:2000, :2] / 0.4).round() * 0.4
    batch = torch.arange(4000) // 2000
    ours = pillar_sites(xyz, batch, grid, 2)
    monkeypatch.setattr("manyeyes.ops.voxelize._in_numba", lambda values: False)
    theirs = pillar_sites(xyz, batch, grid, 2)
    assert 0 < int(ours.inside.sum()) < 4000
    assert torch.equal(ours.inside, theirs.inside)
    assert torch.equal(ours.sites.key, theirs.sites.key)
    assert torch.equal(ours.row, theirs.row)


@pytest.mark.parametrize("dtype", (torch.float32, torch.float64))
def test_a_mean_without_gradient_has_the_bits_of_one_with(dtype: torch.dtype) -> None:
    random = torch.Generator().manual_seed(3)
    values, row = torch.randn(500, 3, generator=random, dtype=dtype), torch.randint(0, 40, (500,), generator=random)
    plain, graph = segment_mean(values, row, 42), segment_mean(values.requires_grad_(), row, 42)
    assert graph.requires_grad and not plain.requires_grad
    assert torch.equal(plain, graph.detach())
    assert not plain[40:].any()
