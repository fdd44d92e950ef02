# SPDX-License-Identifier: Apache-2.0
"""Vehicles that SUMO drives, and those that stand at the kerb."""

from __future__ import annotations

import importlib.metadata
import itertools
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes import VEHICLE_LABELS, ConfigError, MissingExtraError, ShapeError
from manyeyes.simulator.scene import traffic
from manyeyes.simulator.scene.parking import parked_cars
from manyeyes.simulator.scene.towns import load_town
from manyeyes.simulator.scene.traffic import _headings, _speeds, _without_dead_ends, simulate_traffic
from manyeyes.simulator.scene.vehicle_market import draw_vehicles
from manyeyes.simulator.scene.vehicles import VehicleStates, overlaps

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "carla_opendrive"
STEPS = 12


@pytest.fixture(scope="module")
def town():
    pytest.importorskip("sumo")
    return load_town("generated-1")


@pytest.fixture(scope="module")
def drive(town, tmp_path_factory: pytest.TempPathFactory):
    pytest.importorskip("libsumo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MANYEYES_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield simulate_traffic(town, 4, STEPS, vehicles_per_lane_km=12.0, warmup_s=20.0)


def in_lane_direction(network, states: VehicleStates) -> np.ndarray:
    """Cosine between each vehicle's heading and that of the best matching drivable lane within 2 m of it."""
    best = np.full(len(states), -2.0)
    ahead = np.stack((np.cos(states.yaw), np.sin(states.yaw)), -1)
    for lane in network.lanes:
        if lane.is_drivable:
            middle = (lane.center[1:, :2] + lane.center[:-1, :2]) / 2
            way = np.diff(lane.center[:, :2], axis=0)
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            near = np.linalg.norm(states.position[:, None, :2] - middle, axis=-1) < 2.0
            best = np.maximum(best, np.where(near, ahead @ way.T, -2.0).max(1))
    return best


def test_vehicles_are_on_the_road_and_drive_on_its_right_side(town, drive):
    states = drive[-1]
    assert len(states) > 20
    assert (town.drivable_surface.distance(states.position[:, :2]) < 0.3).mean() > 0.97
    along = in_lane_direction(town, states)
    assert (along > 0.7).mean() > 0.9  # a mirrored or reversed town has them at -1
    assert (along > -2).mean() > 0.97


def test_a_vehicle_s_motion_is_its_speed_along_its_heading(drive):
    moved = 0
    for before, after in itertools.pairwise(drive):
        _, i, k = np.intersect1d(before.id, after.id, return_indices=True)
        step = after.position[k, :2] - before.position[i, :2]
        assert abs(np.linalg.norm(step, axis=1) - after.speed[k] * 0.1).max() < 0.35
        fast = after.speed[k] > 2
        along = (step * np.stack((np.cos(after.yaw[k]), np.sin(after.yaw[k])), -1)).sum(1)
        assert (along[fast] > 0).all()
        moved += int(fast.sum())
    assert moved > 50


def test_no_vehicle_appears_vanishes_or_touches(drive):
    ids = [set(states.id.tolist()) for states in drive]
    assert all(one == ids[0] for one in ids)
    for states in drive:
        corners = states.corners()
        for n in range(1, len(states)):
            assert not overlaps(corners[n], corners[:n]).any()


@pytest.mark.slow
def test_same_seed_same_traffic_other_seed_other_traffic(town, drive):
    again = simulate_traffic(town, 4, STEPS, vehicles_per_lane_km=12.0, warmup_s=20.0)
    for one, two in zip(drive, again, strict=True):
        for field in fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    led = simulate_traffic(town, 4, STEPS, vehicles_per_lane_km=12.0, warmup_s=20.0, lead_steps=2)
    assert len(led) == STEPS + 2
    np.testing.assert_array_equal(led[2].position, drive[0].position)
    both = np.isin(led[1].id, led[2].id)
    way = led[2].position[np.isin(led[2].id, led[1].id)] - led[1].position[both]
    assert 0 < np.abs(way).max() < 3
    other = simulate_traffic(town, 5, 1, vehicles_per_lane_km=2.0, warmup_s=2.0)[0]
    assert 0 < len(other) < len(drive[0]) / 3
    assert not np.isin(other.position, drive[0].position).all()


def test_converted_net_is_kept(town, drive, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: str) -> None:
        raise AssertionError("converted again")

    traffic.sumo_net(town)
    monkeypatch.setattr(traffic, "run_sumo_tool", fail)
    assert traffic.sumo_net(town).is_file()


def test_nonsense_is_refused(town):
    with pytest.raises(ConfigError, match="steps >= 1"):
        simulate_traffic(town, 1, 0)
    with pytest.raises(ConfigError, match="lead"):
        simulate_traffic(town, 1, 2, warmup_s=1.0, lead_steps=11)


def test_sizes_and_shares():
    kind, size = draw_vehicles(np.random.default_rng(0), 4000)
    share = np.bincount(kind, minlength=len(VEHICLE_LABELS)) / 4000
    np.testing.assert_allclose(share, [0.78, 0.10, 0.07, 0.05], atol=0.02)
    cars = size[kind == 0]
    assert (cars.min(0) >= [3.6, 1.7, 1.35]).all()
    assert (cars.max(0) <= [5.1, 2.0, 1.8]).all()
    assert np.corrcoef(cars[:, 0], cars[:, 1])[0, 1] > 0.5
    assert size[kind == 3, 0].min() >= 10.0


def test_heading_of_a_bus_that_changes_lanes_follows_its_track():
    # 10 m bus at 10 m/s: one lane to the left within 2.5 s. Its bumper's direction reaches 8°, the chord stays below.
    t = np.arange(0, 6, 0.1)
    y = 3.5 * np.clip((t - 2) / 2.5, 0, 1)
    state = np.stack((10 * t, y, 0 * t, np.full(len(t), 90.0), np.full(len(t), 10.0)), -1)
    heading = _headings(np.zeros(len(t), np.int64), state, np.array([10.0]))
    assert heading[:20] == pytest.approx(0.0, abs=1e-9)
    assert heading.max() == pytest.approx(np.arctan(0.14), abs=0.01)
    assert heading[-1] == pytest.approx(0.0, abs=1e-9)
    assert abs(np.diff(heading)).max() < 0.03


def test_speed_is_the_way_and_sumo_s_where_there_is_none():
    state = np.array([[0.0, 0, 0, 90, 7.0], [2.0, 0, 0, 90, 7.0], [5.0, 5, 0, 0, 3.0]])
    speed = _speeds(np.array([0, 1, 1]), np.array([4, 4, 5]), state, 0.1)
    assert speed.tolist() == [7.0, pytest.approx(20.0), 3.0]


def test_dead_ends_are_cut_off_unless_all_ways_end():
    assert _without_dead_ends([{1}, {0, 2}, {3}, set()]) == [{1}, {0}, set(), set()]
    assert _without_dead_ends([{1}, set()]) == [{1}, set()]


def test_overlap_of_turned_rectangles():
    def place(x: float, y: float, yaw: float) -> np.ndarray:
        one = np.array([[x, y, 0.0]])
        whole, real = np.zeros(1, np.int64), np.zeros(1)
        return VehicleStates(whole, whole, one, real + yaw, real, real, np.array([[4.0, 2.0, 1.5]])).corners()[0]

    others = np.stack(
        [place(3.9, 0, 0), place(4.1, 0, 0), place(0, 2.1, 0), place(2.9, 1.4, 0.8), place(0, 3.1, np.pi / 2)]
    )
    assert overlaps(place(0, 0, 0), others).tolist() == [True, False, False, True, False]


def test_states_check_their_shapes():
    one = np.zeros(1)
    with pytest.raises(ShapeError, match=r"VehicleStates\.position needs shape \(1, 3\); got \(1, 2\)"):
        VehicleStates(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros((1, 2)), one, one, one, np.zeros((1, 3)))


def test_parked_cars_stand_beside_the_road_and_apart(town):
    center = town.junctions[0].center[:2]
    cars = parked_cars(town, 1, center, 150.0)
    assert len(cars) > 15
    assert (cars.speed == 0).all()
    assert len(set(cars.id.tolist())) == len(cars)
    rim = cars.corners().reshape(-1, 2)
    assert town.drivable_surface.distance(rim).min() > 0
    assert town.drivable_surface.distance(cars.position[:, :2]).max() < 3.0
    corners = cars.corners()
    for n in range(1, len(cars)):
        assert not overlaps(corners[n], corners[:n]).any()
    within = parked_cars(town, 1, center, 60.0)
    assert set(within.id.tolist()) <= set(cars.id.tolist())
    assert 0 < len(parked_cars(town, 2, center, 150.0)) != len(cars)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason=f"the CARLA towns are not at {SHARED}")
