# SPDX-License-Identifier: Apache-2.0
"""Which looks a tile gets: the agent's own first, then a crowd's that cover more, seed by seed."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, BevGrid, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.evaluation.detection.one_instant import SingleFramePerScenario
from manyeyes.evaluation.maps.tile_sampling import (
    TileSource,
    collect_observer_poses,
    compute_coverage,
    make_local_tile,
    make_world_from_tile,
    sample_fleet_tile,
    sample_meeting,
    select_by_coverage,
)
from manyeyes.ops.keyed_random import keyed_generator

TILE = BevGrid(-60.0, -30.0, -5.0, 60.0, 30.0, 5.0, pillar=1.0)
VIEW = BevGrid(-30.0, -30.0, -2.0, 30.0, 30.0, 4.0, pillar=1.0)


AT = {"town1_0": 0.0, "town1_1": 40.0, "town1_2": 500.0, "town2_0": 0.0}


class Streets:
    """Three scenarios of one town and one of another, five frames of which the first is history; agent 0 drives, -1 stands.

    Town1: about (0, 0), (40, 0) and (500, 0); Town2 about (0, 0).
    """

    scenarios = tuple(AT)

    def length(self, scenario):
        return 5

    def eval_indices(self, scenario):
        return range(1, 5)

    def agents(self, scenario):
        return (0, -1)

    def snapshot(self, scenario, index):
        cloud = PointCloud.of(torch.zeros(1, 3))
        poses = (
            Transform.from_xyz_yaw(AT[scenario] + 0.5 * index, 0, 1, 0.1),
            Transform.from_xyz_yaw(AT[scenario] - 20.0, 5, 4, math.pi),
        )
        car, pole = (AgentFrame.of(cloud, pose, -k, index) for k, pose in enumerate(poses))
        return Snapshot(scenario, index, (car, replace(pole, is_infrastructure=True)))


@pytest.fixture(scope="module")
def source():
    line = MapElements.of([[[-300.0, 2.0], [300.0, 2.0]]], DIVIDER)
    return TileSource(Streets(), {"Town1": line, "Town2": MapElements.empty()}, collect_observer_poses(Streets()))


def test_a_fleet_tile_uses_all_agents_of_the_town_in_range(source):
    tile = sample_fleet_tile(source, "town1_0", 0, 10, TILE, VIEW)
    (own, *others), at = tile.frames, {round(float(f.world_from_agent.translation[0])) for f in tile.frames[1:]}
    assert (own.agent_id, own.timestamp_ns in (1, 2, 3, 4)) == (0, True)
    assert len(others) == 3 and -20 in at and 20 in at and max(at) in (40, 41, 42), "not 500 m away, not of Town2"
    np.testing.assert_allclose(tile.world_from_tile.translation[:2], own.world_from_agent.translation[:2])
    assert float(tile.world_from_tile.translation[2]) == 0 and float(tile.world_from_tile.yaw) == pytest.approx(0.1)
    assert len(tile.truth) == 1 and len(sample_fleet_tile(source, "town2_0", 0, 10, TILE, VIEW).truth) == 0


def test_the_seed_decides_and_fewer_frames_are_a_prefix(source):
    def sample_keys(seed, max_frames):
        tile = sample_fleet_tile(source, "town1_0", seed, max_frames, TILE, VIEW)
        return [(f.agent_id, f.timestamp_ns, f.world_from_agent.translation[0].item()) for f in tile.frames]

    assert (
        sample_keys(0, 4) == sample_keys(0, 4)
        and sample_keys(0, 2) == sample_keys(0, 4)[:2]
        and len(sample_keys(0, 1)) == 1
    )
    assert len({tuple(sample_keys(seed, 4)) for seed in range(8)}) > 3


def test_views_are_counted_on_the_tile():
    own = Streets().snapshot("town1_0", 1).frames[0]
    flat = (0.5, 0.0, 0.1)
    seen = compute_coverage(
        [flat, (0.5 + 60 * math.cos(0.1), 60 * math.sin(0.1), 0.1), (0.5, 0.0, 0.1 + math.pi / 2)], own, TILE, VIEW
    )
    assert seen.shape == (3, 60 * 30) and seen.mean(1).tolist() == pytest.approx([0.5, 0.25, 0.5])
    assert (seen[0] & seen[1]).mean() == 0 and (seen[0] == seen[2]).all()


def test_frames_that_add_coverage_come_sooner_and_others_never():
    seen = np.zeros((5, 100), bool)
    seen[0, :30] = True
    seen[1, :30] = True  # nothing new
    seen[2, 30:95] = True  # much
    seen[3, 85:100] = True  # a little
    seen[4, :5] = True  # too little to be a look at the tile
    orders = [select_by_coverage(seen, 10, keyed_generator("test", k)) for k in range(200)]
    assert all(sorted(order) == [0, 1, 2] for order in orders), "rows of others, counted from 0; the last never"
    first = np.bincount([order[0] for order in orders], minlength=3)
    assert first[0] == 0 and 0.7 < first[1] / 200 < 0.93, "65 to 15 of 80"
    assert {tuple(order) for order in orders} == {(1, 2, 0), (2, 1, 0)}, "what covers nothing new comes last"
    assert select_by_coverage(seen[:1], 10, keyed_generator("test")) == []


def test_a_local_tile_lies_ahead(source):
    snapshot = sample_meeting(source, "town1_0", 3)
    assert snapshot.index in range(1, 5) and sample_meeting(source, "town1_0", 3).index == snapshot.index
    car, car_window = make_local_tile(source, snapshot, 0)
    pole, pole_window = make_local_tile(source, snapshot, 1)
    assert (car_window.x_max, pole_window.x_max) == (30.0, 50.0) and len(car.frames) == 1
    # The line lies 2 m to the left of the road, the pole looks back along it from 5 m to its left.
    assert car.truth.points[:, 0].min() == 0 and pole.truth.points[:, 0].max() == pytest.approx(50)
    np.testing.assert_allclose(pole.truth.points[:, 1], 3.0, atol=1e-9)
    assert float(make_world_from_tile(pole.frames[0]).translation[2]) == 0


def test_the_single_instant_is_an_evaluated_frame_and_deterministic():
    once = SingleFramePerScenario(Streets(), 5)
    assert (
        once.length("town1_0") == 1 and once.eval_indices("town1_0") == range(1) and once.scenarios == Streets.scenarios
    )
    seen = once.snapshot("town1_0", 0)
    assert seen.index == 0 and seen.frames[0].timestamp_ns in (1, 2, 3, 4) and once.agents("town1_0") == (0, -1)
    times = {
        SingleFramePerScenario(Streets(), seed).snapshot("town1_0", 0).frames[0].timestamp_ns for seed in range(40)
    }
    assert times == {1, 2, 3, 4}
