# SPDX-License-Identifier: Apache-2.0
"""Parked cars: in marked spaces, on parking lanes and shoulders, else at the edge of the road."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes.maps.roads.road_network import DRIVABLE, Lane, RoadNetwork
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.scene.directions import direction
from manyeyes.simulator.scene.vehicle_market import CLASSIC_MARKET, VehicleMarket, draw_vehicles
from manyeyes.simulator.scene.vehicles import VehicleStates, overlaps

Array = NDArray[np.float64]

PARKED_ID = 1_000_000
# Marked spaces are for cars.
_MAX_SPACE_M = 5.2
_PITCH_M = 6.6
_END_CLEARANCE_M = 9.0
_CROSSING_CLEARANCE_M = 7.0
_KERB_GAP_M = 0.3
_MAX_SPEED_LIMIT_MPS = 20.0


def parked_cars(
    network: RoadNetwork,
    seed: int,
    center_xy: ArrayLike,
    radius_m: float,
    density: float = 0.45,
    market: VehicleMarket = CLASSIC_MARKET,
) -> VehicleStates:
    """Parked vehicles within radius_m of a centre, speed 0; density: the mean share of places that are
    taken. market: which vehicles park.

    The draws belong to the lanes, not to the area: another centre gives the same vehicles where the areas overlap. None
    stands on a drivable lane, near a junction or a crossing, or on a road faster than 20 m/s.
    """
    center = np.asarray(center_xy, np.float64).reshape(2)
    candidates = [_in_spaces(network, seed, density, market)]
    for lane in network.lanes:
        if _has_kerb(network, lane) and np.linalg.norm(lane.center[:, :2] - center, axis=1).min() < radius_m + 10.0:
            candidates.append(_cars_along_lane(network, lane, seed, density, market))
    cars = VehicleStates.cat(candidates)
    cars = cars[np.linalg.norm(cars.position[:, :2] - center, axis=1) <= radius_m]
    return _without_conflicts(network, cars)


def _has_kerb(network: RoadNetwork, lane: Lane) -> bool:
    """Return whether it is the outermost drivable lane of a street where people park."""
    if not lane.is_drivable or lane.junction_id is not None or lane.speed_limit_mps > _MAX_SPEED_LIMIT_MPS:
        return False
    right = lane.right_neighbor
    return right < 0 or network.lanes[right].kind not in DRIVABLE


def _cars_along_lane(
    network: RoadNetwork, lane: Lane, seed: int, density: float, market: VehicleMarket
) -> VehicleStates:
    """Return places every 6.6 m beside the right border of a lane, each taken by chance."""
    random = keyed_generator(seed, "parked", lane.road_id, lane.section, lane.lane_id)
    border = lane.right
    step = np.linalg.norm(np.diff(border[:, :2], axis=0), axis=1)
    station = np.concatenate(([0.0], np.cumsum(step)))
    places = np.arange(_END_CLEARANCE_M, station[-1] - _END_CLEARANCE_M, _PITCH_M)
    # Some streets are full, some nearly empty: the mean stays.
    taken_prob = density * 2 * random.random()
    taken = random.random(len(places)) < taken_prob
    kind, size = draw_vehicles(random, len(places), market, "parked")
    shift, twist, turned = (
        random.normal(0, 0.35, len(places)),
        random.normal(0, 0.025, len(places)),
        random.random(len(places)),
    )
    s = places + np.clip(shift, -0.6, 0.6)
    at = np.stack([np.interp(s, station, border[:, k]) for k in range(3)], -1)
    slope = np.stack(
        [np.interp(s + 1.0, station, border[:, k]) - np.interp(s - 1.0, station, border[:, k]) for k in range(3)], -1
    )
    yaw = direction(slope[:, 1], slope[:, 0])
    right = np.stack((np.sin(yaw), -np.cos(yaw)), -1)
    offset = size[:, 1] / 2 + _KERB_GAP_M
    beside = network.lanes[lane.right_neighbor] if lane.right_neighbor >= 0 else None
    if beside is not None and beside.kind in ("parking", "shoulder", "stop"):
        width = np.interp(s, station, beside.width_m if len(beside.left) == len(station) else np.zeros(len(station)))
        offset = np.maximum(offset, np.where(width > size[:, 1], width / 2, 0.0))
    at[:, :2] += right * offset[:, None]
    rise = np.hypot(slope[:, 0], slope[:, 1])
    pitch = -direction(slope[:, 2], np.maximum(rise, 1e-6))
    backwards = turned < 0.1
    yaw = yaw + twist + np.where(backwards, np.pi, 0.0)
    pitch = np.where(backwards, -pitch, pitch)
    return _states(lane.id * 1000 + np.arange(len(places)), kind, at, yaw, pitch, size)[taken]


def _in_spaces(network: RoadNetwork, seed: int, density: float, market: VehicleMarket) -> VehicleStates:
    """Return cars in the file's marked spaces outside junctions, along the longer edge of each."""
    if not network.parking:
        return VehicleStates.empty()
    random = keyed_generator(seed, "parked", "spaces")
    n = len(network.parking)
    inside = {road.id for road in network.roads if road.junction_id is not None}
    free = np.array([space.road_id not in inside for space in network.parking])
    taken = free & (random.random(n) < min(1.0, 1.4 * density))
    kind, size = draw_vehicles(random, n, market, "parked", _MAX_SPACE_M)
    corners = np.stack([space.polygon[:4] for space in network.parking])
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
    longer = np.linalg.norm(one, axis=1) > np.linalg.norm(two, axis=1)
    ahead = np.where(longer[:, None], one, two)
    yaw = direction(ahead[:, 1], ahead[:, 0]) + np.where(random.random(n) < 0.5, np.pi, 0.0)
    states = _states(900_000_000 + np.arange(n), kind, corners.mean(1), yaw, np.zeros(n), size)
    return states[taken]


