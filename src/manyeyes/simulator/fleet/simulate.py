# SPDX-License-Identifier: Apache-2.0
"""Simulate a fleet that drives through a place: observations of its map models, and separately the ground truth.

All is a function of (seed, agent, drive, observation): the first n observations of a larger crowd are the crowd of n. A draw is
the same at every noise level, which only scales it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import KINDS, STYLES, MapElements, Polygons
from manyeyes.maps.elements.observation import Observation
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.simulator.fleet.changing_map import Change, ChangingMap
from manyeyes.simulator.fleet.config import CROWDS, CrowdConfig
from manyeyes.simulator.fleet.observation_model import (
    COLUMN_KIND,
    COLUMN_NAME,
    COLUMN_SCORE,
    COLUMN_SIGMA,
    MAX_ELEMENTS,
    MapModelNoise,
    OutputBuffers,
    TrueMapIndex,
    build_map_index,
    hash_normal,
    hash_uniform,
    observe_map,
)
from manyeyes.simulator.fleet.place import Place
from manyeyes.simulator.fleet.routes import sample_poses

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROLES = ("honest", "outlier", "malicious", "outdated", "infrastructure")
HONEST, OUTLIER, MALICIOUS, OUTDATED, INFRASTRUCTURE = range(len(ROLES))

_MIN_SIGMA_M, _MIN_SIGMA_RAD = 0.05, np.radians(0.05)
_SPEED_MPS = 10.0
_TURNS = np.array([5**0.5 - 1, 2**1.5 - 2, 2 * 3**0.5 - 2]) / 2
# Pseudo-elements of draws that belong to an observation, an agent or a drive.
_POSE, _PASS, _AGENT, _SHADOW = 2**40, 2**40 + 1, 2**40 + 2, 2**40 + 3
_CAR_M = (4.6, 1.9)


@dataclass(frozen=True, eq=False)
class Crowd:
    """N observations, and their ground truth.

    true_poses: (N, 3) x, y, yaw. roles: (N,) index into ROLES. origin: index in Place.truth of the true element that each observed
    element shows, -1 for none: observation i has ``origin[origin_offsets[i]:origin_offsets[i + 1]]``. changing_map: the true map
    over time.
    """

    observations: tuple[Observation, ...]
    true_poses: Array
    roles: Indices
    origin: Indices
    origin_offsets: Indices
    changing_map: ChangingMap
    place: Place

    def __len__(self) -> int:
        return len(self.observations)


@dataclass(frozen=True)
class _Drive:
    """One drive: agent (number and pseudonym), its number among drives, its role, its true poses (K, 3) and its key."""

    agent: int
    name: str
    number: int
    role: int
    poses: Array
    key: np.uint64


def simulate_crowd(
    place: Place,
    count: int,
    config: CrowdConfig = CROWDS["local"],
    seed: int = 0,
    changes: Sequence[Change] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Crowd:
    """Simulate ``count`` observations of a place; progress is called with (done, count) after each drive."""
    if count < 0:
        raise ConfigError(f"A crowd has 0 observations or more; got {count}.")
    changing_map = ChangingMap.of(place.truth, changes)
    observer = _Observer(changing_map, config, seed)
    observations: list[Observation] = []
    poses: list[Array] = []
    roles: list[int] = []
    origins: list[Indices] = []
    for drive in _drives(place, config, seed):
        for k, pose in enumerate(drive.poses):
            if len(observations) < count:
                observation, origin = observer.observe(drive, k, pose)
                observations.append(observation)
                poses.append(pose)
                roles.append(drive.role)
                origins.append(origin)
        if progress is not None:
            progress(len(observations), count)
        if len(observations) >= count:
            break
    return Crowd(
        tuple(observations),
        np.array(poses).reshape(-1, 3),
        np.array(roles, np.int64),
        np.concatenate(origins) if origins else np.zeros(0, np.int64),
        np.concatenate(([0], np.cumsum([len(o) for o in origins]))).astype(np.int64),
        changing_map,
        place,
    )


def _drives(place: Place, config: CrowdConfig, seed: int) -> Iterator[_Drive]:
    """Endless drives, in the order of time."""
    if not len(place.routes):
        raise ConfigError(f"{place.name}: no lane leads through its area; take a larger size_m.")
    cumulative_length = np.cumsum(place.routes.lengths)
    offsets = keyed_uniform((3,), seed, "crowd", "roles").numpy()
    poles = _pole_sites(place) if config.infrastructure_fraction > 0 else np.zeros((0, 3))
    number = 0
    while True:
        agent = number // config.drives_per_agent
        key = _key(seed, agent, number)
        role = _role(agent, config, offsets)
        name = f"s{seed}-a{agent:05d}"
        if len(poles) and hash_uniform(key, _PASS, 0, 8) < config.infrastructure_fraction:
            site = int(hash_uniform(key, _PASS, 0, 9) * len(poles))
            role, name = INFRASTRUCTURE, f"s{seed}-pole{site:03d}"
            drawn = np.repeat(poles[[site]], config.max_observations_per_drive, axis=0)
        else:
            drawn = _observation_poses(_path(place, config, key, cumulative_length), place.area, config, key)
        if len(drawn):
            yield _Drive(agent, name, number, role, drawn, key)
        number += 1


def _key(*parts: int | str) -> np.uint64:
    return np.uint64(int(keyed_uniform((1,), *parts[:1], "crowd", *parts[1:])[0] * 2.0**52))


def _role(agent: int, config: CrowdConfig, offsets: Array) -> int:
    """Roles by additive sequences: fractions are near exact for any number of agents, and nested when a fraction grows."""
    turn = (agent * _TURNS + offsets) % 1.0
    if turn[0] < config.malicious_fraction:
        return MALICIOUS
    if turn[1] < config.outlier_fraction:
        return OUTLIER
    return OUTDATED if turn[2] < config.outdated_fraction else HONEST


def _path(place: Place, config: CrowdConfig, key: np.uint64, cumulative_length: Array) -> Array:
    """Return the path of one drive: a recorded one, or a random walk over the lanes."""
    if place.logs and hash_uniform(key, _PASS, 0, 6) < config.recorded_drive_fraction:
        log = place.logs[int(hash_uniform(key, _PASS, 0, 7) * len(place.logs))]
        fresh = np.concatenate(([True], np.linalg.norm(np.diff(log[:, :2], axis=0), axis=1) > 1e-3))
        return log[fresh, :2]
    start = hash_uniform(key, _PASS, 0, 0) * cumulative_length[-1]
    lane = int(np.searchsorted(cumulative_length, start, side="right"))
    longest = (config.max_observations_per_drive + 1) * config.spacing_m[1]

    def choose(step: int, count: int) -> int:
        return int(hash_uniform(key, _PASS, step, 3) * count)

    return place.routes.walk(lane, start - (cumulative_length[lane - 1] if lane else 0.0), longest, choose)


def _observation_poses(
    path: Array, area: tuple[float, float, float, float], config: CrowdConfig, key: np.uint64
) -> Array:
    """Return true poses (K, 3) of one drive's observations: every spacing_m until it leaves the area or ends."""
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    low, high = config.spacing_m
    steps = [low + (high - low) * hash_uniform(key, _PASS, k, 1) for k in range(config.max_observations_per_drive - 1)]
    at = np.concatenate(([hash_uniform(key, _PASS, 0, 2) * min(low, length)], steps)).cumsum()
    poses = sample_poses(path, at[at <= length])
    outside = (poses[:, 0] < area[0]) | (poses[:, 1] < area[1]) | (poses[:, 0] > area[2]) | (poses[:, 1] > area[3])
    poses = poses[: np.flatnonzero(outside)[0]] if outside.any() else poses
    for k in range(len(poses)):
        sway, swing = 0.25 * hash_normal(key, _PASS, k, 4), np.radians(1.0) * hash_normal(key, _PASS, k, 5)
        poses[k] += [-sway * np.sin(poses[k, 2]), sway * np.cos(poses[k, 2]), swing]
    return poses


