# SPDX-License-Identifier: Apache-2.0
"""Tiles to learn from: a place that agents of a recording drove by, some of their looks at it, and the true map there.

A map stands still, so looks of any time at a place are looks at the same thing: those of other scenarios of the town count as well.
Source of the protocol: CrowdMap sections 2.2 and 3.1 (ten random looks at a tile of 120 m by 60 m); what it leaves open is chosen
in specs: maps.md 1.5. Split by town, asserted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datasets.base import Recording
from manyeyes.datasets.frame_reader import FrameReader, as_frame_reader
from manyeyes.datatypes import AgentFrame, BevGrid, Camera, CameraImage, Transform
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.evaluation.maps.tiles import check_town_split, crop_to_tile, find_town
from manyeyes.models.maps.map_model import FRAMES_PER_TILE, MapModelConfig
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.polyline import resample_spaced

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MapSample:
    """One tile. frames: frames as they were seen; tile_from_agent: one motion each, by claimed poses.

    truth: in the tile's frame. line_mask: (looks, kinds, rows, columns) bool, where elements run through the cells of each look's
    tokens.
    """

    frames: tuple[AgentFrame, ...]
    tile_from_agent: Transform
    truth: MapElements
    line_mask: Tensor


class MapSamples(Protocol):
    """An endless, keyed stream of samples."""

    @property
    def towns(self) -> tuple[str, ...]:
        """Whose maps the samples show."""
        ...

    def draw(self, number: int) -> MapSample:
        """Sample of that number, the same whenever it is drawn."""
        ...


@dataclass(frozen=True)
class MapAugmentConfig:
    """min_frames, max_frames: looks at a tile, uniform. max_yaw_rad: of the tile against the heading of the agent it is put about;
    max_shift_m: of its middle, along and across. sigma_xy_m, sigma_yaw_rad: of the error of claimed poses; flip: mirrored left to
    right half of the time.
    """

    min_frames: int = 1
    max_frames: int = FRAMES_PER_TILE
    max_yaw_rad: float = math.radians(15)
    max_shift_m: float = 15.0
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    flip: bool = True


@dataclass(frozen=True)
class TileStream:
    """Tiles of a recording. maps: the truth of each town, world frame. held_out: towns that later judge, which may not be here."""

    recording: Recording
    maps: Mapping[str, MapElements]
    map_model: MapModelConfig
    augment: MapAugmentConfig
    seed: int
    held_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_town_split(self.towns, self.held_out)

    @property
    def towns(self) -> tuple[str, ...]:
        """The towns of all scenarios."""
        return tuple(sorted({self._town(s) for s in self.recording.scenarios}))

    def _town(self, scenario: str) -> str:
        return find_town(scenario, tuple(self.maps))

    @cached_property
    def _frames(self) -> FrameReader:
        return as_frame_reader(self.recording)

    @cached_property
    def _places(self) -> dict[str, Floats]:
        """(agents, 2) where the agents of each scenario begin, world."""
        first = {s: self.recording.snapshot(s, 0).frames for s in self.recording.scenarios}
        return {
            s: np.array([f.world_from_agent.translation[:2].tolist() for f in frames]) for s, frames in first.items()
        }

    def draw(self, number: int) -> MapSample:
        """A scenario, a frame and an agent, all uniform; a tile about it; looks at it, of poles before those of others."""
        rng, augment = keyed_generator("tile", self.seed, number), self.augment
        scenarios = self.recording.scenarios
        scenario = scenarios[int(rng.integers(len(scenarios)))]
        index = int(rng.integers(self.recording.length(scenario)))
        present = self._frames.present_agents(scenario, index)
        own = self._frames.frame(scenario, index, present[int(rng.integers(len(present)))])
        turn = float(own.world_from_agent.yaw) + augment.max_yaw_rad * rng.uniform(-1, 1)
        shift = augment.max_shift_m * rng.uniform(-1, 1, 2)
        middle = own.world_from_agent.translation[:2].numpy() + shift
        world_from_tile = Transform.from_xyz_yaw(float(middle[0]), float(middle[1]), 0.0, turn)
        num_frames = int(rng.integers(augment.min_frames, augment.max_frames + 1))
        frames = [own, *self._sample_frames(scenario, middle, num_frames - 1, rng)]
        return self._sample(scenario, world_from_tile, frames, rng)

    def _sample_frames(self, scenario: str, middle: Floats, count: int, rng: np.random.Generator) -> list[AgentFrame]:
        """So many looks of agents that were near, each at an instant of its own; a pole's first, where there is one."""
        town, reach = self._town(scenario), self.map_model.tile.x_max + self.map_model.bev.grid.x_max / 2
        near = [
            (s, row)
            for s, places in self._places.items()
            if self._town(s) == town
            for row in np.flatnonzero(np.hypot(*(places - middle).T) <= reach).tolist()
        ]
        order = rng.permutation(len(near))
        # The agents of this very scenario first in half of the tiles: so do drivers meet.
        if rng.random() < 0.5:
            order = sorted(order.tolist(), key=lambda k: near[k][0] != scenario)
        found: list[AgentFrame] = []
        while near and len(found) < count:
            for k in order[: count - len(found)]:
                s, row = near[int(k)]
                index = int(rng.integers(self.recording.length(s)))
                present = self._frames.present_agents(s, index)
                found.append(self._frames.frame(s, index, present[min(row, len(present) - 1)]))
        return sorted(found, key=lambda frame: not frame.is_infrastructure)

    def _sample(
        self, scenario: str, world_from_tile: Transform, frames: Sequence[AgentFrame], rng: np.random.Generator
    ) -> MapSample:
        augment, config = self.augment, self.map_model
        world = self.maps[self._town(scenario)]
        tile_from_world = world_from_tile.inverse()
        reported, local_elements = [], []
        for frame in frames:
            dx, dy, turn = rng.normal(size=3) * [augment.sigma_xy_m, augment.sigma_xy_m, augment.sigma_yaw_rad]
            error = Transform.from_xyz_yaw(float(dx), float(dy), 0.0, float(turn))
            reported.append(tile_from_world @ frame.world_from_agent @ error)
            local_elements.append(crop_to_tile(world, frame.world_from_agent, config.bev.grid))
        truth = crop_to_tile(world, world_from_tile, config.tile)
        if augment.flip and rng.random() < 0.5:
            frames, reported = (
                [mirror_frame(frame) for frame in frames],
                [mirror_transform(motion) for motion in reported],
            )
            truth, *local_elements = (_mirrored_elements(elements) for elements in (truth, *local_elements))
        line_mask = torch.stack(
            [rasterise_elements(elements, config.bev.token_grid, config.head.kinds) for elements in local_elements]
        )
        return MapSample(tuple(frames), Transform.stack(reported), truth, line_mask)


