# SPDX-License-Identifier: Apache-2.0
"""Predict the map of a crossing from the sweeps of five agents, which send BEV features.

The street is generated here (extra 'sim') and was not in training. The first agent predicts alone, then with all messages.
"""

import sys
from pathlib import Path

from manyeyes.agents.map_features import decode_map_features, encode_map_features, predict_tile
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.evaluation.maps.tile_sampling import make_world_from_tile
from manyeyes.evaluation.maps.tiles import crop_to_tile
from manyeyes.maps.roads.ground_truth import GroundTruthPolicy, build_ground_truth_map
from manyeyes.models import pretrained
from manyeyes.simulator.scene.scenario import ScenarioSpec, make_scenario
from manyeyes.simulator.scene.towns import load_town
from manyeyes.viz.map_figures import MapPanel, save_figure

map_model = pretrained.load_map_model()
town = load_town("generated-3")
spec = ScenarioSpec(
    "generated-3",
    3,
    "street",
    vehicles=4,
    frames=2,
    history_frames=0,
    roadside_chance=1.0,
    density=6.0,
    intensity="material",
)
scene = make_scenario(spec, town)
frames = scene.snapshot(0).frames

messages, num_bytes = [], []
for frame in frames:
    packets = encode_map_features(map_model, frame)
    messages.append(decode_map_features(packets, map_model))
    num_bytes.append(sum(map(len, packets)))

world_from_tile = make_world_from_tile(frames[0])
truth = crop_to_tile(
    build_ground_truth_map(town, GroundTruthPolicy(boundary="pavement")), world_from_tile, map_model.config.tile
)
panels = []
for count in (1, len(frames)):
    predicted = predict_tile(map_model, [m for m in messages[:count] if m is not None], world_from_tile)
    quality = evaluate_map(predicted, truth)
    ap_text = ", ".join(f"{kind} {quality.get_ap(kind, 'maptr'):.2f}" for kind in ("divider", "boundary"))
    print(f"{count} frames, {sum(num_bytes[:count]):,} bytes: {len(predicted)} elements, AP of {ap_text}")
    panels.append(MapPanel(f"From {count} frames", predicted.take(predicted.score >= 0.3), truth))
save_figure(panels, Path(sys.argv[1] if len(sys.argv) > 1 else "map.png"))
