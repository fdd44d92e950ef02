# SPDX-License-Identifier: Apache-2.0
"""A snapshot of a crossing for timings: five agents with OPV2V's sensor, needing neither towns nor a traffic simulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.lidar.intensity import INTENSITY_LAWS
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, HeightField, Primitives
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes, rotation_from_yaw_pitch
from manyeyes.simulator.sensors.lidar import RaycastScene, scan
from manyeyes.simulator.sensors.lidars import lidar_spec

CARS, BUILDINGS, POLES, TREES = 55, 40, 40, 50
ROAD_HALF_M = 8.0
LIDAR = replace(lidar_spec("opv2v"), intensity=INTENSITY_LAWS["material"])


def street(agents: int = 5, seed: int = 0) -> Snapshot:
    """Two roads that cross at the origin, cars on their lanes, houses, poles and trees beside them."""
    rng = keyed_generator("street", seed)
    position, yaw = _lanes(rng)
    sizes = np.stack([rng.uniform(4.0, 5.0, CARS), rng.uniform(1.7, 2.0, CARS), rng.uniform(1.4, 1.8, CARS)], 1)
    ids = np.arange(1, CARS + 1)
    zero = np.zeros(CARS)
    bodies = [make_vehicle_shape("car", (size[0], size[1], size[2]), seed, int(i)) for i, size in zip(ids, sizes)]
    scene = RaycastScene(
        Primitives.cat([place_vehicle_shapes(bodies, position, yaw, zero, ids), _clutter(rng)]), _flat()
    )
    center = torch.from_numpy(position + np.stack([zero, zero, sizes[:, 2] / 2], 1))
    boxes = Boxes.of(center, torch.from_numpy(sizes), torch.from_numpy(yaw), id=torch.from_numpy(ids))
    chosen = np.argsort(np.hypot(position[:, 0], position[:, 1]), kind="stable")[2 : 2 + 3 * agents : 3]
    frames, visible = [], []
    for i in chosen:
        pose = Transform(
            torch.from_numpy(rotation_from_yaw_pitch(yaw[i : i + 1], zero[:1])[0]), torch.from_numpy(position[i].copy())
        )
        cloud, instance = scan(scene, pose, LIDAR, ("street", seed, int(i)), own=int(ids[i]))
        frames.append(AgentFrame.of(cloud, pose, agent_id=int(ids[i])))
        visible.append(torch.from_numpy(np.isin(ids, instance)))
    truth = GroundTruth(boxes, torch.stack(visible), Transform.stack([f.world_from_agent for f in frames]))
    return Snapshot("street", 0, tuple(frames), truth)


def _lanes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions (CARS, 3) and headings on four lanes of each road, no two nearer than 7 m on a lane."""
    slots = [(lane, at) for lane in range(8) for at in np.arange(-115.0, 115.0, 8.0) if abs(at) > ROAD_HALF_M]
    position, yaw = np.zeros((CARS, 3)), np.zeros(CARS)
    for row, pick in enumerate(rng.permutation(len(slots))[:CARS]):
        lane, at = slots[pick]
        across = (-5.4, -1.9, 1.9, 5.4)[lane % 4]
        along = at + rng.uniform(-0.5, 0.5)
        position[row, :2] = (along, across) if lane < 4 else (-across, along)
        yaw[row] = (0.0 if across < 0 else math.pi) + (0.0 if lane < 4 else math.pi / 2) + rng.normal(0, 0.02)
    return position, yaw


def _clutter(rng: np.random.Generator) -> Primitives:
    rows: list[tuple[int, tuple[float, float, float], tuple[float, float, float], float, float]] = []

    def beside(nearest: float, farthest: float) -> tuple[float, float]:
        sides, away = rng.choice([-1.0, 1.0], 2), rng.uniform(nearest, farthest)
        along = rng.uniform(nearest, 125.0)
        x, y = (along, away) if rng.random() < 0.5 else (away, along)
        return float(sides[0] * x), float(sides[1] * y)

    for _ in range(BUILDINGS):
        x, y = beside(24.0, 60.0)
        high = rng.uniform(3.0, 9.0)
        rows.append((BOX, (x, y, high), (rng.uniform(4, 10), rng.uniform(4, 10), high), 0.0, 0.4))
    for _ in range(POLES):
        x, y = beside(ROAD_HALF_M + 1, ROAD_HALF_M + 3)
        rows.append((CYLINDER, (x, y, 3.0), (0.1, 0.1, 3.0), 0.0, 0.5))
    for _ in range(TREES):
        x, y = beside(ROAD_HALF_M + 3, 40.0)
        rows.append((CYLINDER, (x, y, 1.3), (0.2, 0.2, 1.5), 0.0, 0.2))
        wide = rng.uniform(1.2, 2.5)
        rows.append((ELLIPSOID, (x, y, 4.0), (wide, wide, 2.0), 0.9, 0.35))
    kind, center, half, density, bright = zip(*rows)
    turns = rotation_from_yaw_pitch(rng.uniform(0, math.pi, len(rows)), np.zeros(len(rows)))
    return Primitives(
        np.array(kind, np.uint8), np.array(center), turns, np.array(half), np.array(density),
        np.zeros(len(rows), np.int64), np.array(bright),
    )  # fmt: skip


def _flat() -> HeightField:
    return HeightField(np.zeros((2, 2), np.float32), np.ones((2, 2), np.uint8), -200.0, -200.0, 400.0, 400.0)
