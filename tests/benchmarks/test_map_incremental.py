# SPDX-License-Identifier: Apache-2.0
"""The benchmark that compares incremental and batch maps measures distances of lines of one kind."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap

FILE = Path(__file__).parents[2] / "benchmarks" / "map_incremental.py"


def test_distances_are_to_published_lines_of_the_same_kind() -> None:
    spec = importlib.util.spec_from_file_location("map_incremental", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    one = VectorMap.of(
        MapElements.of([[[0.0, 0.0], [10.0, 0.0]], [[0.0, 5.0], [10.0, 5.0]]], [DIVIDER, BOUNDARY]), MapFrame()
    )
    other = VectorMap.of(
        MapElements.of(
            [[[0.0, 0.02], [10.0, 0.02]], [[0.0, 5.1], [10.0, 5.1]], [[0.0, 5.0], [10.0, 5.0]]],
            [DIVIDER, BOUNDARY, DIVIDER],
        ),
        MapFrame(),
    )
    found = module.measure_distances(one, other)
    half = len(found) // 2
    assert len(found) >= 20
    np.testing.assert_allclose(found[:half], 0.02, atol=1e-9)
    np.testing.assert_allclose(found[half:], 0.1, atol=1e-9)
    alone = module.measure_distances(
        one, VectorMap.of(MapElements.of([[[0.0, 0.0], [10.0, 0.0]]], [DIVIDER]), MapFrame())
    )
    assert alone[half:].tolist() == pytest.approx([module.MAX_DISTANCE_M] * (len(found) - half))
