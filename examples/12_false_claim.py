# SPDX-License-Identifier: Apache-2.0
"""A false claim is refuted: a malicious agent sends a car on road that the ego's rays pass through, and is excluded.

The honest agent sends a car behind a wall, which the ego cannot see. A picture is written to out/false_claim.png, or to the path
of the first argument.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from manyeyes import Agent, AgentFrame, BevGrid, BoxDetector, Boxes, PointCloud, Transform, get_strategy
from manyeyes.agents.agent import Perception
from manyeyes.agents.trust.interface import Evidence
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.viz.canvas import Pen, Viewport, draw_points

CARS = {"seen": (15.0, 2.0), "behind a wall": (28.0, 11.0)}  # metres in the world, both along x
WALL, FALSE_CAR = (20.0, 8.0), (14.0, -6.0)
AGENTS = {0: (0.0, 0.0), 1: (30.0, 0.0), 2: (26.0, -8.0)}  # the ego, an honest and a malicious agent
CAR_SIZE, WALL_SIZE, LIDAR_HEIGHT_M = (4.5, 1.9, 1.6), (0.5, 7.0, 3.0), 1.9
COLOURS = {Evidence.SUPPORTED: (40, 140, 60), Evidence.UNCHECKED: (40, 90, 200), Evidence.REFUTED: (210, 40, 40)}


def make_boxes(places: list[tuple[float, float]], size: tuple[float, float, float] = CAR_SIZE) -> Boxes:
    center = torch.tensor([[x, y, size[2] / 2] for x, y in places]).reshape(-1, 3)
    return Boxes.of(center, torch.tensor(size).repeat(len(places), 1), torch.zeros(len(places)))


def scan(agent_id: int) -> PointCloud:
    """The first returns of 720 by 40 rays on the ground, the cars and the wall."""
    turn, tilt = torch.meshgrid(torch.arange(720) * 0.0087266, torch.linspace(-0.3, 0.03, 40), indexing="ij")
    ray = torch.stack((turn.cos() * tilt.cos(), turn.sin() * tilt.cos(), tilt.sin()), -1).reshape(-1, 3)
    distance = torch.where(ray[:, 2] < 0, -LIDAR_HEIGHT_M / ray[:, 2].clamp_max(-1e-9), 80.0).clamp_max(80.0)
    x, y = AGENTS[agent_id]
    origin = torch.tensor([x, y, LIDAR_HEIGHT_M])
    solid = Boxes.cat([make_boxes(list(CARS.values())), make_boxes([WALL], WALL_SIZE)])
    for center, size in zip(solid.center, solid.size):
        one, two = (center - size / 2 - origin) / ray, (center + size / 2 - origin) / ray
        enter, leave = torch.minimum(one, two).amax(1), torch.maximum(one, two).amin(1)
        distance = torch.where((enter > 0) & (enter < leave) & (enter < distance), enter, distance)
    return PointCloud.of(ray * distance[:, None] + torch.tensor([0.0, 0.0, LIDAR_HEIGHT_M]))


@dataclass
class ListedCars(BoxDetector):
    """A detector of your own: here it knows where cars are, and detects those with returns. false_cars: it makes up more."""

    agent_id: int
    false_cars: tuple[tuple[float, float], ...] = ()
    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        x, y = AGENTS[self.agent_id]
        listed = make_boxes([(a - x, b - y) for a, b in CARS.values()])
        found = listed[listed.contains(points.xyz, 0.1).sum(1) > 10]
        return Boxes.cat([found, make_boxes([(a - x, b - y) for a, b in self.false_cars])])


def draw(perception: Perception, path: Path) -> None:
    """The ego's returns, and the claims of both senders by the evidence on them."""
    viewport = Viewport(-5.0, -15.0, 40.0, 18.0, width=900, top_margin=30)
    xyz = scan(0).xyz.numpy()
    pen = Pen(draw_points(viewport, [(xyz[:, :2], np.full(len(xyz), 0.6), (90, 90, 90))], (255, 255, 255)))
    assert perception.assessment is not None
    for claims in perception.assessment.claims or ():
        for corners, kind in zip(claims.boxes.corners()[:, :4, :2].numpy(), claims.evidence.tolist()):
            pixels, colour = viewport.to_pixels(corners), COLOURS[Evidence(kind)]
            pen.polygon(pixels, None, colour, 2.0)
            text = f"agent {claims.agent_id}: {Evidence(kind).name.lower()}"
            x, y = pixels.max(0).tolist() if claims.agent_id == 1 else (pixels[:, 0].max(), pixels[:, 1].min() - 14)
            pen.text((x + 4, y), text, colour, halo=True)
    for agent_id, place in AGENTS.items():
        pen.disc(viewport.to_pixels(np.array(place)), 6.0, (0, 0, 0) if agent_id == 0 else (150, 150, 150), (0, 0, 0))
    lines = [f"agent {s.agent_id}: trust {s.trust:.2f}, weight {s.weight:.2f}" for s in perception.assessment.senders]
    pen.text((8, 8), "   ".join(lines), (0, 0, 0))
    path.parent.mkdir(parents=True, exist_ok=True)
    pen.finish().save(path)


path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/false_claim.png")
senders = [Agent(ListedCars(1), get_strategy("late")), Agent(ListedCars(2, (FALSE_CAR,)), get_strategy("late"))]
ego = Agent(ListedCars(0), get_strategy("late"), misbehaviour=get_misbehaviour_detector("ray-evidence"))
for number in range(3):
    frames = [
        AgentFrame.of(scan(a), Transform.from_xyz_yaw(*AGENTS[a], 0.0, 0.0), a, number * 100_000_000) for a in AGENTS
    ]
    packets = [packet for agent, frame in zip(senders, frames[1:]) for packet in agent.share(frame)]
    perception = ego.perceive(frames[0], packets)
    assert perception.assessment is not None
    boxes = sorted((round(x), round(y)) for x, y in perception.boxes.center[:, :2].tolist())
    states = [f"agent {s.agent_id} {s.status.value}, trust {s.trust:.2f}" for s in perception.assessment.senders]
    print(f"frame {number}: {'; '.join(states)}; cars at {boxes}")
draw(perception, path)
