# SPDX-License-Identifier: Apache-2.0
"""Two agents, one street: numpy points and 4x4 poses in, bytes between them, boxes out."""

import numpy as np

from manyeyes import Agent, AgentFrame, PointCloud, Transform, load_detector

CARS = np.array([[12, 2, 0.0], [18, 3, 0.0], [22, -2, 3.1], [9, -9, 1.6], [26, 10, 1.5], [38, 2, 0.1]])  # x, y, yaw
HALF = np.array([2.25, 0.95, 0.8])  # half of each car's length, width and height


def pose_of(x: float, y: float, yaw: float) -> np.ndarray:
    """Return world_from_agent as a 4x4 matrix; your localisation gives you this."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


def sweep(pose: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Cast the rays of a 32-beam LiDAR against the road and the cars; your sensor gives you this: (N, 3) and (N,)."""
    up, around = np.meshgrid(np.radians(np.linspace(-25, 2, 32)), np.radians(np.arange(0, 360, 0.2)), indexing="ij")
    ray = np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        reach, bright = np.where(ray[:, 2] < 0, -height / ray[:, 2], np.inf), np.full(len(ray), 0.08)  # the dark road
        for car in CARS:
            car_from_agent = np.linalg.inv(pose_of(*car)) @ pose
            start = car_from_agent[:3, :3] @ [0, 0, height] + car_from_agent[:3, 3] - [0, 0, HALF[2]]
            sides = (np.stack((-HALF, HALF)) - start)[:, None] / (ray @ car_from_agent[:3, :3].T)
            enter, leave = sides.min(0).max(1), sides.max(0).min(1)
            met = (enter > 0) & (enter < leave) & (enter < reach)
            reach[met], bright[met] = enter[met], 0.5  # brighter paint
    back = reach < 100
    return ray[back] * reach[back, None] + [0, 0, height], bright[back] * np.exp(-0.004 * reach[back])


detector = load_detector()  # the weights that ship with manyeyes
road, poses = {}, {1: pose_of(0, 0, 0), -1: pose_of(30, -14, 2.0)}  # a car, and a pole with a sensor
for agent_id, pose in poses.items():
    points, intensity = sweep(pose, height=1.9 if agent_id > 0 else 4.5)  # metres; x forward, y left, z = 0 is the road
    road[agent_id] = AgentFrame.of(PointCloud.of(points, intensity), Transform.from_matrix(pose), agent_id)

packets = Agent(detector).share(road[-1])  # bytes, each packet fit for one radio frame, the most important first
alone, together = Agent(detector).perceive(road[1]), Agent(detector).perceive(road[1], packets)
print(f"{sum(map(len, packets))} bytes in {len(packets)} packets from {len(together.received)} agent")
for name, boxes in (("alone", alone.boxes), ("together", together.boxes)):
    sure = boxes[boxes.score > 0.5]
    print(
        f"{name}: {len(sure)} of {len(CARS)} cars at x, y {[tuple(xy) for xy in sure.center[:, :2].round().int().tolist()]}"
    )
