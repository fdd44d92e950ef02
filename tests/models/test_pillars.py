# SPDX-License-Identifier: Apache-2.0
"""Pillar nets: no caps, order does not matter, and inference equals training's formula."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, PointCloud
from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.pillars import PillarEncoder, PointPillars

GRID = BevGrid(-12.8, -12.8, -3.0, 12.8, 12.8, 5.0)


def cloud(n: int = 3000, seed: int = 0) -> PointCloud:
    random = torch.Generator().manual_seed(seed)
    xyz = torch.rand(n, 3, generator=random) * torch.tensor([30.0, 30.0, 10.0]) - torch.tensor([15.0, 15.0, 4.0])
    return PointCloud.of(xyz, torch.rand(n, generator=random))


def net(kind) -> PillarEncoder:
    torch.manual_seed(0)
    model = PillarEncoder(GRID, 16, kind)
    for norm in model.modules():
        if isinstance(norm, ActiveNorm):
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.5, 2.0)
            norm.weight.data.uniform_(-1.5, 1.5)
            norm.bias.data.normal_()
    return model.eval()


@pytest.mark.slow
def test_inference_by_one_pass_equals_the_formula_with_a_row_for_every_point():
    model = net("points")
    wanted = model([cloud()])
    with torch.no_grad():
        got = model([cloud()])
    assert wanted.features.requires_grad and not got.features.requires_grad
    assert torch.equal(got.sites.key, wanted.sites.key)
    assert torch.allclose(got.features, wanted.features, atol=1e-4) and float(got.features.max()) > 1


def test_one_pillar_by_the_definition():
    model = net("points")
    points = torch.tensor([[1.25, -0.7, 0.5], [1.5, -0.5, 1.0], [1.3, -0.6, -0.2]])
    bright = torch.tensor([0.1, 0.9, 0.4])
    with torch.no_grad():
        out = model([PointCloud.of(points, bright)])
        # Pillar column floor(14.05 / 0.4) = 35, row floor(12.1 / 0.4) = 30: centre 1.4, -0.6, and 1.0 between -3 and 5.
        centre = torch.tensor([1.4, -0.6, 1.0])
        rows = torch.cat((points, bright[:, None], points - points.mean(0), points - centre), 1)
        wanted = torch.relu(model.net.norm(model.net.linear(rows))).max(0).values
    assert out.sites.yx.tolist() == [[30, 35]]
    assert torch.allclose(out.features[0], wanted, atol=1e-5)


@pytest.mark.parametrize("kind", ("points", "moments"))
def test_order_of_points_and_neighbours_in_the_batch_do_not_matter(kind):
    model, first, second = net(kind), cloud(seed=1), cloud(seed=2)
    with torch.no_grad():
        together = model([first, second])
        shuffled = model([first[torch.randperm(len(first), generator=torch.Generator().manual_seed(3))]])
    rows = together.sites.batch == 0
    assert torch.equal(together.sites.yx[rows], shuffled.sites.yx)
    assert torch.allclose(together.features[rows], shuffled.features, atol=1e-4)


@pytest.mark.parametrize("kind", ("points", "moments"))
def test_five_thousand_points_in_one_pillar_are_all_counted(kind):
    model = net(kind)
    many = torch.full((5000, 3), 0.1) + torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    far = torch.tensor([[0.39, 0.39, 4.9]])
    with torch.no_grad():
        with_far, without = (model([PointCloud.of(c)]).features for c in (torch.cat((many, far)), many))
    assert with_far.shape == without.shape == (1, 16)
    assert not torch.allclose(with_far, without, atol=1e-3)


@pytest.mark.parametrize("kind", ("points", "moments"))
def test_no_points_no_pillars(kind):
    model = net(kind)
    for training in (False, True):
        out = model.train(training)([PointCloud.of(torch.zeros(0, 3)), PointCloud.of(torch.tensor([[99.0, 0, 0]]))])
        assert out.features.shape == (0, 16) and out.sites.batch_size == 2


def test_one_pass_serves_inference_alone(monkeypatch):
    model, taken = net("points"), []
    monkeypatch.setattr(PointPillars, "infer", lambda *arguments: taken.append(arguments) or "one pass")
    with torch.no_grad():
        assert model([cloud(20)]) == "one pass" and len(taken) == 1
        assert model.train()([cloud(20)]) != "one pass"
    assert model.eval()([cloud(20)]) != "one pass" and len(taken) == 1