def _pole_sites(place: Place) -> Array:
    """Return a pole at each junction: on the corner of its bounding box nearest to the ground, facing its centre."""
    sites = []
    for part in getattr(place.junctions, "geoms", [place.junctions]):
        x0, y0, x1, y1 = part.bounds
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        inside = place.area[0] <= middle[0] <= place.area[2] and place.area[1] <= middle[1] <= place.area[3]
        if inside and part.area > 50.0:
            corner = np.array([x1, y1]) if (x1 - x0) >= (y1 - y0) else np.array([x0, y1])
            sites.append([*corner, np.arctan2(*(middle - corner)[::-1])])
    return np.array(sites).reshape(-1, 3)


class _Observer:
    """Makes observations; holds the true map of each epoch and the buffers of the compiled loop."""

    def __init__(self, changing_map: ChangingMap, config: CrowdConfig, seed: int) -> None:
        self.config, self.seed, self.epochs = config, seed, changing_map.epochs
        self.map_indices = [_index_map(changing_map, int(time)) for time in changing_map.epochs]
        self.noise = self._noise(config.range_x_m, config.range_y_m)
        self.infrastructure_noise = self._noise((0.0, config.infrastructure_range_m), (-15.0, 15.0))
        self.buffers = OutputBuffers(
            np.empty((MAX_ELEMENTS, config.points_per_element, 2)),
            np.empty((MAX_ELEMENTS, 4)),
            np.empty((MAX_ELEMENTS, len(STYLES))),
        )

    def _noise(self, x: tuple[float, float], y: tuple[float, float]) -> MapModelNoise:
        c = self.config
        return MapModelNoise(
            x_min=float(x[0]),
            x_max=float(x[1]),
            y_min=float(y[0]),
            y_max=float(y[1]),
            miss_rate=float(c.miss_rate),
            false_positive_rate=float(c.false_positive_rate),
            fragment_rate=float(c.fragment_rate),
            confusion_rate=float(c.confusion_rate),
            point_sigma_m=float(c.point_sigma_m),
            point_sigma_per_m=float(c.point_sigma_per_m),
            lateral_bend_m=float(c.lateral_bend_m),
            endpoint_truncation_m=float(c.endpoint_truncation_m),
            style_error_rate=float(c.style_error_rate),
        )

    def observe(self, drive: _Drive, k: int, pose: Array) -> tuple[Observation, Indices]:
        """Return the k-th observation of a drive at a true pose, and the true element of each of its elements."""
        config, noise = self.config, self.infrastructure_noise if drive.role == INFRASTRUCTURE else self.noise
        key = _key(self.seed, drive.agent, drive.number, k)
        time = config.start_ns + int(drive.number * config.drive_interval_s * 1e9)
        time += int(k * np.mean(config.spacing_m) / _SPEED_MPS * 1e9)
        epoch = 0 if drive.role == OUTDATED else int(np.searchsorted(self.epochs, time, side="right")) - 1
        shadows = _shadows(key, config, noise)
        found = observe_map(self.map_indices[epoch], noise, pose, shadows, key, self.buffers)
        reported_pose, covariance = self._perturb_pose(drive, key, pose)
        elements = self._elements(found)
        if drive.role == MALICIOUS:
            elements = self._displace_elements(elements, drive, pose[2])
        view = np.array(
            [
                [noise.x_min, noise.y_min],
                [noise.x_max, noise.y_min],
                [noise.x_max, noise.y_max],
                [noise.x_min, noise.y_max],
            ]
        )
        observation = Observation(
            agent=drive.name,
            pass_id=f"{drive.name}-p{drive.number:05d}",
            time_ns=time,
            pose=reported_pose,
            covariance=covariance,
            view=view,
            elements=elements,
            model=config.model,
            trusted=drive.role == INFRASTRUCTURE,
            occluders=Polygons.of(list(shadows)),
        )
        return observation, self.buffers.columns[:found, COLUMN_NAME].astype(np.int64)

    def _elements(self, found: int) -> MapElements:
        count = self.config.points_per_element
        return MapElements(
            kind=self.buffers.columns[:found, COLUMN_KIND].astype(np.int64),
            offsets=np.arange(found + 1, dtype=np.int64) * count,
            points=self.buffers.points[:found].reshape(-1, 2).copy(),
            score=self.buffers.columns[:found, COLUMN_SCORE].copy(),
            sigma=np.repeat(np.maximum(self.buffers.columns[:found, COLUMN_SIGMA], 0.01), count),
            style=self.buffers.style[:found].copy(),
        )

    def _perturb_pose(self, drive: _Drive, key: np.uint64, pose: Array) -> tuple[Array, Array]:
        """Return the reported pose and its covariance."""
        c = self.config
        sigma = np.array([c.pose_sigma_m, c.pose_sigma_m, c.yaw_sigma_rad])
        if drive.role == INFRASTRUCTURE:
            sigma = np.zeros(3)
        own = np.array([hash_normal(key, _POSE, 0, j) for j in range(3)])
        common = np.array([hash_normal(drive.key, _POSE, 1, j) for j in range(3)])
        error = sigma * (np.sqrt(c.drive_error_fraction) * common + np.sqrt(1 - c.drive_error_fraction) * own)
        if drive.role == OUTLIER:
            error[:2] += _offset(_key(self.seed, drive.agent, "offset"), c.outlier_offset_m)
        min_sigma = np.array([_MIN_SIGMA_M, _MIN_SIGMA_M, _MIN_SIGMA_RAD])
        return pose + error, np.diag(np.maximum(sigma, min_sigma) ** 2)

    def _displace_elements(self, elements: MapElements, drive: _Drive, yaw: float) -> MapElements:
        """Displace elements of the chosen kinds by a vector in the world, the agent's own or the common one."""
        c = self.config
        whose = "all" if c.attack_mode == "colluding" else drive.agent
        x, y = _offset(_key(self.seed, whose, "lie"), c.malicious_offset_m)
        shift = np.array([x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)])
        chosen = np.isin(elements.kind, [KINDS.index(kind) for kind in c.malicious_kinds])
        return elements.with_points(elements.points + np.where(chosen[elements.element_of_point, None], shift, 0.0))


