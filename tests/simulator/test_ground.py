# SPDX-License-Identifier: Apache-2.0
"""Rasters of a scene's ground on roads whose heights and paint are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.maps.formats.opendrive import read_opendrive
from manyeyes.simulator.scene.ground import (
    ASPHALT,
    CROSSING,
    GRASS,
    PAINT,
    SIDEWALK,
    _close_gaps,
    _widen,
    build_ground,
    is_multilevel,
)


def street(grade: float = 0.05, heading: float = 0.0, lift: float = 0.0, id: str = "1") -> str:
    """200 m through the origin: two lanes, a dashed centre line, a pavement on the right, a crossing at its middle."""
    x, y = -100 * math.cos(heading), -100 * math.sin(heading)
    side = '<lane id="{}" type="{}"><width sOffset="0" a="{}" b="0" c="0" d="0"/></lane>'
    corners = "".join(
        f'<cornerRoad s="{s}" t="{t}" dz="0"/>' for s, t in ((119, 3.5), (122, 3.5), (122, -3.5), (119, -3.5))
    )
    return (
        f'<road id="{id}" length="200" junction="-1"><planView><geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="200">'
        f'<line/></geometry></planView><elevationProfile><elevation s="0" a="{lift - 100 * grade}" b="{grade}" c="0" d="0"/>'
        '</elevationProfile><lanes><laneSection s="0"><left>' + side.format(1, "driving", 3.5) + "</left><center>"
        '<lane id="0" type="none"><roadMark sOffset="0" type="broken" color="white" width="0.25"/></lane></center><right>'
        + side.format(-1, "driving", 3.5)
        + side.format(-2, "sidewalk", 2.0)
        + f'</right></laneSection></lanes><objects><object id="1" type="crosswalk" s="120" t="0"><outline>{corners}</outline>'
        "</object></objects></road>"
    )


def network(*roads: str):
    return read_opendrive(f"<OpenDRIVE>{''.join(roads)}</OpenDRIVE>".encode(), "made")


def test_height_follows_the_road_and_goes_on_smoothly_beside_it():
    ground = build_ground(network(street()), (3.0, 1.0), 40.0)
    x = np.linspace(-35, 38, 50)
    np.testing.assert_allclose(ground.height_at(x, np.zeros(50)), 0.05 * x, atol=1e-5)
    beside = ground.height_at(x, np.full(50, 20.0))
    assert np.isfinite(ground.height).all()
    assert (np.diff(beside) > 0).all()
    assert abs(np.diff(ground.height, axis=0)).max() < 0.2


def test_slope_is_the_normal_of_the_grade():
    ground = build_ground(network(street(0.1)), (0.0, 0.0), 20.0)
    np.testing.assert_allclose(ground.normal_at(4.2, -0.7), np.array([-0.1, 0, 1]) / math.hypot(1, 0.1), atol=1e-5)


def test_surface_classes_where_they_belong():
    ground = build_ground(network(street()), (0.0, 0.0), 40.0)
    assert ground.surface_at([0.0, 0, 0, 0], [2.0, -2.0, -4.5, 10.0]).tolist() == [ASPHALT, ASPHALT, SIDEWALK, GRASS]
    # The centre line's dashes of 3 m begin every 9 m at x = -100: -37 … -34 is paint, -34 … -28 is a gap.
    along = ground.surface_at(np.array([-36.5, -34.5, -33.5, -28.5, -27.5]), np.zeros(5) + 0.05)
    assert along.tolist() == [PAINT, PAINT, ASPHALT, ASPHALT, PAINT]
    # Stripes of half a metre across the whole width, in the crossing's box alone.
    band = ground.surface_at(np.full(400, 20.5), np.linspace(-3.4, 3.4, 400))
    assert 0.4 < (band == CROSSING).mean() < 0.6
    assert np.count_nonzero(np.diff((band == CROSSING).astype(int))) >= 12
    rows, columns = np.nonzero(ground.surface == CROSSING)
    x = ground.x0 + (columns + 0.5) * ground.surface_cell_m
    assert (x.min(), x.max()) == (pytest.approx(19, abs=0.13), pytest.approx(22, abs=0.13))
    assert abs(ground.y0 + (rows + 0.5) * ground.surface_cell_m).max() <= 3.5


def test_paint_area_does_not_depend_on_the_road_s_direction():
    def paint(heading: float) -> int:
        ground = build_ground(network(street(0.0, heading)), (0.0, 0.0), 30.0)
        cells = np.argwhere(ground.surface == PAINT) * ground.surface_cell_m - 30.0
        return int((np.linalg.norm(cells, axis=1) < 27.0).sum())

    # Six dashes of 3 m by 0.25 m: 288 cells of an eighth of a metre.
    assert paint(0.0) == pytest.approx(288, abs=15)
    assert paint(0.6) == pytest.approx(288, abs=15)


def test_narrow_gaps_between_roads_are_paved():
    surface = np.full((40, 60), GRASS, np.uint8)
    surface[:, :20] = ASPHALT
    surface[:, 26:40] = SIDEWALK
    _close_gaps(surface, 4)
    assert (surface[8:-8, 20:26] == ASPHALT).all()
    assert (surface[:, 40:] == GRASS).all()
    assert (surface[:, 26:40] == SIDEWALK).all()


def test_widen_equals_the_slow_twin():
    mask = np.random.default_rng(3).random((23, 31)) < 0.03
    slow = np.zeros_like(mask)
    for r, c in np.argwhere(mask):
        slow[max(0, r - 3) : r + 4, max(0, c - 3) : c + 4] = True
    np.testing.assert_array_equal(_widen(mask, 3), slow)


def test_bridges_are_detected():
    flat, bridge = street(0.0), street(0.0, math.pi / 2, lift=6.0, id="2")
    both = network(flat, bridge)
    assert is_multilevel(both, (0.0, 0.0), 30.0)
    assert not is_multilevel(both, (60.0, 0.0), 30.0)
    assert not is_multilevel(network(flat, street(0.0, math.pi / 2, id="2")), (0.0, 0.0), 30.0)


def test_the_level_of_the_centre_is_taken():
    both = network(street(0.0), street(0.0, math.pi / 2, lift=6.0, id="2"))
    assert build_ground(both, (20.0, 0.0), 30.0).height_at(0.0, 0.0) == pytest.approx(0.0, abs=1e-5)
    assert build_ground(both, (0.0, 20.0), 30.0).height_at(0.0, 0.0) == pytest.approx(6.0, abs=1e-5)


def test_no_road_in_sight_is_flat_grass():
    ground = build_ground(network(street()), (0.0, 900.0), 20.0)
    assert np.ptp(ground.height) == 0
    assert (ground.surface == GRASS).all()


def test_a_wrong_size_is_refused():
    with pytest.raises(ConfigError, match="half_size_m > cell_m"):
        build_ground(network(street()), (0.0, 0.0), 0.1)