def test_traffic_follows_the_hills_of_town03(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    pytest.importorskip("libsumo")
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path))
    network = load_town("Town03", SHARED)
    states = simulate_traffic(network, 1, 2, warmup_s=15.0)[-1]
    assert states.position[:, 2].max() > 4.0
    np.testing.assert_allclose(
        states.position[:, 2], network.height(states.position[:, :2], states.position[:, 2]), atol=0.35
    )
    # Uphill is negative pitch: the road 2 m ahead lies higher by the tangent.
    ahead = np.stack((np.cos(states.yaw), np.sin(states.yaw)), -1)
    front = network.height(states.position[:, :2] + ahead, states.position[:, 2])
    rear = network.height(states.position[:, :2] - ahead, states.position[:, 2])
    steep = abs(states.pitch) > 0.04
    assert steep.sum() >= 2
    np.testing.assert_allclose(-np.tan(states.pitch[steep]), (front - rear)[steep] / 2, atol=0.03)
    # No vehicle drives on parking lanes; in junctions they lie across driving lanes.
    parking = [lane for lane in network.lanes if lane.kind == "parking" and lane.junction_id is None]
    near = np.concatenate([lane.center[:, :2] for lane in parking])
    distance = np.linalg.norm(states.position[:, None, :2] - near[None], axis=-1).min(1)
    assert (distance > 1.0).all()


def test_missing_sumo_names_the_extra(town, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    with monkeypatch.context() as patch:
        patch.setattr(importlib.metadata, "version", absent)
        with pytest.raises(MissingExtraError, match=r"pip install 'manyeyes\[sim\]'"):
            traffic.sumo_net(town)
    script = tmp_path / "worker.py"
    monkeypatch.setattr(traffic, "_WORKER", script)
    script.write_text("import sys; sys.exit('libsumo is not installed')")
    with pytest.raises(MissingExtraError, match="'sim' extra"):
        traffic._run_worker(tmp_path / "job.json", {})
    script.write_text("print('x'); raise ValueError('no net')")
    with pytest.raises(ConfigError, match="SUMO failed with 1: ValueError: no net"):
        traffic._run_worker(tmp_path / "job.json", {})