def _offset(key: np.uint64, size: tuple[float, float]) -> Array:
    """Return a vector (2,) of uniform direction whose length lies in a range."""
    length = size[0] + (size[1] - size[0]) * hash_uniform(key, _AGENT, 0, 0)
    angle = 2 * np.pi * hash_uniform(key, _AGENT, 0, 1)
    return length * np.array([np.cos(angle), np.sin(angle)])


def _index_map(changing_map: ChangingMap, time_ns: int) -> TrueMapIndex:
    rows = changing_map.rows_at(time_ns)
    elements = changing_map.elements.take(rows)
    lines = [elements.polyline(k) for k in range(len(elements))]
    style = elements.style.argmax(1).astype(np.int64) if len(elements) else np.zeros(0, np.int64)
    return build_map_index(lines, elements.kind, style, changing_map.element_name[rows])


def _shadows(key: np.uint64, config: CrowdConfig, noise: MapModelNoise) -> Array:
    """Return (Q, 4, 2) areas hidden by up to three vehicles on neighbouring lanes, anticlockwise, in the agent's frame."""
    quads = []
    reach = 2.0 * max(abs(noise.x_min), abs(noise.x_max), abs(noise.y_min), abs(noise.y_max))
    for j in range(3):
        if hash_uniform(key, _SHADOW, j, 0) >= config.occluders / 3:
            continue
        lane = (-7.0, -3.5, 3.5, 7.0)[int(4 * hash_uniform(key, _SHADOW, j, 1))]
        low, high = max(noise.x_min, -20.0), min(noise.x_max, 25.0)
        ahead = low + (high - low) * hash_uniform(key, _SHADOW, j, 2)
        half_x, half_y = _CAR_M[0] / 2, _CAR_M[1] / 2
        corners = np.array([[x, y] for x in (ahead - half_x, ahead + half_x) for y in (lane - half_y, lane + half_y)])
        # The vehicle is never over the agent, so its corners span less than half a turn about their middle's direction.
        middle = np.arctan2(lane, ahead)
        turn = (np.arctan2(corners[:, 1], corners[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
        right, left = corners[turn.argmin()], corners[turn.argmax()]
        far = [corner * reach / np.linalg.norm(corner) for corner in (right, left)]
        quads.append(np.stack((right, far[0], far[1], left)))
    return np.array(quads).reshape(-1, 4, 2)


__all__ = ["ROLES", "Crowd", "simulate_crowd"]
