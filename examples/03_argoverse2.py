# SPDX-License-Identifier: Apache-2.0
"""Detect vehicles in a real sweep of Argoverse 2: its car's lower and upper LiDAR are two agents, and the upper one sends bytes.

The picture shows both clouds, the labels and the boxes that the lower LiDAR's agent finds with the message.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from pyarrow import feather

from manyeyes import Agent, Argoverse2Recording, Boxes, load_detector
from manyeyes.datatypes import GroundTruth, Transform
from manyeyes.evaluation.detection.average_precision import FrameResult, match_frame, select_ego_truth
from manyeyes.evaluation.detection.benchmark import make_own_protocol
from manyeyes.models.score_calibration import default_drawing_score
from manyeyes.viz.birds_eye import draw_scene, make_scene, save_png

root = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data/av2")
if not root.is_dir():
    sys.exit(f"{root}: no Argoverse 2 logs here; give their folder.")
recording = Argoverse2Recording(root)
snapshot = recording.snapshot(recording.scenarios[0], 0)
(frame,), truth = snapshot.frames, snapshot.truth
sweep = min(root.glob(f"**/{recording.sweeps(snapshot.scenario)[0]}.feather"))
is_upper = torch.from_numpy(feather.read_table(sweep)["laser_number"].to_numpy() < 32)
lower = replace(frame, points=frame.points[~is_upper])
upper = replace(frame, points=frame.points[is_upper], agent_id=2)

detector = load_detector()
protocol = make_own_protocol(detector).with_classes(("vehicle",))
labelled = select_ego_truth(snapshot, 0, protocol)
min_scores = {form: default_drawing_score(detector, form) for form in ("own", "fused")}


def count_vehicles(boxes: Boxes, form: str) -> str:
    """Match boxes to labelled vehicles at IoU 0.5."""
    match = match_frame(FrameResult("", 0, boxes[boxes.score >= min_scores[form]], labelled), 0.5, protocol)
    found = int(match.tp.sum())
    return f"{found} of {match.n_gt} labelled vehicles, {len(match.score) - found} false"


packets = Agent(detector).share(upper)
alone, helped, both = (Agent(detector).perceive(*given) for given in ((lower,), (lower, packets), (frame,)))
print(f"lower LiDAR alone, {len(lower.points)} real points: {count_vehicles(alone.boxes, 'own')}")
print(f"with {sum(map(len, packets))} bytes of the upper one: {count_vehicles(helped.boxes, 'fused')}")
print(f"all {len(frame.points)} points of both in one place: {count_vehicles(both.boxes, 'own')}")

picture = Path(sys.argv[2] if len(sys.argv) > 2 else "argoverse2.png")
poses = Transform.stack([frame.world_from_agent] * 2)
both_true = GroundTruth(truth.boxes, truth.seen.repeat(2, 1), poses)
scene = make_scene(replace(snapshot, frames=(lower, upper), truth=both_true), helped.boxes)
title = "A real sweep: two LiDARs as two agents"
save_png(draw_scene(scene, detector.grid, title, min_score=min_scores["fused"]), picture)
print(picture)