def _states(
    id: NDArray[np.int64], kind: NDArray[np.int64], position: Array, yaw: Array, pitch: Array, size: Array
) -> VehicleStates:
    yaw = np.mod(yaw + np.pi, 2 * np.pi) - np.pi
    return VehicleStates(PARKED_ID + id, kind, position, yaw, pitch, np.zeros(len(id)), size)


def _without_conflicts(network: RoadNetwork, cars: VehicleStates) -> VehicleStates:
    """Without those on a drivable lane, near a crossing or a junction's lanes, or overlapping an earlier one."""
    if not len(cars):
        return cars
    rim = cars.corners(0.1)
    rim = np.concatenate((rim, (rim + np.roll(rim, -1, 1)) / 2, cars.position[:, None, :2]), 1)
    gap = network.drivable_surface.distance(rim.reshape(-1, 2)).reshape(rim.shape[:2])
    clear = np.asarray(gap.min(1) > 0.05)
    for crossing in network.crossings:
        middle, reach = crossing.polygon[:, :2].mean(0), np.ptp(crossing.polygon[:, :2], axis=0).max() / 2
        near = np.linalg.norm(cars.position[:, :2] - middle, axis=1) < reach + 20.0
        if near.any():
            gap = _distance_to_ring(cars.position[near, :2], crossing.polygon[:, :2])
            clear[np.flatnonzero(near)[gap < _CROSSING_CLEARANCE_M]] = False
    cars = cars[clear]
    corners = cars.corners(0.15)
    kept = np.ones(len(cars), bool)
    for n in range(len(cars)):
        near = np.flatnonzero(kept[:n] & (np.abs(cars.position[:n, :2] - cars.position[n, :2]).max(1) < 12.0))
        if len(near) and overlaps(corners[n], corners[near]).any():
            kept[n] = False
    return cars[kept]


def _distance_to_ring(points: Array, ring: Array) -> Array:
    """Return (N,) distance of points (N, 2) to a closed ring's edges (M, 2)."""
    start, edge = ring[None], (np.roll(ring, -1, 0) - ring)[None]
    f = ((points[:, None] - start) * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-12)
    foot = start + np.clip(f, 0, 1)[..., None] * edge
    return np.linalg.norm(points[:, None] - foot, axis=-1).min(1)
