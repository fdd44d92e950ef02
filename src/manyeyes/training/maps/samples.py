# SPDX-License-Identifier: Apache-2.0
"""Make training tiles: an area that agents of a recording passed, some of their frames, and the ground truth map.

A map is static, so frames of any time and of other scenarios of the same town are combined. Source: CrowdMap sections 2.2 and 3.1
(ten random frames of a tile of 120 m by 60 m). The split is by town and asserted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datasets.base import Recording
from manyeyes.datasets.frame_reader import FrameReader, as_frame_reader
from manyeyes.datatypes import AgentFrame, BevGrid, Camera, CameraImage, ConfigError, Transform
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.evaluation.maps.curvature import measure_curved_length
from manyeyes.evaluation.maps.tiles import check_town_split, crop_to_tile, find_town, to_xy_yaw
from manyeyes.models.maps.map_model import FRAMES_PER_TILE, MapModelConfig
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.polyline import resample_spaced
from manyeyes.training.maps.bending import REACH_M, Bend, find_near_elements
from manyeyes.training.mirroring import mirror_factors, resize_cloud, resize_transform

Floats = NDArray[np.float64]
AgentKind = Literal["all", "vehicles", "roadside-units"]

MAX_DRAWS = 1000
"""Draws of a frame after which a recording has no agent of the wanted kind."""


@dataclass(frozen=True)
class MapSample:
    """One training tile.

    Attributes:
        frames: observations of agents.
        tile_from_agent: one transform per frame, from reported poses.
        truth: elements in the tile's frame.
        line_mask: (frames, kinds, rows, columns) bool, cells of each frame's tokens that an element passes through.
    """

    frames: tuple[AgentFrame, ...]
    tile_from_agent: Transform
    truth: MapElements
    line_mask: Tensor


class MapSamples(Protocol):
    """An endless, keyed stream of samples."""

    @property
    def towns(self) -> tuple[str, ...]:
        """Names of the towns of the samples."""
        ...

    def draw(self, number: int) -> MapSample:
        """Draw the sample of this number, deterministically."""
        ...


@dataclass(frozen=True)
class MapAugmentConfig:
    """Augmentation of a tile.

    Attributes:
        min_frames: minimum number of frames of a tile.
        max_frames: maximum number; the number is uniform.
        max_yaw_rad: maximum rotation of the tile against the heading of the central agent.
        max_shift_m: maximum longitudinal and lateral shift of its centre.
        sigma_xy_m: position error of reported poses.
        sigma_yaw_rad: heading error of reported poses.
        flip: mirror left to right with probability 0.5.
        bend_probability: of bending the tile; frames with images are not bent.
        max_curvature: of a bent tile, 1/m; it is uniform to both sides.
        curved_candidates: number of places that are drawn for a tile, of which the one with most curved dividers is taken, in
            half of the tiles; 1 takes the first.
        agents: kind of agents whose frames are taken.
    """

    min_frames: int = 1
    max_frames: int = FRAMES_PER_TILE
    max_yaw_rad: float = math.radians(15)
    max_shift_m: float = 15.0
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    flip: bool = True
    bend_probability: float = 0.0
    max_curvature: float = 1 / 50
    curved_candidates: int = 1
    agents: AgentKind = "all"

    def takes(self, frame: AgentFrame) -> bool:
        """Return whether the frame is of the wanted kind of agent."""
        return self.agents == "all" or frame.is_infrastructure == (self.agents == "roadside-units")


@dataclass(frozen=True)
class TileStream:
    """Tiles of a recording. maps: ground truth of each town, world frame. held_out: evaluation towns, which must not
    occur.
    """

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
        """Names of the towns of all scenarios."""
        return tuple(sorted({self._town(s) for s in self.recording.scenarios}))

    def _town(self, scenario: str) -> str:
        return find_town(scenario, tuple(self.maps))

    @cached_property
    def _frames(self) -> FrameReader:
        return as_frame_reader(self.recording)

    @cached_property
    def _places(self) -> tuple[tuple[str, int, Floats], ...]:
        """Scenario, row and initial position (2,), world frame, of every agent of the wanted kind."""
        return tuple(
            (scenario, row, frame.world_from_agent.translation[:2].numpy())
            for scenario in self.recording.scenarios
            for row, frame in enumerate(self.recording.snapshot(scenario, 0).frames)
            if self.augment.takes(frame)
        )

    def draw(self, number: int) -> MapSample:
        """Draw a tile around a uniform scenario, frame and agent, and frames of it, roadside units first."""
        rng, augment = keyed_generator("tile", self.seed, number), self.augment
        places = [self._draw_place(rng)]
        if augment.curved_candidates > 1 and rng.random() < 0.5:
            places += [self._draw_place(rng) for _ in range(augment.curved_candidates - 1)]
        scenario, own, world_from_tile = max(places, key=self._measure_curves) if len(places) > 1 else places[0]
        num_frames = int(rng.integers(augment.min_frames, augment.max_frames + 1))
        middle = world_from_tile.translation[:2].numpy()
        frames = [own, *self._sample_frames(scenario, middle, num_frames - 1, rng)]
        return self._sample(scenario, world_from_tile, frames, rng)

    def _draw_place(self, rng: np.random.Generator) -> tuple[str, AgentFrame, Transform]:
        """Draw a scenario, a frame of an agent, and a tile around it (world_from_tile)."""
        augment = self.augment
        scenario, own = self._draw_frame(rng)
        turn = float(own.world_from_agent.yaw) + augment.max_yaw_rad * rng.uniform(-1, 1)
        shift = augment.max_shift_m * rng.uniform(-1, 1, 2)
        middle = own.world_from_agent.translation[:2].numpy() + shift
        return scenario, own, Transform.from_xyz_yaw(float(middle[0]), float(middle[1]), 0.0, turn)

    def _draw_frame(self, rng: np.random.Generator) -> tuple[str, AgentFrame]:
        """Draw a uniform scenario, frame and agent, again until the agent is of the wanted kind."""
        scenarios = self.recording.scenarios
        for _ in range(MAX_DRAWS):
            scenario = scenarios[int(rng.integers(len(scenarios)))]
            index = int(rng.integers(self.recording.length(scenario)))
            present = self._frames.present_agents(scenario, index)
            own = self._frames.frame(scenario, index, present[int(rng.integers(len(present)))])
            if self.augment.takes(own):
                return scenario, own
        raise ConfigError(
            f"{MAX_DRAWS} frames of the recording have no {self.augment.agents}; give one that has, or set augment.agents to all."
        )

    def _measure_curves(self, place: tuple[str, AgentFrame, Transform]) -> float:
        scenario, _, world_from_tile = place
        return measure_curved_length(
            crop_to_tile(self.maps[self._town(scenario)], world_from_tile, self.map_model.tile)
        )

    def _sample_frames(self, scenario: str, middle: Floats, count: int, rng: np.random.Generator) -> list[AgentFrame]:
        """Draw frames of nearby agents, each at its own instant; one of a roadside unit first, where there is one."""
        town, reach = self._town(scenario), self.map_model.tile.x_max + self.map_model.bev.grid.x_max / 2
        near = [(s, row) for s, row, at in self._places if self._town(s) == town and np.hypot(*(at - middle)) <= reach]
        order = rng.permutation(len(near))
        # In half of the tiles, agents of the same scenario come first, as in traffic.
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
        can_bend = augment.bend_probability > 0 and not any(frame.images for frame in frames)
        if can_bend and rng.random() < augment.bend_probability:
            bend = Bend(float(augment.max_curvature * rng.uniform(0.1, 1) * rng.choice((-1.0, 1.0))))
            near = find_near_elements(world.transform(*to_xy_yaw(tile_from_world)), 3 * REACH_M)
            world, world_from_tile = bend.bend_elements(near), Transform.identity()
            frames = [bend.bend_frame(frame, tile_from_world @ frame.world_from_agent) for frame in frames]
            tile_from_world = world_from_tile
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
                [resize_transform(motion, 1.0, flip=True) for motion in reported],
            )
            truth, *local_elements = (_mirrored_elements(elements) for elements in (truth, *local_elements))
        line_mask = torch.stack(
            [rasterise_elements(elements, config.bev.token_grid, config.head.kinds) for elements in local_elements]
        )
        return MapSample(tuple(frames), Transform.stack(reported), truth, line_mask)


def rasterise_elements(elements: MapElements, grid: BevGrid, kinds: Sequence[str]) -> Tensor:
    """Rasterise elements in the grid's frame to (kinds, rows, columns) bool; crossings are filled."""
    rows, columns = grid.shape
    out = torch.zeros(len(kinds), rows, columns, dtype=torch.bool, device="cpu")
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
    """Return grid points (Q, 2) inside a ring (K, 2), by the even-odd rule, and its vertices."""
    low, high = ring.min(0), ring.max(0)
    axes = [np.arange(a, b + step_m, step_m) for a, b in zip(low, high)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    inside = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0)):
        spans = (ay > points[:, 1]) != (by > points[:, 1])
        inside ^= spans & (points[:, 0] < ax + (points[:, 1] - ay) / (by - ay if by != ay else 1.0) * (bx - ax))
    return np.concatenate((points[inside], ring))


_MIRROR = mirror_factors(True, torch.float64)


def mirror_frame(frame: AgentFrame) -> AgentFrame:
    """Mirror a frame left to right: its cloud, its cameras and their images."""
    cloud = resize_cloud(frame.points, 1.0, flip=True)
    return replace(frame, points=cloud, images=tuple(_mirrored_image(image) for image in frame.images))


def _mirrored_image(image: CameraImage) -> CameraImage:
    """Return the image of the mirrored camera in the mirrored world: columns swapped, right-handed axes."""
    camera, pose = image.camera, image.camera.agent_from_camera
    # Mirrored in the agent's y and in the camera's x: two mirrors are a rotation.
    rotation = _MIRROR[:, None] * pose.rotation * pose.rotation.new_tensor([-1.0, 1.0, 1.0])
    intrinsic = camera.intrinsic.clone()
    intrinsic[0, 2] = camera.width - intrinsic[0, 2]
    placed = Camera(intrinsic, Transform(rotation, pose.translation * _MIRROR), camera.width, camera.height)
    return CameraImage(placed, image.rgb.flip(-1))


def _mirrored_elements(elements: MapElements) -> MapElements:
    return elements.with_points(elements.points * [1.0, -1.0])
