# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("libsumo", reason="scenarios need the sim extra")

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datatypes import ConfigError, PointCloud, Snapshot
from manyeyes.simulator.scene.scenario import (
    RSU_ID,
    NoSceneError,
    ScenarioSpec,
    SimulatedScenario,
    _choose_agents,
    find_visible_boxes,
    make_scenario,
)
from manyeyes.simulator.scene.towns import load_town
from manyeyes.simulator.scene.vehicles import VehicleStates

SPEC = ScenarioSpec(
    "generated-1", 7, "one", vehicles=2, frames=3, history_frames=1, roadside_chance=1.0, min_vehicles=6
)


@pytest.fixture(scope="module")
def scenario() -> SimulatedScenario:
    return make_scenario(SPEC, load_town("generated-1"))


@pytest.fixture(scope="module")
def snapshot(scenario: SimulatedScenario) -> Snapshot:
    return scenario.snapshot(1)


def test_points_lie_in_the_boxes_that_agents_list(snapshot: Snapshot) -> None:
    counts = count_points_in_listed_boxes(snapshot)
    assert int((counts > 0).sum()) > 8
    assert int((counts == 0).sum()) == 0
    mirrored = []
    for frame in snapshot.frames:
        flip = frame.points.xyz * torch.tensor([1.0, -1.0, 1.0])
        mirrored.append(replace(frame, points=PointCloud(flip, frame.points.intensity, frame.points.time_s)))
    assert int((count_points_in_listed_boxes(replace(snapshot, frames=tuple(mirrored))) == 0).sum()) > 5


def test_a_box_is_visible_if_a_return_of_its_vehicle_lies_in_it(snapshot: Snapshot) -> None:
    """Against box by box: of returns at random, named after any vehicle, some lie in their own box and some in another's."""
    assert snapshot.truth is not None
    boxes, rng = snapshot.truth.boxes, np.random.default_rng(0)
    row = rng.integers(0, len(boxes), 400)
    near = boxes.center[row].numpy() + rng.normal(0, 1.5, (400, 3))
    named = np.where(rng.random(400) < 0.3, boxes.id[rng.integers(0, len(boxes), 400)], boxes.id[row])
    named[:20] = 0
    pose = snapshot.frames[0].world_from_agent
    cloud = PointCloud.of(pose.inverse().apply(torch.from_numpy(near)).float())
    local, own = boxes.transform(pose.inverse()).to(torch.float32), int(boxes.id[2])
    slow = [
        int(id) != own and bool(local[i : i + 1].contains(cloud.xyz[torch.from_numpy(named == int(id))], 0.05).any())
        for i, id in enumerate(boxes.id)
    ]
    assert find_visible_boxes(cloud, named, pose, boxes, own).tolist() == slow and 0 < sum(slow) < len(slow)
    assert not find_visible_boxes(cloud[:0], named[:0], pose, boxes, own).any()


