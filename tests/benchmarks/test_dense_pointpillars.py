# SPDX-License-Identifier: Apache-2.0
"""The dense baseline on cases worked by hand, so that the speed comparison measures the intended computation."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest
import torch

from manyeyes.datatypes import BevGrid, PointCloud

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "dense_pointpillars.py"
GRID = BevGrid(-6.4, -3.2, -3.0, 6.4, 3.2, 3.0)


@pytest.fixture(scope="module")
def dense():
    spec = importlib.util.spec_from_file_location("dense_pointpillars", PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def model(dense):
    torch.manual_seed(0)
    return dense.DensePointPillars(dense.DenseConfig(GRID, 8, (8, 16, 32), (1, 1, 1), 16))


def test_attention_of_two_agents_on_one_cell(dense):
    # Ego (1, 2), other (3, -1): <ego, ego> = 5, <ego, other> = 1, over sqrt(2).
    maps = torch.tensor([[1.0, 2.0], [3.0, -1.0]]).view(2, 2, 1, 1)
    a, b = math.exp(5 / math.sqrt(2)), math.exp(1 / math.sqrt(2))
    wanted = [(a * 1 + b * 3) / (a + b), (a * 2 - b * 1) / (a + b)]
    assert dense.attend(maps).flatten().tolist() == pytest.approx(wanted, rel=1e-6)


def test_attention_is_per_cell_and_is_the_identity_for_one_agent(dense):
    maps = torch.randn(3, 4, 5, 6, generator=torch.Generator().manual_seed(0))
    cell = dense.attend(maps[:, :, 2:3, 3:4])
    assert torch.allclose(dense.attend(maps)[:, :, 2:3, 3:4], cell, atol=1e-6)
    assert torch.allclose(dense.attend(maps[:1]), maps[:1], atol=1e-6)
    assert torch.allclose(dense.attend(maps), dense.attend(maps[[0, 2, 1]]), atol=1e-6)


def test_a_pillar_lands_on_its_cell_and_nowhere_else(model):
    # Points at x = 1.3, y = -0.7: column floor(7.7 / 0.4) = 19, row floor(2.5 / 0.4) = 6.
    cloud = PointCloud.of(torch.tensor([[1.3, -0.7, 0.5], [1.35, -0.75, 0.2]]))
    image = model.pillars([cloud]).dense()
    assert image.shape == (1, 8, 16, 32)
    assert image[0].abs().sum(0).nonzero().tolist() == [[6, 19]]


def test_maps_have_strides_two_four_eight(model):
    maps = model.extract_maps(PointCloud.of(torch.rand(200, 3, generator=torch.Generator().manual_seed(0))))
    assert [tuple(m.shape) for m in maps] == [(1, 8, 8, 16), (1, 16, 4, 8), (1, 32, 2, 4)]
    logits, boxes = model.fuse(maps)
    assert logits.shape == (1, 2, 8, 16) and boxes.shape == (1, 14, 8, 16)


def test_bytes_carry_the_maps_exactly(model):
    random = torch.Generator().manual_seed(1)
    clouds = [PointCloud.of(torch.rand(200, 3, generator=random) * 6 - 3) for _ in range(3)]
    maps = [model.extract_maps(cloud) for cloud in clouds]
    together = model.fuse([torch.cat(scale) for scale in zip(*maps)])
    found = model.perceive(maps[0], [model.share(cloud) for cloud in clouds[1:]], 256)
    best, rows = torch.sigmoid(together[0]).flatten().topk(1)
    first = sys.modules["dense_pointpillars"].decode_anchors(together[1], rows, GRID.at(2))
    assert sum(map(len, model.share(clouds[0]))) == 4 * (8 * 8 * 16 + 16 * 4 * 8 + 32 * 2 * 4)
    assert torch.allclose(found[:1], first, atol=1e-4) and 1 < len(found) < 256 and float(best[0]) > 0


def test_anchors_decode_by_hand(dense):
    # Anchor 1 (yaw 90 degrees) of row 3, column 5 at stride 2: x = -6.4 + 10.5 * 0.4 = -2.2, y = -3.2 + 6.5 * 0.4 = -0.6.
    boxes = torch.zeros(1, 14, 8, 16)
    boxes[0, 7:, 3, 5] = torch.tensor([0.5, 0.0, 0.0, math.log(2), 0.0, 0.0, 0.1])
    row = torch.tensor([8 * 16 + 3 * 16 + 5])
    diagonal = math.hypot(4.5, 1.9)
    wanted = [-2.2 + 0.5 * diagonal, -0.6, 9.0, 1.9, math.pi / 2 + 0.1]
    assert dense.decode_anchors(boxes, row, GRID.at(2))[0].tolist() == pytest.approx(wanted, abs=1e-5)