def rasterise_elements(elements: MapElements, grid: BevGrid, kinds: Sequence[str]) -> Tensor:
    """(kinds, rows, columns) bool: the cells of a grid that elements of each kind, in its frame, run through; crossings filled."""
    rows, columns = grid.shape
    out = torch.zeros(len(kinds), rows, columns, dtype=torch.bool)
    for layer, kind in enumerate(kinds):
        own = elements.take(elements.kind == KINDS.index(kind))
        if len(own):
            if KINDS.index(kind) == CROSSING:
                points = np.concatenate([_filled(own.polyline(i), grid.cell_size_m / 2) for i in range(len(own))])
            else:
                points = resample_spaced(own.points, own.offsets, grid.cell_size_m / 2)[0]
            xy = torch.from_numpy(points)
            yx = grid.cells(xy[grid.contains(xy)])
            out[layer, yx[:, 0], yx[:, 1]] = True
    return out


def _filled(ring: Floats, step_m: float) -> Floats:
    """(Q, 2) points of a lattice within a ring (K, 2), by the even-odd rule, and its corners."""
    low, high = ring.min(0), ring.max(0)
    axes = [np.arange(a, b + step_m, step_m) for a, b in zip(low, high)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    inside = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0)):
        spans = (ay > points[:, 1]) != (by > points[:, 1])
        inside ^= spans & (points[:, 0] < ax + (points[:, 1] - ay) / (by - ay if by != ay else 1.0) * (bx - ax))
    return np.concatenate((points[inside], ring))


_MIRROR = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)


def mirror_frame(frame: AgentFrame) -> AgentFrame:
    """The look seen in a mirror: left is right in its frame, its cloud, its cameras and their pictures."""
    cloud = replace(frame.points, xyz=frame.points.xyz * _MIRROR.to(frame.points.xyz.dtype))
    return replace(frame, points=cloud, images=tuple(_mirrored_image(image) for image in frame.images))


def _mirrored_image(image: CameraImage) -> CameraImage:
    """What a camera on the other side would have taken of a mirrored world: columns swapped, and no axis of it the wrong way."""
    camera, pose = image.camera, image.camera.agent_from_camera
    # Mirrored in the agent's y and in the camera's x: two mirrors are a rotation.
    rotation = _MIRROR[:, None] * pose.rotation * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    intrinsic = camera.intrinsic.clone()
    intrinsic[0, 2] = camera.width - intrinsic[0, 2]
    placed = Camera(intrinsic, Transform(rotation, pose.translation * _MIRROR), camera.width, camera.height)
    return CameraImage(placed, image.rgb.flip(-1))


def mirror_transform(motion: Transform) -> Transform:
    """The motion between two frames that are both mirrored."""
    return Transform(_MIRROR[:, None] * motion.rotation * _MIRROR, motion.translation * _MIRROR)


def _mirrored_elements(elements: MapElements) -> MapElements:
    return elements.with_points(elements.points * [1.0, -1.0])
