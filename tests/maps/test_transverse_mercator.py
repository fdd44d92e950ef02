# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.maps.roads.transverse_mercator import degrees_from_metres, metres_from_degrees

ORIGIN = (49.0, 8.4)


def test_there_and_back_is_exact_to_a_micrometre():
    degrees = np.random.default_rng(0).uniform((48.0, 6.5), (50.0, 10.5), (500, 2))
    metres = metres_from_degrees(degrees[:, 0], degrees[:, 1], ORIGIN)
    back = degrees_from_metres(metres, ORIGIN)
    assert np.abs(back - degrees).max() * 111_000 < 1e-6


def test_the_meridian_quadrant_has_the_published_length():
    # WGS 84: 10 001 965.729 m from the equator to the pole.
    assert metres_from_degrees([90.0], [0.0], (0.0, 0.0))[0, 1] == pytest.approx(10_001_965.729, abs=1e-3)


def test_scale_is_one_at_the_origin_in_both_directions():
    # Radii of curvature of the ellipsoid: a step of a microradian is that many metres.
    a, f = 6378137.0, 1 / 298.257223563
    e2, phi = f * (2 - f), np.radians(ORIGIN[0])
    north = a * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5
    east = a / np.sqrt(1 - e2 * np.sin(phi) ** 2) * np.cos(phi)
    step = np.degrees(1e-6)
    moved = metres_from_degrees([ORIGIN[0] + step, ORIGIN[0]], [ORIGIN[1], ORIGIN[1] + step], ORIGIN)
    np.testing.assert_allclose(moved, [[0.0, north * 1e-6], [east * 1e-6, 0.0]], atol=2e-6)


def test_the_projection_equals_proj():
    pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed: no oracle for the projection")
    text = "+proj=tmerc +lat_0=49 +lon_0=8.4 +k_0=1 +ellps=WGS84"
    oracle = pyproj.Transformer.from_crs("EPSG:4326", text, always_xy=True)
    degrees = np.random.default_rng(1).uniform((47.0, 5.5), (51.0, 11.4), (200, 2))
    expected = np.stack(oracle.transform(degrees[:, 1], degrees[:, 0]), 1)
    np.testing.assert_allclose(metres_from_degrees(degrees[:, 0], degrees[:, 1], ORIGIN), expected, atol=1e-5)
