# SPDX-License-Identifier: Apache-2.0
"""Twelve vehicles send local maps of a crossroads, a few hundred bytes each, and a map server fuses them incrementally.

The local maps are the true map with the errors of a simulated fleet; on a recording, 'manyeyes map build' takes a map model.
"""

import numpy as np
import torch

from manyeyes import AgentFrame, Inbox, PointCloud, Transform
from manyeyes.agents.map_perception import MAP_MODES, encode_map_message
from manyeyes.agents.map_server import MapServer
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.simulator.fleet.config import crowd_config
from manyeyes.simulator.fleet.map_predictor import SimulatedMapPredictor
from manyeyes.simulator.fleet.place import clip_to_box, load_place

where = load_place("cross", size_m=100.0)
truth = where.clip_to_area()
predictor, window = SimulatedMapPredictor(where.truth, crowd_config("local")), MAP_MODES["local"].vehicle_window
server, inbox = MapServer(where.frame), Inbox()

num_bytes = 0
for instant in range(8):
    for vehicle in range(12):
        # Three vehicles approach on each of four arms at 10 m/s, one behind the other, and send once a second.
        heading, away = vehicle % 4 * np.pi / 2, 30.0 + 12.0 * (vehicle // 4) - 10.0 * instant
        pose = np.array([-away * np.cos(heading), -away * np.sin(heading), heading])
        local_map = predictor.predict(pose, window, vehicle, instant)
        # Reported poses have errors of the stated covariance.
        error = np.random.default_rng([vehicle, instant]).normal(0.0, [0.3, 0.3, 0.005])
        x, y, yaw = (pose + error).tolist()
        frame = AgentFrame(
            agent_id=vehicle,
            timestamp_ns=instant * 10**9,
            points=PointCloud.of(torch.zeros(0, 3)),
            world_from_agent=Transform.from_xyz_yaw(x, y, 0.0, yaw),
            pose_covariance=torch.diag(torch.tensor([0.09, 0.09, 2.5e-5], dtype=torch.float64)),
        )
        packets = encode_map_message(frame, local_map)
        num_bytes += sum(map(len, packets))
        for packet in packets:
            inbox.push(packet)
        server.ingest(inbox.received_messages())
    fused = server.map().select_published()
    quality = evaluate_map(clip_to_box(fused.elements, where.area), truth)
    print(
        f"{instant} s: {len(server.observations)} messages, {num_bytes} bytes, {len(fused)} elements, mAP {quality.mean_ap():.2f}"
    )

fused = server.rebuild().select_published()
print(
    f"batch fusion: {len(fused)} elements, mAP {evaluate_map(clip_to_box(fused.elements, where.area), truth).mean_ap():.2f}"
)
