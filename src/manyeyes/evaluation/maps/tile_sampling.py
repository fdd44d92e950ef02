# SPDX-License-Identifier: Apache-2.0
"""Which looks a tile is drawn from, seed by seed: a crowd's, those that meet at one instant, or one agent's own.

A map stands still, so looks of any time at a place, of other scenarios of the town too, are looks at the same thing (CrowdMap
section 3.1: random scans of vehicles and infrastructure). Of a crowd, looks that newly cover more of the tile come more often and
sooner (specs: maps.md 1.5), judged by rectangles on the ground and not by the truth; the first is the agent's own, about whom the
tile lies, and a smaller number of looks takes the first of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.map_perception import SURVEYS
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, BevGrid, Snapshot, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tiles import Tile, cut_to, planar, town_of
from manyeyes.ops.keyed_random import keyed_generator

Floats = NDArray[np.float64]

LEAST_COVER, RASTER_M = 0.1, 2.0
"""The share of a tile below which a look is none at it, and the raster on which shares are counted."""


@dataclass(frozen=True)
class Stand:
    """Where an agent is when its scenario's first judged frame comes: x, y, yaw in the world. row: among the agents."""

    scenario: str
    row: int
    pose: tuple[float, float, float]


def stands_of(recording: Recording) -> tuple[Stand, ...]:
    """Every agent of every scenario."""
    return tuple(
        Stand(scenario, row, planar(frame.world_from_agent))
        for scenario in recording.scenarios
        for row, frame in enumerate(recording.snapshot(scenario, recording.judged(scenario)[0]).frames)
    )


@dataclass(frozen=True, eq=False)
class Scenery:
    """A recording, the true map of each town in its world frame, and where everybody stands."""

    recording: Recording
    maps: Mapping[str, MapElements]
    stands: tuple[Stand, ...]

    def truth(self, scenario: str, world_from_tile: Transform, tile: BevGrid) -> MapElements:
        """What truly lies in a tile, in its frame."""
        return cut_to(self.maps[town_of(scenario, tuple(self.maps))], world_from_tile, tile)

    def instant(self, scenario: str, rng: np.random.Generator) -> Snapshot:
        """A judged snapshot of a scenario, each as likely as any."""
        return self.recording.snapshot(scenario, int(rng.choice(self.recording.judged(scenario))))


def crowd_tile(scenery: Scenery, scenario: str, seed: int, looks: int, tile: BevGrid, view: BevGrid) -> Tile:
    """The tile about a scenario's first agent at an instant of the seed, and at most so many looks at it.

    view: the ground that a look covers, in its agent's frame.
    """
    rng = keyed_generator("crowd", seed, scenario)
    own = scenery.instant(scenario, rng).frames[0]
    world_from_tile = upright(own)
    town = town_of(scenario, tuple(scenery.maps))
    others = [
        stand
        for stand in scenery.stands
        if (stand.scenario, stand.row) != (scenario, 0) and town_of(stand.scenario, tuple(scenery.maps)) == town
    ]
    frames = [own]
    for k in covering(covers([planar(own.world_from_agent), *(s.pose for s in others)], own, tile, view), looks, rng):
        seen = scenery.instant(others[k].scenario, rng).frames
        frames.append(seen[min(others[k].row, len(seen) - 1)])
    return Tile(scenario, world_from_tile, tuple(frames), scenery.truth(scenario, world_from_tile, tile))


def meeting(scenery: Scenery, scenario: str, seed: int) -> Snapshot:
    """The instant of a seed at which the agents of one scenario meet."""
    return scenery.instant(scenario, keyed_generator("meeting", seed, scenario))


def local_tile(scenery: Scenery, snapshot: Snapshot, row: int) -> tuple[Tile, BevGrid]:
    """What lies ahead of one agent, from its own look alone: 30 m by 30 m of a vehicle, 50 m by 30 m of a roadside unit."""
    frame = snapshot.frames[row]
    x0, y0, x1, y1 = SURVEYS["local"].window(frame)
    window = BevGrid(x0, y0, -5.0, x1, y1, 5.0, pillar=1.0)
    world_from_tile = upright(frame)
    truth = scenery.truth(snapshot.scenario, world_from_tile, window)
    return Tile(snapshot.scenario, world_from_tile, (frame,), truth), window


def upright(frame: AgentFrame) -> Transform:
    """The tile's frame about an agent: where it claims to be, on the ground, along its heading."""
    x, y, yaw = planar(frame.world_from_agent)
    return Transform.from_xyz_yaw(x, y, 0.0, yaw)


def covers(poses: Sequence[tuple[float, float, float]], about: AgentFrame, tile: BevGrid, view: BevGrid) -> np.ndarray:
    """(N, raster) bool: which places of the tile about an agent lie in the view from each pose."""
    axes = [np.arange(a + RASTER_M / 2, b, RASTER_M) for a, b in ((tile.x_min, tile.x_max), (tile.y_min, tile.y_max))]
    x0, y0, yaw0 = planar(about.world_from_agent)
    at = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2) @ _turn(yaw0).T + [x0, y0]
    out = np.zeros((len(poses), len(at)), bool)
    for k, (x, y, yaw) in enumerate(poses):
        local = (at - [x, y]) @ _turn(yaw)
        out[k] = ((local >= [view.x_min, view.y_min]) & (local <= [view.x_max, view.y_max])).all(1)
    return out


def covering(seen: np.ndarray, looks: int, rng: np.random.Generator) -> list[int]:
    """Which others join the first row of views (1 + N, raster), in order: the more likely the more they newly cover.

    When nothing is left to cover, each is as likely as any. Those that cover less than LEAST_COVER never come.
    """
    covered, views = seen[0].copy(), seen[1:]
    left = np.flatnonzero(views.mean(1) >= LEAST_COVER) if len(views) else np.zeros(0, np.int64)
    order: list[int] = []
    while len(left) and len(order) < looks - 1:
        gain = (views[left] & ~covered).sum(1).astype(np.float64)
        share = gain / gain.sum() if gain.any() else None
        k = int(rng.choice(left, p=share))
        order.append(k)
        covered |= views[k]
        left = left[left != k]
    return order


def _turn(yaw: float) -> Floats:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
