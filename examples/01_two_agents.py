# SPDX-License-Identifier: Apache-2.0
"""Detect cars at a crossing, alone and with a roadside unit: numpy points and 4x4 poses as input, bytes between the agents."""

import numpy as np

from manyeyes import Agent, AgentFrame, Boxes, PointCloud, Transform, load_detector

# x, y, yaw of cars on the street ahead and in the side streets; x, y, length, width of the houses at the four corners.
CARS = np.array(
    [[12, 2, 0], [21, -2, 3.1], [46, 2, 0.1], [31, 14, 1.6], [27, 24, -1.5], [27, -15, -1.6], [31, -26, 1.5]]
)
HOUSES = np.array([[8, 17, 28, 18], [8, -17, 28, 18], [50, 17, 26, 18], [50, -17, 26, 18]])
SOLIDS = [(x, y, yaw, 4.5, 1.9, 1.6, 0.5) for x, y, yaw in CARS] + [(x, y, 0, *size, 9, 0.3) for x, y, *size in HOUSES]


def make_pose(x: float, y: float, yaw: float) -> np.ndarray:
    """Return world_from_agent as a 4x4 matrix; from your localisation."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def simulate_sweep(pose: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Cast the rays of a 32-beam LiDAR against road, cars and houses; from your sensor: (N, 3) metres and (N,) intensities."""
    up, around = np.meshgrid(np.radians(np.linspace(-25, 2, 32)), np.radians(np.arange(0, 360, 0.2)), indexing="ij")
    ray = np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        distance = np.where(ray[:, 2] < 0, -height / ray[:, 2], np.inf)
        intensity = np.full(len(ray), 0.08)  # the dark road
        for x, y, yaw, *size, brightness in SOLIDS:
            solid_from_agent, half = np.linalg.inv(make_pose(x, y, yaw)) @ pose, np.array(size) / 2
            start = solid_from_agent[:3, :3] @ [0, 0, height] + solid_from_agent[:3, 3] - [0, 0, half[2]]
            sides = (np.stack((-half, half)) - start)[:, None] / (ray @ solid_from_agent[:3, :3].T)
            enter, leave = sides.min(0).max(1), sides.max(0).min(1)
            hit = (enter > 0) & (enter < leave) & (enter < distance)
            distance[hit], intensity[hit] = enter[hit], brightness
    valid = distance < 100
    return ray[valid] * distance[valid, None] + [0, 0, height], intensity[valid] * np.exp(-0.004 * distance[valid])


def match_cars(boxes: Boxes) -> str:
    """Match boxes to cars whose centre is at most 1 m away; return a line of what is found."""
    found = boxes[boxes.score > 0.5].center[:, :2].numpy()
    near = np.linalg.norm(CARS[:, None, :2] - found, axis=-1) < 1
    missed = [(int(x), int(y)) for x, y, _ in CARS[~near.any(1)]]
    return f"{near.any(1).sum()} of {len(CARS)} cars, {(~near.any(0)).sum()} false, missed at x, y {missed}"


detector = load_detector()  # shipped weights
frames, poses = {}, {1: make_pose(0, -2, 0), -1: make_pose(23.5, -7, 0.8)}  # a car, and a roadside unit at the corner
for agent_id, pose in poses.items():
    points, intensity = simulate_sweep(
        pose, height=1.9 if agent_id > 0 else 4.5
    )  # x forward, y left, z = 0 is the road
    frames[agent_id] = AgentFrame.of(PointCloud.of(points, intensity), Transform.from_matrix(pose), agent_id)

packets = Agent(detector).share(frames[-1])  # bytes; each packet fits one radio frame, the most important first
alone, helped = Agent(detector).perceive(frames[1]), Agent(detector).perceive(frames[1], packets)
world_from_car = frames[1].world_from_agent
print(f"alone: {match_cars(alone.boxes.transform(world_from_car))}")
print(f"with {sum(map(len, packets))} bytes: {match_cars(helped.boxes.transform(world_from_car))}")
