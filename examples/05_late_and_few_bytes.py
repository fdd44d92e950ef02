# SPDX-License-Identifier: Apache-2.0
"""Messages of at most 4,096 bytes that arrive 100 ms late: boxes of the ego alone, and with the messages.

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
    simulate("tiny", folder)  # on roads that SUMO generates
drive = Opv2vRecording(folder, "test")
detector, scenario = load_detector(), drive.scenarios[0]
agents = {i: Agent(detector, budget_bytes=4096) for i in drive.agents(scenario)}

on_air: list[bytes] = []
for index in range(drive.length(scenario)):
    frames = drive.snapshot(scenario, index).frames
    ego = frames[0]
    cooperative = agents[ego.agent_id].perceive(ego, on_air)
    ego_only = agents[ego.agent_id].perceive(ego)
    print(
        f"{ego.timestamp_ns / 1e9:.1f} s: {len(ego_only.boxes)} boxes alone, {len(cooperative.boxes)} with "
        f"{sum(map(len, on_air))} bytes"
    )
    on_air = [packet for frame in frames[1:] for packet in agents[frame.agent_id].share(frame)]
