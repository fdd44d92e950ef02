# SPDX-License-Identifier: Apache-2.0
"""Which elements of two maps are the same: the fraction of points near a polyline, against shapely."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.maps.store.map_diff import _fraction_near

shapely = pytest.importorskip("shapely", reason="the 'map' extra is not installed")


@given(seed=st.integers(0, 10**6), closed=st.booleans(), radius=st.floats(0.5, 4.0))
def test_the_fraction_of_points_near_a_polyline_is_that_of_shapely(seed: int, closed: bool, radius: float) -> None:
    draw = np.random.default_rng(seed)
    line, points = draw.normal(0, 4, (draw.integers(2, 6), 2)), draw.normal(0, 5, (30, 2))
    line = np.concatenate((line, line[:1])) if closed else line
    wanted = shapely.distance(shapely.points(points), shapely.LineString(line)) <= radius
    assert _fraction_near(points, line, radius) == pytest.approx(wanted.mean())


def test_points_beside_and_beyond_a_segment_and_on_a_repeated_point() -> None:
    """Radius 1 round (0, 0)-(4, 0): beside at 1, beyond an end at 1, and just outside of both."""
    segment = np.array([[0.0, 0.0], [4.0, 0.0]])
    for point, near in (
        ((2, 1), 1),
        ((2, -1), 1),
        ((5, 0), 1),
        ((-1, 0), 1),
        ((2, 1.01), 0),
        ((5.01, 0), 0),
        ((0, 3), 0),
    ):
        assert _fraction_near(np.array([point], float), segment, 1.0) == near, point
    assert _fraction_near(np.array([[0.5, 0.5], [3.0, 0.0]]), segment[[0, 0]], 1.0) == 0.5
