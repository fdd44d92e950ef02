# SPDX-License-Identifier: Apache-2.0
"""Two agents as two processes on a network: signed packets, boxes at 10 Hz. The ego does not see the second car; the other does."""

import multiprocessing
import socket
import sys
import tempfile
from collections.abc import Iterator
from multiprocessing.synchronize import Barrier
from pathlib import Path

import torch

from manyeyes import Agent, AgentFrame, BevGrid, BoxDetector, Boxes, PointCloud, Transform, get_strategy
from manyeyes.runtime.clock import LiveClock
from manyeyes.runtime.federation import make_demo_federation
from manyeyes.runtime.live import LiveConfig, live
from manyeyes.runtime.pseudonyms import PseudonymPool
from manyeyes.runtime.security import Security
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork

CARS = {1: (10.0, 0.0), 2: (20.0, 4.0)}  # agent: x, y in the world of the car that it sees
NUM_FRAMES = 20


class OneCar(BoxDetector):
    """A detector of your own: here, one car around the middle of all points."""

    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        return Boxes.of(
            points.xyz.mean(0, keepdim=True), torch.tensor([[4.5, 1.9, 1.6]]), torch.zeros(1), torch.tensor([0.9])
        )


def read_sensor(agent_id: int, clock: LiveClock) -> Iterator[AgentFrame]:
    """Frames as they come from your sensor: a cloud, a pose, a time of the clock."""
    x, y = CARS[agent_id]
    for number in range(NUM_FRAMES):
        points = torch.tensor([x - 3.0 * agent_id, y, 0.8]) + 0.1 * torch.randn(50, 3)
        pose = Transform.from_xyz_yaw(3.0 * agent_id, 0.0, 0.0, 0.0)
        yield AgentFrame.of(PointCloud.of(points), pose, agent_id, clock.start_ns + number * 100_000_000)


def run_agent(agent_id: int, keys: Path, port: int, start: Barrier) -> None:
    torch.set_num_threads(1)
    agent = Agent(OneCar(), get_strategy("late"))
    agent.share(AgentFrame.of(PointCloud.of(torch.zeros(50, 3)), Transform.identity()))  # loads what it needs
    start.wait()
    clock = LiveClock()
    security = Security("require", PseudonymPool.load(keys / f"agent-{agent_id}.key"), keys / "trust.toml")
    network = UdpNetwork(UdpConfig("example", port=port), clock.now_ns)
    network.join((0.0, 0.0))
    ticks = list(live(read_sensor(agent_id, clock), agent, network, clock, LiveConfig(ladder=False), security))
    network.close()
    tick = max(ticks, key=lambda tick: len(tick.perception.boxes.score))
    cars = sorted((round(x + 3.0 * agent_id), round(y)) for x, y in tick.perception.boxes.center[:, :2].tolist())
    print(f"agent {agent_id}: {tick.sent_bytes} bytes a frame, cars at x, y {cars}\n", end="", flush=True)  # one write


if __name__ == "__main__":
    keys = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "keys"
    make_demo_federation(keys, CARS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(len(CARS))
    processes = [context.Process(target=run_agent, args=(agent_id, keys, port, start)) for agent_id in CARS]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
