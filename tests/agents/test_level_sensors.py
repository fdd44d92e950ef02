# SPDX-License-Identifier: Apache-2.0
"""Sweeps of real sensors, tilted in their mounts, on flat and on sloped ground with vehicles: z = 0 is the road at 50 m."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents.level_frame import LevelledFrame
from manyeyes.datatypes import AgentFrame, Transform
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.sensors.lidar import ASPHALT, RaycastScene, scan
from manyeyes.simulator.sensors.lidars import lidar_spec

ROADSIDE = ("opv2v-roadside-16", "dair-infrastructure")
VEHICLE = ("opv2v", "opv2v-16", "vlp-16", "hdl-64e", "argoverse2", "dair-vehicle", "pandar64")


def make_scene(slope: float) -> RaycastScene:
    """A plane that rises along x, a truck beside the origin and cars."""
    x = np.arange(-90, 90.1, 0.5)
    surface = np.full((1440, 1440), ASPHALT, np.uint8)
    ground = HeightField(np.tile(slope * x, (len(x), 1)).astype(np.float32), surface, -90.0, -90.0, 0.5, 0.125)
    places = np.array([[3.0, 4.0], [14, -3], [-12, 3.5], [25, 4], [-30, -4], [40, 0], [8, -12], [-15, 14]])
    sizes = [(11.0, 2.5, 3.5)] + [(4.4, 1.8, 1.5)] * 7
    kinds = ["truck"] + ["car"] * 7
    shapes = [make_vehicle_shape(kind, size, 0, i + 1) for i, (kind, size) in enumerate(zip(kinds, sizes))]
    position = np.column_stack((places, slope * places[:, 0]))
    return RaycastScene(
        Primitives.cat(
            [place_vehicle_shapes(shapes, position, np.zeros(8), np.full(8, -math.atan(slope)), np.arange(1, 9))]
        ),
        ground,
    )


def max_error_m(frame: AgentFrame, slope: float, sector_rad: float = math.pi) -> float:
    """Return the largest height of the true road in the frame, 50 m around the agent."""
    angle = torch.linspace(-sector_rad, sector_rad, 61, dtype=torch.float64)
    xy = 50.0 * torch.stack((angle.cos(), angle.sin()), 1)
    road = torch.cat((xy, slope * xy[:, :1]), 1)
    return float(frame.world_from_agent.inverse().apply(road)[:, 2].abs().max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "roll_deg, pitch_deg, slope", [(0, 0, 0), (3, 0, 0), (-0.5, 0.78, 0), (1.5, -2.5, 0), (0, 0, 0.04)]
)
@pytest.mark.parametrize("name", VEHICLE + ROADSIDE)
def test_the_road_is_at_zero_at_50_m(name: str, roll_deg: float, pitch_deg: float, slope: float) -> None:
    tilt = math.radians(roll_deg), math.radians(pitch_deg)
    spec = replace(lidar_spec(name), roll_rad=tilt[0], pitch_rad=tilt[1])
    pose = spec.agent_pose(Transform.identity())
    points, _ = scan(make_scene(slope), pose, spec, (0, name))
    frame = AgentFrame.of(points, pose, sensor_height_m=spec.height_m)
    levelled = LevelledFrame.of(frame).levelled
    assert max_error_m(levelled, slope, spec.sector_rad / 2) < 0.1
    assert (levelled is frame) == (roll_deg == pitch_deg == slope == 0)
