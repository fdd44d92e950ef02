# SPDX-License-Identifier: Apache-2.0
"""Detect without messages, and with messages of at most 4,096 bytes and a delay of 100 ms.

Packets are made by ``share`` at one instant and used by ``perceive`` at the next. Each message holds
the time and the pose of its sender and the velocities of its boxes, so that the receiver compensates the delay.
"""

import sys
import tempfile
from pathlib import Path

from manyeyes import Agent, load_detector
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.simulator.presets import simulate

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
if not (folder / "test").is_dir():
    simulate("smoke-opv2v", folder)  # on roads that SUMO generates
drive = Opv2vRecording(folder, "test")
detector, scenario = load_detector(), drive.scenarios[0]
agents = {i: Agent(detector, budget_bytes=4096) for i in drive.agents(scenario)}

in_transit: list[bytes] = []
for index in range(drive.length(scenario)):
    frames = drive.snapshot(scenario, index).frames
    ego = frames[0]
    cooperative = agents[ego.agent_id].perceive(ego, in_transit)
    no_fusion = agents[ego.agent_id].perceive(ego)
    print(
        f"{ego.timestamp_ns / 1e9:.1f} s: {len(no_fusion.boxes)} boxes without messages, {len(cooperative.boxes)} with "
        f"{sum(map(len, in_transit))} bytes"
    )
    in_transit = [packet for frame in frames[1:] for packet in agents[frame.agent_id].share(frame)]
