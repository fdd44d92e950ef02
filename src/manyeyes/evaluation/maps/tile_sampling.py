# SPDX-License-Identifier: Apache-2.0
"""Sample the frames of a tile by seed: of a fleet, of the agents of one snapshot, or of one agent.

A map is static, so frames of any time and of other scenarios of the town observe the same elements (CrowdMap, section 3.1: random
scans of vehicles and infrastructure). Frames of a fleet are drawn with weights: those that newly cover more of the tile are drawn
more often and earlier. Coverage is measured by rectangles on the ground, not by the truth. The first frame is that of the agent at
the centre of the tile; a smaller number of frames takes the first ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.map_perception import MAP_MODES
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, BevGrid, Snapshot, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tiles import Tile, crop_to_tile, find_town, to_xy_yaw
from manyeyes.ops.keyed_random import keyed_generator

Floats = NDArray[np.float64]

MIN_COVERAGE, RASTER_SIZE_M = 0.1, 2.0
"""The fraction of a tile that a frame covers at least, and the cell size for counting it."""


@dataclass(frozen=True)
class ObserverPose:
    """Where an agent is when its scenario's first evaluated frame comes: x, y, yaw in the world. row: among the agents."""

    scenario: str
    row: int
    pose: tuple[float, float, float]


def collect_observer_poses(recording: Recording) -> tuple[ObserverPose, ...]:
    """Return every agent of every scenario."""
    return tuple(
        ObserverPose(scenario, row, to_xy_yaw(frame.world_from_agent))
        for scenario in recording.scenarios
        for row, frame in enumerate(recording.snapshot(scenario, recording.eval_indices(scenario)[0]).frames)
    )


@dataclass(frozen=True, eq=False)
class TileSource:
    """A recording, the true map of each town in its world frame, and where everybody stands."""

    recording: Recording
    maps: Mapping[str, MapElements]
    observer_poses: tuple[ObserverPose, ...]

    def crop_truth(self, scenario: str, world_from_tile: Transform, tile: BevGrid) -> MapElements:
        """What truly lies in a tile, in its frame."""
        return crop_to_tile(self.maps[find_town(scenario, tuple(self.maps))], world_from_tile, tile)

    def sample_snapshot(self, scenario: str, rng: np.random.Generator) -> Snapshot:
        """Return an evaluated snapshot of a scenario, each as likely as any."""
        return self.recording.snapshot(scenario, int(rng.choice(self.recording.eval_indices(scenario))))


def sample_fleet_tile(
    source: TileSource, scenario: str, seed: int, max_frames: int, tile: BevGrid, view_area: BevGrid
) -> Tile:
    """Return the tile about a scenario's first agent at an index drawn from the seed, with at most max_frames frames.

    view_area: the ground that a frame covers, in its agent's frame.
    """
    rng = keyed_generator("crowd", seed, scenario)
    own_frame = source.sample_snapshot(scenario, rng).frames[0]
    world_from_tile = make_world_from_tile(own_frame)
    town = find_town(scenario, tuple(source.maps))
    others = [
        observer
        for observer in source.observer_poses
        if (observer.scenario, observer.row) != (scenario, 0)
        and find_town(observer.scenario, tuple(source.maps)) == town
    ]
    frames = [own_frame]
    for k in select_by_coverage(
        compute_coverage(
            [to_xy_yaw(own_frame.world_from_agent), *(s.pose for s in others)], own_frame, tile, view_area
        ),
        max_frames,
        rng,
    ):
        snapshot_frames = source.sample_snapshot(others[k].scenario, rng).frames
        frames.append(snapshot_frames[min(others[k].row, len(snapshot_frames) - 1)])
    return Tile(scenario, world_from_tile, tuple(frames), source.crop_truth(scenario, world_from_tile, tile))


def sample_meeting(source: TileSource, scenario: str, seed: int) -> Snapshot:
    """Return the instant of a seed at which the agents of one scenario meet."""
    return source.sample_snapshot(scenario, keyed_generator("meeting", seed, scenario))


def make_local_tile(source: TileSource, snapshot: Snapshot, row: int) -> tuple[Tile, BevGrid]:
    """Make the tile of one agent's own frame: 30 m by 30 m ahead of a vehicle, 50 m by 30 m ahead of a roadside unit."""
    frame = snapshot.frames[row]
    x0, y0, x1, y1 = MAP_MODES["local"].window(frame)
    window = BevGrid(x0, y0, -5.0, x1, y1, 5.0, pillar=1.0)
    world_from_tile = make_world_from_tile(frame)
    truth = source.crop_truth(snapshot.scenario, world_from_tile, window)
    return Tile(snapshot.scenario, world_from_tile, (frame,), truth), window


def make_world_from_tile(frame: AgentFrame) -> Transform:
    """Return the tile's frame about an agent: at its prior pose, on the ground, along its heading."""
    x, y, yaw = to_xy_yaw(frame.world_from_agent)
    return Transform.from_xyz_yaw(x, y, 0.0, yaw)


def compute_coverage(
    poses: Sequence[tuple[float, float, float]], center_frame: AgentFrame, tile: BevGrid, view_area: BevGrid
) -> np.ndarray:
    """Return (N, raster) bool: which places of the tile about an agent lie in the view from each pose."""
    axes = [
        np.arange(a + RASTER_SIZE_M / 2, b, RASTER_SIZE_M)
        for a, b in ((tile.x_min, tile.x_max), (tile.y_min, tile.y_max))
    ]
    x0, y0, yaw0 = to_xy_yaw(center_frame.world_from_agent)
    raster_xy = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2) @ _rotation_matrix(yaw0).T + [x0, y0]
    out = np.zeros((len(poses), len(raster_xy)), bool)
    for k, (x, y, yaw) in enumerate(poses):
        local = (raster_xy - [x, y]) @ _rotation_matrix(yaw)
        out[k] = ((local >= [view_area.x_min, view_area.y_min]) & (local <= [view_area.x_max, view_area.y_max])).all(1)
    return out


def select_by_coverage(coverage: np.ndarray, max_frames: int, rng: np.random.Generator) -> list[int]:
    """Return which others join the first row of views (1 + N, raster), in order: the more likely the more they newly cover.

    When nothing is left to cover, each is as likely as any. Those that cover less than LEAST_COVER never come.
    """
    covered, candidates = coverage[0].copy(), coverage[1:]
    remaining = np.flatnonzero(candidates.mean(1) >= MIN_COVERAGE) if len(candidates) else np.zeros(0, np.int64)
    order: list[int] = []
    while len(remaining) and len(order) < max_frames - 1:
        gain = (candidates[remaining] & ~covered).sum(1).astype(np.float64)
        probability = gain / gain.sum() if gain.any() else None
        k = int(rng.choice(remaining, p=probability))
        order.append(k)
        covered |= candidates[k]
        remaining = remaining[remaining != k]
    return order


def _rotation_matrix(yaw: float) -> Floats:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
