# SPDX-License-Identifier: Apache-2.0
"""Pillars' features in one pass: the numbers of a row for every point, whatever the sweeps, agents and borders."""

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, PointCloud, SparseBev
from manyeyes.ops._pillar_kernels import cloud_moments, pillar_maxima
from manyeyes.ops.voxelize import MOMENTS, pillar_moments, pillar_sites, segment_max, segment_mean

GRID = BevGrid(-4.0, -2.0, -1.0, 4.0, 2.0, 2.0)


def slow(now: list[PointCloud], before: list[PointCloud], weight: Tensor, bias: Tensor) -> SparseBev:
    clouds = [*now, *before]
    xyz = torch.cat([cloud.xyz for cloud in clouds])
    agent = torch.cat([torch.full((len(c),), i % len(now)) for i, c in enumerate(clouds)])
    age = torch.cat([torch.full((len(c),), float(i >= len(now))) for i, c in enumerate(clouds)])
    pillars = pillar_sites(xyz, agent, GRID, len(now))
    inside, row, sites = pillars.inside, pillars.row, pillars.sites
    xyz, bright = xyz[inside], torch.cat([cloud.intensity for cloud in clouds])[inside, None]
    middle = torch.cat((sites.xy, torch.full((len(sites), 1), 0.5)), 1)
    offsets = xyz - segment_mean(xyz, row, len(sites))[row], xyz - middle[row]
    inputs = torch.cat((xyz, bright, *offsets, age[inside, None]), 1)
    return SparseBev(segment_max(torch.relu(inputs @ weight.T + bias), row, len(sites)), sites)


def cloud(n: int, seed: int) -> PointCloud:
    """A third of the points lie on the borders of pillars, some out of range."""
    random = torch.Generator().manual_seed(seed)
    xyz = (torch.rand(n, 3, generator=random) - 0.5) * torch.tensor([9.0, 4.6, 4.0])
    xyz[: n // 3, :2] = (xyz[: n // 3, :2] / 0.4).round() * 0.4
    return PointCloud.of(xyz, torch.rand(n, generator=random))


@pytest.mark.parametrize("agents", (1, 3))
@pytest.mark.parametrize("sweeps", (1, 2))
@pytest.mark.parametrize("channels", (5, 32))
def test_equals_a_row_for_every_point(agents: int, sweeps: int, channels: int) -> None:
    now = [cloud(700, seed) for seed in range(agents)]
    before = [cloud(400, 9 + seed) for seed in range(agents)] if sweeps == 2 else []
    random = torch.Generator().manual_seed(1)
    weight, bias = torch.randn(channels, 11, generator=random), torch.randn(channels, generator=random)
    got, wanted = pillar_maxima(now, before, GRID, weight, bias), slow(now, before, weight, bias)
    assert torch.equal(got.sites.key, wanted.sites.key) and got.sites.batch_size == agents
    assert torch.allclose(got.features, wanted.features, atol=1e-5)
    assert float(wanted.features.max()) > 1 and bool((wanted.features == 0).any())


def test_age_separates_the_sweep_before_from_that_of_now() -> None:
    point = PointCloud.of(torch.tensor([[0.1, 0.1, 0.0]]))
    weight = torch.zeros(1, 11)
    weight[0, 10] = 3.0
    assert pillar_maxima([point], [], GRID, weight, torch.zeros(1)).features.tolist() == [[0.0]]
    assert pillar_maxima([point], [point], GRID, weight, torch.zeros(1)).features.tolist() == [[3.0]]


def test_no_points_in_range_no_pillars() -> None:
    far = PointCloud.of(torch.tensor([[100.0, 0.0, 0.0], [0.0, 0.0, 5.0]]))
    for clouds in ([far], [PointCloud.of(torch.zeros(0, 3))] * 2):
        out = pillar_maxima(clouds, [], GRID, torch.ones(4, 11), torch.ones(4))
        assert out.features.shape == (0, 4) and out.sites.batch_size == len(clouds)


@pytest.mark.parametrize("agents", (1, 3))
@pytest.mark.parametrize("sweeps", (1, 2))
def test_moments_of_clouds_equal_those_of_points_in_range(agents: int, sweeps: int) -> None:
    now = [cloud(700, seed) for seed in range(agents)]
    before = [cloud(400, 9 + seed) for seed in range(agents)] if sweeps == 2 else []
    clouds = [*now, *before]
    xyz, bright = (torch.cat([getattr(c, name) for c in clouds]) for name in ("xyz", "intensity"))
    agent = torch.cat([torch.full((len(c),), i % agents) for i, c in enumerate(clouds)])
    pillars = pillar_sites(xyz, agent, GRID, agents)
    is_old = (torch.arange(len(xyz)) >= sum(map(len, now)))[pillars.inside]
    xyz, bright = xyz[pillars.inside], bright[pillars.inside]
    parts = (~is_old, is_old)[:sweeps]
    wanted = torch.cat([pillar_moments(xyz[s], bright[s], pillars.row[s], pillars.sites) for s in parts], 1)
    got = cloud_moments(now, before, GRID, sweeps)
    assert torch.equal(got.sites.key, pillars.sites.key) and got.sites.batch_size == agents
    assert got.features.shape == (len(pillars.sites), sweeps * len(MOMENTS)) and not got.features.requires_grad
    assert torch.allclose(got.features, wanted, rtol=1e-5, atol=1e-5)
    if sweeps == 2:
        only_now = (wanted[:, 12] == 0).nonzero()[:, 0]
        assert len(only_now) and not got.features[only_now, 12:].any()


def test_moments_of_no_points() -> None:
    far = PointCloud.of(torch.tensor([[100.0, 0.0, 0.0]]))
    assert cloud_moments([far, far], [], GRID, 2).features.shape == (0, 24)
