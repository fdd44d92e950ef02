# SPDX-License-Identifier: Apache-2.0
"""Two agents, one street: numpy points and 4x4 poses in, bytes between them, boxes out."""

import numpy as np
import torch

from manyeyes import Agent, AgentFrame, PointCloud, Transform, load_detector

rng = np.random.default_rng(0)
points = rng.uniform((-40, -30, 0), (40, 30, 0.05), (20_000, 3))  # any (N, 3) array: metres, x forward, y left, z up
pose = np.eye(4)  # world_from_agent, as your localisation claims it
detector = load_detector()  # the weights that ship with manyeyes

pole = AgentFrame.of(
    PointCloud.of(torch.from_numpy(points)), Transform.from_matrix(torch.from_numpy(pose)), agent_id=-1
)
car = AgentFrame.of(PointCloud.of(torch.from_numpy(points)), Transform.from_xyz_yaw(12.0, -3.5, 0.0, 1.57), agent_id=1)
packets = Agent(detector).share(pole)  # bytes, each packet fit for one radio frame, the most important first
perception = Agent(detector).perceive(car, packets)

print(
    f"{sum(map(len, packets))} bytes in {len(packets)} packets from {len(perception.heard)} agent, {len(perception.boxes)} boxes"
)