def test_agents_are_vehicles_and_a_unit_on_a_pole_that_list_others(
    scenario: SimulatedScenario, snapshot: Snapshot
) -> None:
    ids = [frame.agent_id for frame in snapshot.frames]
    assert ids == [*scenario.agents, RSU_ID]
    assert snapshot.truth is not None
    for row, frame in enumerate(snapshot.frames):
        own = snapshot.truth.boxes.id == frame.agent_id
        assert int(own.sum()) == (frame.agent_id > 0)
        assert not bool(snapshot.truth.seen[row][own].any())
        assert frame.timestamp_ns == 100_000_000
    pole = snapshot.frames[-1]
    assert pole.is_infrastructure
    assert 4.5 <= pole.sensor_height_m <= 6.0
    assert torch.equal(pole.world_from_agent.rotation[2], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_the_road_under_each_agent_is_at_zero(snapshot: Snapshot) -> None:
    for frame in snapshot.frames:
        xyz = frame.points.xyz
        near = (xyz[:, :2].norm(dim=1) < 15) & (xyz[:, 2].abs() < 0.3)
        assert abs(float(xyz[near, 2].median())) < 0.03


def test_half_of_the_vehicles_move_and_positions_change(scenario: SimulatedScenario) -> None:
    assert scenario.moving_fraction >= 0.5
    first, last = scenario.states[0], scenario.states[-1]
    both = sorted(set(first.id.tolist()) & set(last.id.tolist()))
    assert len(both) > 10
    moved = [abs(first.position[first.id == i] - last.position[last.id == i]).max() for i in both]
    assert max(moved) > 1.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_points(snapshot: Snapshot) -> None:
    again = make_scenario(SPEC, load_town("generated-1")).snapshot(1)
    for one, two in zip(snapshot.frames, again.frames):
        assert torch.equal(one.points.xyz, two.points.xyz)
        assert torch.equal(one.points.intensity, two.points.intensity)


@pytest.mark.slow
def test_lead_frames_do_not_change_later_frames(scenario: SimulatedScenario) -> None:
    longer = make_scenario(replace(SPEC, lead_frames=3), load_town("generated-1"))
    assert (len(longer), longer.agents, longer.moving_fraction) == (6, scenario.agents, scenario.moving_fraction)
    one, two = scenario.snapshot(1), longer.snapshot(4)
    for before, after in zip(one.frames, two.frames, strict=True):
        assert torch.equal(before.points.xyz, after.points.xyz)
        assert after.timestamp_ns - before.timestamp_ns == 300_000_000
    assert one.truth is not None and two.truth is not None
    assert torch.equal(one.truth.boxes.center, two.truth.boxes.center)
    agent = [longer.snapshot(i).frames[0].world_from_agent.translation for i in (0, 3)]
    ago = longer.states[0].speed[longer.states[0].id == longer.agents[0]][0]
    assert float((agent[1] - agent[0]).norm()) == pytest.approx(0.3 * ago, abs=0.3)


@pytest.mark.slow
def test_impossible_requests_are_named() -> None:
    with pytest.raises(NoSceneError, match="no crossing in generated-1 has 5000 vehicles"):
        make_scenario(replace(SPEC, min_vehicles=5000), load_town("generated-1"))
    with pytest.raises(ConfigError, match="frames > history_frames"):
        replace(SPEC, frames=1)
    with pytest.raises(ConfigError, match="lead_frames >= 0"):
        replace(SPEC, lead_frames=-1)
    with pytest.raises(ConfigError, match="low_m < high_m"):
        replace(SPEC, low_m=45.0, high_m=8.0)


def make_states(kinds: dict[int, int], x: dict[int, float]) -> VehicleStates:
    """Vehicles on the x axis, by id."""
    id, zero = np.array(list(x)), np.zeros(len(x))
    position = np.stack((np.array(list(x.values())), zero, zero), 1)
    return VehicleStates(id, np.array([kinds[i] for i in x]), position, zero, zero, zero, np.ones((len(x), 3)))


def test_agents_are_cars_in_range_at_the_first_frame_that_stay_and_keep_the_gap() -> None:
    """8 and 45 m are the limits; 3 leaves the scene, 4 is a bus, 5 is too near the crossing, 6 too far, 7 too near 2."""
    spec = replace(SPEC, vehicles=6)
    assert (spec.low_m, spec.high_m, spec.min_gap_m) == (8.0, 45.0, 9.0)
    start = {1: -44.0, 2: 20.0, 3: -20.0, 4: -30.0, 5: 7.0, 6: 46.0, 7: 28.0}
    kinds = {id: int(id == 4) for id in start}
    # Every vehicle drives 5 m: 1 comes nearer, 5 into the range, 2 and 7 keep their distance.
    end = {id: x + 5.0 for id, x in start.items() if id != 3}
    traffic = (make_states(kinds, start), make_states(kinds, end))
    chosen = {_choose_agents(traffic, np.zeros(2), spec, np.random.default_rng(seed)) for seed in range(20)}
    assert chosen == {(1, 2), (1, 7)}
    near = (make_states(kinds, {1: -9.0, 2: 9.0}), make_states(kinds, {1: -1.0, 2: 1.0}))
    assert _choose_agents(near, np.zeros(2), spec, np.random.default_rng(0)) == (1, 2)
    assert len(_choose_agents(near, np.zeros(2), replace(spec, vehicles=1), np.random.default_rng(0))) == 1


def test_the_body_of_an_agent_is_its_true_box(snapshot: Snapshot) -> None:
    assert snapshot.truth is not None
    for frame in snapshot.frames:
        if frame.is_infrastructure:
            assert frame.body is None
            continue
        own = snapshot.truth.boxes[snapshot.truth.boxes.id == frame.agent_id]
        assert frame.body is not None
        placed = frame.body.boxes(torch.float64).transform(frame.world_from_agent)
        assert torch.allclose(placed.center, own.center, atol=1e-6) and torch.allclose(placed.size, own.size)
        assert float((placed.yaw - own.yaw).cos()) > 0.9999
        assert frame.body.center[:2] == pytest.approx((0.0, 0.0), abs=0.01)
        assert not frame.body.contains(frame.points.xyz.double(), 0.05).any()
