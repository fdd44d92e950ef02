# SPDX-License-Identifier: Apache-2.0
"""A fleet drives through a place and says what its map models saw: observations, and apart from them what was true.

Everything is a function of (seed, agent, pass, look): the first n observations of a longer crowd are the crowd of n, and a draw
is the same at every noise level, which only scales it.
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
from manyeyes.simulator.fleet.changing_map import Change, World
from manyeyes.simulator.fleet.config import CROWDS, CrowdConfig
from manyeyes.simulator.fleet.observation_model import (
    COLUMN_KIND,
    COLUMN_NAME,
    COLUMN_SCORE,
    COLUMN_SIGMA,
    MOST,
    Noise,
    Room,
    Scenery,
    look,
    normal,
    scenery,
    unit,
)
from manyeyes.simulator.fleet.place import Place
from manyeyes.simulator.fleet.routes import along

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROLES = ("honest", "outlier", "malicious", "stale", "pole")
HONEST, OUTLIER, MALICIOUS, STALE, POLE = range(len(ROLES))

_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.05, np.radians(0.05)
_SPEED_MPS = 10.0
_TURNS = np.array([5**0.5 - 1, 2**1.5 - 2, 2 * 3**0.5 - 2]) / 2
# Places of draws that belong to a look, an agent or a pass and to no element.
_POSE, _PASS, _AGENT, _SHADOW = 2**40, 2**40 + 1, 2**40 + 2, 2**40 + 3
_CAR_M = (4.6, 1.9)


@dataclass(frozen=True, eq=False)
class Crowd:
    """N observations, and what nobody who perceives is told.

    true_poses: (N, 3) x, y, yaw. roles: (N,) index into ROLES. origin: the true element (index in Place.truth) that each observed
    element shows, -1 for none: observation i has ``origin[origin_first[i]:origin_first[i + 1]]``. world: the true map in time.
    """

    observations: tuple[Observation, ...]
    true_poses: Array
    roles: Indices
    origin: Indices
    origin_first: Indices
    world: World
    place: Place

    def __len__(self) -> int:
        return len(self.observations)


@dataclass(frozen=True)
class _Pass:
    """One drive: who (number and pseudonym), its place among passes, its role, its true poses (K, 3) and its key."""

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
    """``count`` observations of a place; progress is called with (done, count) after each pass."""
    if count < 0:
        raise ConfigError(f"A crowd has 0 observations or more; got {count}.")
    world = World.of(place.truth, changes)
    looker = _Looker(world, config, seed)
    observations: list[Observation] = []
    poses: list[Array] = []
    roles: list[int] = []
    origins: list[Indices] = []
    for drive in _passes(place, config, seed):
        for k, pose in enumerate(drive.poses):
            if len(observations) < count:
                observation, origin = looker.observation(drive, k, pose)
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
        world,
        place,
    )


def _passes(place: Place, config: CrowdConfig, seed: int) -> Iterator[_Pass]:
    """Drives without end, in the order of time."""
    if not len(place.routes):
        raise ConfigError(f"{place.name}: no lane leads through its area; take a larger size_m.")
    share = np.cumsum(place.routes.lengths)
    offsets = keyed_uniform((3,), seed, "crowd", "roles").numpy()
    poles = _pole_sites(place) if config.pole_share > 0 else np.zeros((0, 3))
    number = 0
    while True:
        agent = number // config.passes_per_agent
        key = _key(seed, agent, number)
        role = _role(agent, config, offsets)
        name = f"s{seed}-a{agent:05d}"
        if len(poles) and unit(key, _PASS, 0, 8) < config.pole_share:
            site = int(unit(key, _PASS, 0, 9) * len(poles))
            role, name = POLE, f"s{seed}-pole{site:03d}"
            drawn = np.repeat(poles[[site]], config.per_pass, axis=0)
        else:
            drawn = _looks(_path(place, config, key, share), place.area, config, key)
        if len(drawn):
            yield _Pass(agent, name, number, role, drawn, key)
        number += 1


def _key(*parts: int | str) -> np.uint64:
    return np.uint64(int(keyed_uniform((1,), *parts[:1], "crowd", *parts[1:])[0] * 2.0**52))


def _role(agent: int, config: CrowdConfig, offsets: Array) -> int:
    """Shares of agents by additive sequences: near exact among any first agents, and nested when a share grows."""
    turn = (agent * _TURNS + offsets) % 1.0
    if turn[0] < config.malicious_share:
        return MALICIOUS
    if turn[1] < config.outlier_share:
        return OUTLIER
    return STALE if turn[2] < config.stale_share else HONEST


def _path(place: Place, config: CrowdConfig, key: np.uint64, share: Array) -> Array:
    """Where one drive leads: a recorded one, or a walk over the lanes."""
    if place.logs and unit(key, _PASS, 0, 6) < config.log_share:
        log = place.logs[int(unit(key, _PASS, 0, 7) * len(place.logs))]
        fresh = np.concatenate(([True], np.linalg.norm(np.diff(log[:, :2], axis=0), axis=1) > 1e-3))
        return log[fresh, :2]
    start = unit(key, _PASS, 0, 0) * share[-1]
    lane = int(np.searchsorted(share, start, side="right"))
    longest = (config.per_pass + 1) * config.spacing[1]

    def choose(step: int, count: int) -> int:
        return int(unit(key, _PASS, step, 3) * count)

    return place.routes.walk(lane, start - (share[lane - 1] if lane else 0.0), longest, choose)


def _looks(path: Array, area: tuple[float, float, float, float], config: CrowdConfig, key: np.uint64) -> Array:
    """True poses (K, 3) of the looks of one drive: every spacing metres until it leaves the area or ends."""
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    low, high = config.spacing
    steps = [low + (high - low) * unit(key, _PASS, k, 1) for k in range(config.per_pass - 1)]
    at = np.concatenate(([unit(key, _PASS, 0, 2) * min(low, length)], steps)).cumsum()
    poses = along(path, at[at <= length])
    outside = (poses[:, 0] < area[0]) | (poses[:, 1] < area[1]) | (poses[:, 0] > area[2]) | (poses[:, 1] > area[3])
    poses = poses[: np.flatnonzero(outside)[0]] if outside.any() else poses
    for k in range(len(poses)):
        sway, swing = 0.25 * normal(key, _PASS, k, 4), np.radians(1.0) * normal(key, _PASS, k, 5)
        poses[k] += [-sway * np.sin(poses[k, 2]), sway * np.cos(poses[k, 2]), swing]
    return poses


def _pole_sites(place: Place) -> Array:
    """A pole beside each junction: on the corner of its bounding box nearest to the ground, looking at its middle."""
    sites = []
    for part in getattr(place.junctions, "geoms", [place.junctions]):
        x0, y0, x1, y1 = part.bounds
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        inside = place.area[0] <= middle[0] <= place.area[2] and place.area[1] <= middle[1] <= place.area[3]
        if inside and part.area > 50.0:
            corner = np.array([x1, y1]) if (x1 - x0) >= (y1 - y0) else np.array([x0, y1])
            sites.append([*corner, np.arctan2(*(middle - corner)[::-1])])
    return np.array(sites).reshape(-1, 3)


class _Looker:
    """Turns a look into an observation; holds the true map of each epoch and the room that the compiled loop writes to."""

    def __init__(self, world: World, config: CrowdConfig, seed: int) -> None:
        self.config, self.seed, self.epochs = config, seed, world.epochs
        self.scenes = [_scene(world, int(time)) for time in world.epochs]
        self.noise = self._noise(config.range_x, config.range_y)
        self.pole_noise = self._noise((0.0, config.pole_range), (-15.0, 15.0))
        self.room = Room(np.empty((MOST, config.points, 2)), np.empty((MOST, 4)), np.empty((MOST, len(STYLES))))

    def _noise(self, x: tuple[float, float], y: tuple[float, float]) -> Noise:
        c = self.config
        return Noise(
            x_min=float(x[0]),
            x_max=float(x[1]),
            y_min=float(y[0]),
            y_max=float(y[1]),
            drop_out=float(c.drop_out),
            false_positive=float(c.false_positive),
            fragment=float(c.fragment),
            confusion=float(c.confusion),
            point=float(c.point),
            point_per_m=float(c.point_per_m),
            bow=float(c.bow),
            end=float(c.end),
            style_error=float(c.style_error),
        )

    def observation(self, drive: _Pass, k: int, pose: Array) -> tuple[Observation, Indices]:
        """The k-th look of a drive at a true pose, and the true element of each of its elements."""
        config, noise = self.config, self.pole_noise if drive.role == POLE else self.noise
        key = _key(self.seed, drive.agent, drive.number, k)
        time = config.start_ns + int(drive.number * config.pass_interval_s * 1e9)
        time += int(k * np.mean(config.spacing) / _SPEED_MPS * 1e9)
        epoch = 0 if drive.role == STALE else int(np.searchsorted(self.epochs, time, side="right")) - 1
        shadows = _shadows(key, config, noise)
        found = look(self.scenes[epoch], noise, pose, shadows, key, self.room)
        claimed, covariance = self._claim(drive, key, pose)
        elements = self._elements(found)
        if drive.role == MALICIOUS:
            elements = self._lie(elements, drive, pose[2])
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
            pose=claimed,
            covariance=covariance,
            view=view,
            elements=elements,
            model=config.model,
            trusted=drive.role == POLE,
            occluders=Polygons.of(list(shadows)),
        )
        return observation, self.room.columns[:found, COLUMN_NAME].astype(np.int64)

    def _elements(self, found: int) -> MapElements:
        count = self.config.points
        return MapElements(
            kind=self.room.columns[:found, COLUMN_KIND].astype(np.int64),
            first=np.arange(found + 1, dtype=np.int64) * count,
            points=self.room.points[:found].reshape(-1, 2).copy(),
            score=self.room.columns[:found, COLUMN_SCORE].copy(),
            sigma=np.repeat(np.maximum(self.room.columns[:found, COLUMN_SIGMA], 0.01), count),
            style=self.room.style[:found].copy(),
        )

    def _claim(self, drive: _Pass, key: np.uint64, pose: Array) -> tuple[Array, Array]:
        """The claimed pose and its covariance."""
        c = self.config
        sigma = np.array([c.pose_sigma, c.pose_sigma, c.yaw_sigma])
        if drive.role == POLE:
            sigma = np.zeros(3)
        own = np.array([normal(key, _POSE, 0, j) for j in range(3)])
        common = np.array([normal(drive.key, _POSE, 1, j) for j in range(3)])
        error = sigma * (np.sqrt(c.pass_share) * common + np.sqrt(1 - c.pass_share) * own)
        if drive.role == OUTLIER:
            error[:2] += _offset(_key(self.seed, drive.agent, "offset"), c.outlier_offset)
        least = np.array([_LEAST_SIGMA_M, _LEAST_SIGMA_M, _LEAST_SIGMA_RAD])
        return pose + error, np.diag(np.maximum(sigma, least) ** 2)

    def _lie(self, elements: MapElements, drive: _Pass, yaw: float) -> MapElements:
        """Elements of the chosen kinds moved by a vector of the world, the agent's own or everyone's."""
        c = self.config
        whose = "all" if c.malicious == "colluding" else drive.agent
        x, y = _offset(_key(self.seed, whose, "lie"), c.malicious_offset)
        shift = np.array([x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)])
        chosen = np.isin(elements.kind, [KINDS.index(kind) for kind in c.malicious_kinds])
        return elements.with_points(elements.points + np.where(chosen[elements.owner, None], shift, 0.0))


def _offset(key: np.uint64, size: tuple[float, float]) -> Array:
    """A vector (2,) of any direction whose length lies in a range."""
    length = size[0] + (size[1] - size[0]) * unit(key, _AGENT, 0, 0)
    angle = 2 * np.pi * unit(key, _AGENT, 0, 1)
    return length * np.array([np.cos(angle), np.sin(angle)])


def _scene(world: World, time_ns: int) -> Scenery:
    rows = world.rows_at(time_ns)
    elements = world.elements.take(rows)
    lines = [elements.polyline(k) for k in range(len(elements))]
    style = elements.style.argmax(1).astype(np.int64) if len(elements) else np.zeros(0, np.int64)
    return scenery(lines, elements.kind, style, world.name[rows])


def _shadows(key: np.uint64, config: CrowdConfig, noise: Noise) -> Array:
    """(Q, 4, 2) what up to three vehicles on neighbouring lanes hide, anticlockwise, in the agent's frame."""
    quads = []
    reach = 2.0 * max(abs(noise.x_min), abs(noise.x_max), abs(noise.y_min), abs(noise.y_max))
    for j in range(3):
        if unit(key, _SHADOW, j, 0) >= config.occluders / 3:
            continue
        lane = (-7.0, -3.5, 3.5, 7.0)[int(4 * unit(key, _SHADOW, j, 1))]
        low, high = max(noise.x_min, -20.0), min(noise.x_max, 25.0)
        ahead = low + (high - low) * unit(key, _SHADOW, j, 2)
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
