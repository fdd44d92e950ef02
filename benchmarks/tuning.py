# SPDX-License-Identifier: Apache-2.0
"""Late and intermediate fusion with the same budget of settings, on the validation town; prints AP of each.

Both are given every pair of (NMS IoU, power of the predicted IoU in the score). What the test table uses is chosen here. Every
frame is processed, so that agents have their sweep before and their past; every third is evaluated.
Usage: python benchmarks/tuning.py --data data/carla-towns-small --weights costr-small
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import torch

from manyeyes import Agent, Opv2vRecording, load_detector
from manyeyes.agents.perception_cache import AgentOutput, PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.agents.strategies.registry import FusionStrategy
from manyeyes.datatypes import AgentFrame, Boxes, Snapshot
from manyeyes.evaluation.detection.average_precision import (
    FrameResult,
    average_precisions,
    get_protocol,
    select_ego_truth,
)
from manyeyes.models.detector.box_head import DecodeConfig, RawBoxes, decode
from manyeyes.models.fusion.transform_tokens import AgentTokens

MAX_RANGE_M = 70.0
HISTORY = 3
SETTINGS = tuple(itertools.product((0.05, 0.15, 0.30), (0.4, 0.6, 0.8)))


class RedecodingCache(PerceptionCache):
    """The outputs of another cache, decoded with another setting."""

    def __init__(self, cache: PerceptionCache, setting: DecodeConfig) -> None:
        super().__init__(cache.detector)
        self._cache, self._setting = cache, setting

    def process(self, frame: AgentFrame) -> AgentOutput:
        return replace(self._cache.process_tokens(frame), config=self._setting)

    def previous_tokens(self, frame: AgentFrame, num_frames: int = 2) -> list[AgentTokens]:
        return self._cache.previous_tokens(frame, num_frames)

    def decode(self, raw: RawBoxes) -> Boxes:
        return decode(raw, self._setting)[0]


def frames_in_range(snapshot: Snapshot) -> list[AgentFrame]:
    """The other agents within reach of the ego."""
    places = [f.world_from_agent.translation[:2].tolist() for f in snapshot.frames]
    return [f for f, place in zip(snapshot.frames[1:], places[1:]) if math.dist(place, places[0]) <= MAX_RANGE_M]


def perceive(
    strategy: FusionStrategy, caches: dict[int, PerceptionCache], setting: DecodeConfig, snapshot: Snapshot
) -> Boxes:
    """Boxes of the first agent with this fusion strategy, through bytes; caches: of every agent by its id."""

    def agent(frame: AgentFrame) -> Agent:
        own = RedecodingCache(caches[frame.agent_id], setting)
        return Agent(own.detector, strategy, perception_cache=own)

    packets = [p for frame in frames_in_range(snapshot) for p in agent(frame).share(frame)]
    ego = snapshot.frames[0]
    return agent(ego).perceive(ego, packets).boxes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/carla-towns-small"))
    parser.add_argument("--split", default="val")
    parser.add_argument("--weights", default="costr-small")
    parser.add_argument("--every", type=int, default=3, help="stride of the evaluated frames")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if not options.data.is_dir():
        print(f"not run: {options.data} is absent; make it with 'manyeyes simulate --preset carla-towns-small'")
        return
    detector, recording = load_detector(options.weights), Opv2vRecording(options.data, options.split)
    grid, base = detector.detection_range, detector.config.decode
    box = (grid.x_min, grid.y_min, grid.z_min, grid.x_max, grid.y_max, grid.z_max)
    protocol = get_protocol("manyeyes").with_range(box)
    found: dict[tuple[str, float, float], list[FrameResult]] = defaultdict(list)
    for scenario in recording.scenarios:
        caches: dict[int, PerceptionCache] = defaultdict(lambda: PerceptionCache(detector))
        eval_indices = recording.eval_indices(scenario)
        for index in range(max(0, eval_indices.start - HISTORY), eval_indices.stop):
            snapshot = recording.snapshot(scenario, index)
            for frame in snapshot.frames:
                caches[frame.agent_id].process(frame)
            if index not in eval_indices[:: options.every]:
                continue
            truth = select_ego_truth(snapshot, 0, protocol)
            for nms_iou, power in SETTINGS:
                setting = replace(base, nms_iou=nms_iou, iou_score_weight=power)
                for way in (LateFusion(nms_iou=nms_iou), IntermediateFusion(novelty_score, uses_history=True)):
                    boxes = perceive(way, caches, setting, snapshot)
                    found[way.name, nms_iou, power].append(FrameResult(scenario, index, boxes, truth))
    rows = []
    for (name, nms_iou, power), results in sorted(found.items()):
        at = [ap.ap for ap in average_precisions(results, (0.5, 0.7), protocol)]
        rows.append({"method": name, "nms_iou": nms_iou, "overlap_power": power, "ap50": at[0], "ap70": at[1]})
        print(f"{name:13} NMS {nms_iou:.2f}  power {power:.1f}  AP@0.5 {at[0]:.4f}  AP@0.7 {at[1]:.4f}")
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        partial = options.out.with_suffix(".partial")
        partial.write_text(
            json.dumps({"split": options.split, "weights": str(options.weights), "rows": rows}, indent=1)
        )
        partial.replace(options.out)


if __name__ == "__main__":
    main()
