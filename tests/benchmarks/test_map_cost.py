# SPDX-License-Identifier: Apache-2.0
"""The cost benchmark compares like with like: tiles cover the area once, and the dense model has their cells and queries."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest

from manyeyes.datatypes import BevGrid
from manyeyes.models.maps.presets import MAP_TINY

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def cost():
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("map_cost_benchmark", FOLDER / "map_cost.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FOLDER))
    return module


def test_tiles_cover_the_area_once(cost):
    tile = BevGrid(-60.0, -30.0, -5.0, 60.0, 30.0, 5.0, pillar=1.5)
    assert cost.tiles_over(120.0, 60.0, tile).tolist() == [[0.0, 0.0]]
    middles = cost.tiles_over(300.0, 300.0, tile).tolist()
    assert sorted({x for x, _ in middles}) == [-90.0, 30.0, 150.0]
    assert sorted({y for _, y in middles}) == [-120.0, -60.0, 0.0, 60.0, 120.0]
    assert len(middles) == 15


@pytest.mark.parametrize(("length", "width", "tiles"), [(120.0, 60.0, 1), (300.0, 300.0, 15)])
def test_the_dense_model_has_the_area_s_cells_and_the_tiles_queries(cost, length, width, tiles):
    config = cost.over_all(MAP_TINY, length, width, tiles)
    assert math.prod(config.tile.shape) == (length / 1.5) * (width / 1.5)
    assert config.head.num_queries == 80 * tiles


def test_poses_lie_within_the_area_and_are_the_same_again(cost):
    poses = cost.poses_over(300.0, 60.0, 20)
    assert float(poses.translation[:, 0].abs().max()) <= 150 and float(poses.translation[:, 1].abs().max()) <= 30
    assert poses.translation.tolist() == cost.poses_over(300.0, 60.0, 20).translation.tolist()
