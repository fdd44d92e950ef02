# SPDX-License-Identifier: Apache-2.0
"""Detect cars with two agents: numpy points and 4x4 poses as input, bytes between the agents, boxes as output."""

import numpy as np

from manyeyes import Agent, AgentFrame, PointCloud, Transform, load_detector

CARS = np.array([[12, 2, 0.0], [18, 3, 0.0], [22, -2, 3.1], [9, -9, 1.6], [26, 10, 1.5], [38, 2, 0.1]])  # x, y, yaw
HALF = np.array([2.25, 0.95, 0.8])  # half of each car's length, width and height


def make_pose(x: float, y: float, yaw: float) -> np.ndarray:
    """Return world_from_agent as a 4x4 matrix; from your localisation."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def simulate_sweep(pose: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Cast the rays of a 32-beam LiDAR against the road and the cars; from your sensor: (N, 3) and (N,)."""
    up, around = np.meshgrid(np.radians(np.linspace(-25, 2, 32)), np.radians(np.arange(0, 360, 0.2)), indexing="ij")
    ray = np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        distance, intensity = (
            np.where(ray[:, 2] < 0, -height / ray[:, 2], np.inf),
            np.full(len(ray), 0.08),
        )  # the dark road
        for car in CARS:
            car_from_agent = np.linalg.inv(make_pose(*car)) @ pose
            start = car_from_agent[:3, :3] @ [0, 0, height] + car_from_agent[:3, 3] - [0, 0, HALF[2]]
            sides = (np.stack((-HALF, HALF)) - start)[:, None] / (ray @ car_from_agent[:3, :3].T)
            enter, leave = sides.min(0).max(1), sides.max(0).min(1)
            hit = (enter > 0) & (enter < leave) & (enter < distance)
            distance[hit], intensity[hit] = enter[hit], 0.5  # brighter paint
    valid = distance < 100
    return ray[valid] * distance[valid, None] + [0, 0, height], intensity[valid] * np.exp(-0.004 * distance[valid])


detector = load_detector()  # shipped weights
frames, poses = {}, {1: make_pose(0, 0, 0), -1: make_pose(30, -14, 2.0)}  # a car and a roadside unit
for agent_id, pose in poses.items():
    points, intensity = simulate_sweep(
        pose, height=1.9 if agent_id > 0 else 4.5
    )  # metres; x forward, y left, z = 0 is the road
    frames[agent_id] = AgentFrame.of(PointCloud.of(points, intensity), Transform.from_matrix(pose), agent_id)

packets = Agent(detector).share(frames[-1])  # bytes; each packet fits one radio frame, the most important first
no_fusion, fused = Agent(detector).perceive(frames[1]), Agent(detector).perceive(frames[1], packets)
print(f"{sum(map(len, packets))} bytes in {len(packets)} packets from {len(fused.received)} agent")
for name, boxes in (("no fusion", no_fusion.boxes), ("fused", fused.boxes)):
    found = boxes[boxes.score > 0.5].center[:, :2].round().int().tolist()
    print(f"{name}: {len(found)} of {len(CARS)} cars at x, y {[tuple(xy) for xy in found]}")
