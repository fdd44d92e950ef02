# SPDX-License-Identifier: Apache-2.0
"""Share and fuse two sweeps of an Argoverse 2 log as two agents, and draw both clouds with the detections."""

import sys
from pathlib import Path

from manyeyes import Agent, Argoverse2Recording, load_detector
from manyeyes.models.score_calibration import default_drawing_score
from manyeyes.viz.birds_eye import draw_scene, make_scene, save_png

root = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data/av2")
if not root.is_dir():
    sys.exit(f"{root}: no Argoverse 2 logs here; give their folder.")
recording = Argoverse2Recording(root, gap=1)
snapshot = recording.snapshot(recording.scenarios[0], 0)
detector = load_detector()
first, second = snapshot.frames
packets = Agent(detector).share(second)
perception = Agent(detector).perceive(first, packets)
print(f"{sum(map(len, packets))} bytes from {len(second.points)} real points, {len(perception.boxes)} boxes")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "argoverse2.png")
save_png(
    draw_scene(
        make_scene(snapshot, perception.boxes),
        detector.grid,
        "Two sweeps as two agents",
        min_score=default_drawing_score(detector, "fused"),
    ),
    picture,
)
print(picture)
