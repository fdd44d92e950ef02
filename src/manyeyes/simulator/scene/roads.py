# SPDX-License-Identifier: Apache-2.0
"""What a scenario asks of a road network: its crossings, how far the road is, and where things may stand beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes.maps.roads.road_network import PAVED, WALKABLE, Lane, RoadNetwork
from manyeyes.maps.roads.surface import RoadSurface
from manyeyes.simulator.scene.directions import direction
from manyeyes.simulator.scene.ground import is_multilevel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CrossingSite:
    """A place where roads meet. center: (3,) metres, on the road; radius_m reaches the farthest corner of its lanes.

    approaches: ids of the drivable lanes that lead into it. num_arms: how many roads meet, counted by the directions in which
    their lanes begin and end. is_multilevel: whether roads pass over each other within 60 m.
    """

    junction_id: str
    center: Array
    radius_m: float
    approaches: tuple[int, ...]
    num_arms: int
    is_multilevel: bool


def crossing_sites(network: RoadNetwork, min_arms: int = 3, single_level: bool = True) -> tuple[CrossingSite, ...]:
    """Return junctions with at least min_arms arms, largest first; without those near a bridge unless single_level is false."""
    sites = []
    for junction in network.junctions:
        inside = set(junction.lanes)
        leaving = {k for own in junction.lanes for k in network.lanes[own].successors if k not in inside}
        mouths = [network.lanes[k].center[-1] for k in junction.incoming]
        mouths += [network.lanes[k].center[0] for k in sorted(leaving) if network.lanes[k].is_drivable]
        arms = _count_arms(np.array([np.arctan2(*(mouth - junction.center)[[1, 0]]) for mouth in mouths]))
        if arms < min_arms:
            continue
        center = junction.center.copy()
        center[2] = network.height(center[None, :2], junction.center[2])[0]
        stacked = is_multilevel(network, center[:2], 60.0)
        if not (single_level and stacked):
            site = CrossingSite(junction.id, center, junction.radius_m, junction.incoming, arms, stacked)
            sites.append(site)
    return tuple(sorted(sites, key=lambda site: (-site.num_arms, -len(site.approaches), site.junction_id)))


def _count_arms(angle: Array, min_gap_rad: float = np.radians(35.0)) -> int:
    """Return how many groups of angles (N,) lie around the circle, cut where neighbours are more than ``min_gap_rad`` from
    each other.
    """
    if len(angle) < 2:
        return len(angle)
    ordered = np.sort(np.mod(angle, 2 * np.pi))
    gaps = np.diff(np.concatenate((ordered, ordered[:1] + 2 * np.pi)))
    return max(1, int((gaps > min_gap_rad).sum()))


def distance_to_road(network: RoadNetwork, xy: ArrayLike) -> Array:
    """Return (N,) metres from points (N, 2) to the nearest drivable lane; 0 on it."""
    return network.drivable_surface.distance(np.asarray(xy, np.float64).reshape(-1, 2))


def on_road(network: RoadNetwork, xy: ArrayLike) -> NDArray[np.bool_]:
    """Return (N,) whether points (N, 2) lie on a drivable lane."""
    return distance_to_road(network, xy) <= 0.0


def lane_at(network: RoadNetwork, xy: ArrayLike, near_z: Array | float | None = None) -> tuple[Lane | None, ...]:
    """Return the drivable lane under each point (N, 2); None off the road. Where lanes overlap, as in junctions, one of them."""
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    drivable = [lane for lane in network.lanes if lane.is_drivable]
    owner = network.drivable_surface.strip_at(points, near_z)
    covered = network.drivable_surface.distance(points) <= 0.0
    return tuple(drivable[k] if inside else None for k, inside in zip(owner, covered))


@dataclass(frozen=True, eq=False)
class RoadsidePoints:
    """N free places beside the road. xy: (N, 2) metres; yaw: (N,) radians, towards the road; setback_m: (N,) from its lanes."""

    xy: Array
    yaw: Array
    setback_m: Array

    def __len__(self) -> int:
        return len(self.xy)


def roadside_points(
    network: RoadNetwork,
    center_xy: ArrayLike,
    radius_m: float,
    min_setback_m: float = 0.5,
    max_setback_m: float = 25.0,
    spacing_m: float = 2.0,
    avoid_walkways: bool = False,
) -> RoadsidePoints:
    """Return points of a lattice within radius_m of a centre that lie beside the paved road, from min to max setback off it.

    Poles and roadside units take small setbacks, buildings larger ones; avoid_walkways leaves out pavements and shoulders.
    """
    center = np.asarray(center_xy, np.float64).reshape(2)
    axis = np.arange(-radius_m, radius_m + spacing_m / 2, spacing_m)
    xy = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    xy = center + xy[np.linalg.norm(xy, axis=1) <= radius_m]
    kinds = (*PAVED, *WALKABLE) if avoid_walkways else PAVED
    surface = _nearby_surface(network, kinds, center, radius_m + max_setback_m)
    distance = surface.distance(xy)
    fits = (distance >= min_setback_m) & (distance <= max_setback_m)
    xy, distance = xy[fits], distance[fits]
    # The distance grows fastest away from the road.
    eps = 0.05
    dx = surface.distance(xy + [eps, 0.0]) - surface.distance(xy - [eps, 0.0])
    dy = surface.distance(xy + [0.0, eps]) - surface.distance(xy - [0.0, eps])
    return RoadsidePoints(xy, direction(-dy, -dx), distance)


def _nearby_surface(network: RoadNetwork, kinds: tuple[str, ...], center: Array, radius_m: float) -> RoadSurface:
    near = [
        lane
        for lane in network.lanes
        if lane.kind in kinds and np.linalg.norm(lane.center[:, :2] - center, axis=1).min() <= radius_m
    ]
    return RoadSurface.of_strips([lane.left for lane in near], [lane.right for lane in near])
