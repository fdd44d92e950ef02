# SPDX-License-Identifier: Apache-2.0
"""The length of curved dividers of a map, on arcs of known radius."""

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.curvature import is_curved, measure_curved_length


def arc(radius_m: float, length_m: float) -> np.ndarray:
    angle = np.linspace(0, length_m / radius_m, 60)
    return radius_m * np.stack((np.sin(angle), 1 - np.cos(angle)), 1)


@pytest.mark.parametrize(("radius_m", "expected"), [(40.0, 50.0), (90.0, 50.0), (120.0, 0.0), (1e6, 0.0)])
def test_arcs_below_the_radius_count_but_for_the_window_at_one_end(radius_m: float, expected: float) -> None:
    line = MapElements.of([arc(radius_m, 60.0)], DIVIDER)
    assert measure_curved_length(line) == pytest.approx(expected, abs=1.5)
    assert is_curved(line) is (expected > 0)


def test_rings_boundaries_and_short_lines_do_not_count() -> None:
    ring = [[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]]
    elements = MapElements.of([ring, arc(20.0, 8.0), arc(20.0, 30.0)], [CROSSING, DIVIDER, BOUNDARY])
    assert measure_curved_length(elements) == 0.0
    assert measure_curved_length(MapElements.empty()) == 0.0


def test_lengths_of_several_lines_add_up() -> None:
    one = MapElements.of([arc(50.0, 40.0)], DIVIDER)
    two = MapElements.of([arc(50.0, 40.0), arc(50.0, 40.0) + 30.0, [[0.0, 0.0], [50.0, 0.0]]], DIVIDER)
    assert measure_curved_length(two) == pytest.approx(2 * measure_curved_length(one))
