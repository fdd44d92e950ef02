# SPDX-License-Identifier: Apache-2.0
"""What a scenario asks of a road network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from manyeyes.maps.formats.opendrive import read_opendrive
from manyeyes.simulator.scene.roads import (
    _count_arms,
    crossing_sites,
    distance_to_road,
    lane_at,
    on_road,
    roadside_points,
)

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "carla_opendrive"

STREET = b"""<OpenDRIVE><road id="1" length="200" junction="-1"><planView>
<geometry s="0" x="-100" y="0" hdg="0" length="200"><line/></geometry></planView><lanes><laneSection s="0">
<left><lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left>
<right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane>
<lane id="-2" type="sidewalk"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road></OpenDRIVE>"""


def test_distance_and_lane_under_a_point():
    network = read_opendrive(STREET, "street")
    xy = np.array([[0.0, 1.0], [0.0, -1.0], [10.0, 7.0], [10.0, -4.5]])
    np.testing.assert_allclose(distance_to_road(network, xy), [0, 0, 3, 0.5])
    assert on_road(network, xy).tolist() == [True, True, False, False]
    assert [lane and lane.lane_id for lane in lane_at(network, xy)] == [1, -1, None, None]


def test_roadside_points_face_the_road():
    network = read_opendrive(STREET, "street")
    places = roadside_points(network, (0.0, 0.0), 30.0, 1.0, 10.0)
    assert len(places) > 50
    np.testing.assert_allclose(places.setback_m, abs(places.xy[:, 1]) - 4, atol=1e-6)
    assert places.setback_m.min() >= 1.0
    assert places.setback_m.max() <= 10.0
    towards = np.where(places.xy[:, 1] > 0, -np.pi / 2, np.pi / 2)
    np.testing.assert_allclose(np.angle(np.exp(1j * (places.yaw - towards))), 0, atol=1e-6)
    beyond = roadside_points(network, (0.0, 0.0), 30.0, 1.0, 10.0, avoid_walkways=True)
    assert beyond.xy[beyond.xy[:, 1] < 0, 1].max() <= -8.0


def test_arms_are_groups_of_directions():
    degrees = np.radians
    assert _count_arms(degrees(np.array([0.0, 5, 90, 178, 182, 271, 357]))) == 4
    assert _count_arms(degrees(np.array([0.0, 90, 180]))) == 3
    assert _count_arms(degrees(np.array([10.0]))) == 1
    assert _count_arms(np.zeros(0)) == 0


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason=f"the CARLA towns are not at {SHARED}")
def test_crossings_of_town05_avoid_its_bridges():
    network = read_opendrive(SHARED / "Town05.xodr.gz")
    sites, everywhere = crossing_sites(network), crossing_sites(network, single_level=False)
    stacked = {site.junction_id for site in everywhere if site.is_multilevel}
    assert len(stacked) == 4
    assert {site.junction_id for site in sites} == {site.junction_id for site in everywhere} - stacked
    assert sum(site.num_arms == 4 for site in sites) >= 8
    for site in sites:
        for k in site.approaches:
            lane = network.lanes[k]
            assert np.linalg.norm(lane.center[-1, :2] - site.center[:2]) <= site.radius_m + 1.0
            assert np.linalg.norm(lane.center[-1] - site.center) < np.linalg.norm(lane.center[0] - site.center) + 1.0
    assert on_road(network, np.stack([site.center[:2] for site in sites])).mean() > 0.8
