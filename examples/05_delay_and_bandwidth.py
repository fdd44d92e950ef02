# SPDX-License-Identifier: Apache-2.0
"""Count the vehicles that are found with messages of at most so many bytes, which arrive 100 ms late.

Packets are made by ``share`` at one instant and used by ``perceive`` at the next. Each message holds
the time and the pose of its sender and the velocities of its boxes, so that the receiver compensates the delay.
"""

import sys
import tempfile
from pathlib import Path

from manyeyes import Agent, load_detector
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.evaluation.detection.average_precision import FrameResult, match_frame, select_ego_truth
from manyeyes.evaluation.detection.benchmark import make_own_protocol
from manyeyes.simulator.presets import simulate

BUDGETS, NUM_FRAMES, MIN_SCORE = (0, 300, 600, 1200, 4096), 12, 0.5

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
if not (folder / "test").is_dir():
    simulate("demo", folder)  # a crossing with three connected vehicles and a roadside unit
drive = Opv2vRecording(folder, "test")
detector, scenario = load_detector(), drive.scenarios[0]
protocol = make_own_protocol(detector).with_classes(("vehicle",))
snapshots = [drive.snapshot(scenario, index) for index in range(20, 20 + NUM_FRAMES)]
features = {}  # detector outputs, which do not depend on the budget

for budget in BUDGETS:
    agents = {
        agent: Agent(detector, budget_bytes=budget, perception_cache=PerceptionCache(detector, feature_cache=features))
        for agent in drive.agents(scenario)
    }
    in_transit: list[bytes] = []
    num_bytes = num_found = num_vehicles = num_false = 0
    for snapshot in snapshots:
        ego, *others = snapshot.frames
        num_bytes += sum(map(len, in_transit))
        boxes = agents[ego.agent_id].perceive(ego, in_transit).boxes
        truth = select_ego_truth(snapshot, 0, protocol)
        match = match_frame(FrameResult(scenario, snapshot.index, boxes[boxes.score > MIN_SCORE], truth), 0.5, protocol)
        num_found, num_vehicles = num_found + int(match.tp.sum()), num_vehicles + match.n_gt
        num_false += len(match.score) - int(match.tp.sum())
        in_transit = [packet for frame in others for packet in agents[frame.agent_id].share(frame)] if budget else []
    found = num_found / num_vehicles
    print(
        f"at most {budget:4} bytes a message, {num_bytes / (NUM_FRAMES - 1):6.0f} received a frame: {found:4.0%} of vehicles "
        f"found {'#' * round(40 * found):40} {num_false} false"
    )
