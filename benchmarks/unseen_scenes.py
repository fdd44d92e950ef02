# SPDX-License-Identifier: Apache-2.0
"""Detections of single agents where AP alone shows little: recordings of other makers, no vehicles, near field, crowns of trees.

Every agent of a recording runs alone, with its own past. A box is matched at IoU 0.5 with a vehicle that holds
at least so many of the agent's points. A false box is one above the score limit that touches no vehicle at all.

python benchmarks/unseen_scenes.py argoverse2=../shared/data/av2 no-vehicles=DATA/test near-field=DATA/test crowns=DATA/test
    [--weights costr-small] [--stride 1] [--out benchmarks/results/unseen_scenes.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from manyeyes import Agent, load_detector, open_recording
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.studies.provenance import write_json

MIN_IOU = 0.5
ROOF_POINTS = 5
"""Points above a roof from which on a vehicle stands under a crown."""
ROOF_CLEARANCE_M = 0.3
CROWN_HEIGHT_M = 6.0


@dataclass(frozen=True)
class Case:
    """Which vehicles are counted.

    min_points: the agent's own points in their boxes. range_m: from the agent.
    """

    min_points: int
    range_m: float
    split_by_crowns: bool = False


CASES = {
    "argoverse2": Case(5, 50.0),
    "no-vehicles": Case(1, 70.0),
    "near-field": Case(50, 15.0),
    "crowns": Case(5, 50.0, split_by_crowns=True),
}


@dataclass
class Count:
    """Sums over frames of one case."""

    case: str
    frames: int = 0
    vehicles: int = 0
    matched: int = 0
    under_crowns: int = 0
    matched_under_crowns: int = 0
    false_boxes: int = 0

    def describe(self) -> str:
        """Return one line of text."""
        text = f"{self.case}: {self.frames} frames, {self.matched} of {self.vehicles} vehicles, {self.false_boxes} false boxes"
        if self.under_crowns:
            text += f"; under crowns {self.matched_under_crowns} of {self.under_crowns}"
        return text


def match(found: Boxes, truth: Boxes) -> Tensor:
    """Return (T,) bool: true boxes that are matched, by falling score, each once."""
    iou, taken = pairwise_iou(found.bev(), truth.bev()), torch.zeros(len(truth), dtype=torch.bool)
    for row in iou[found.score.argsort(descending=True)]:
        free = row.masked_fill(taken, -1.0)
        if len(free) and float(free.max()) >= MIN_IOU:
            taken[free.argmax()] = True
    return taken


def count_points_above(boxes: Boxes, points: Tensor) -> Tensor:
    """Return (N,): points over the roof of each box, up to the height of a crown."""
    over = boxes.center.clone()
    over[:, 2] += boxes.size[:, 2] / 2 + ROOF_CLEARANCE_M + CROWN_HEIGHT_M / 2
    size = boxes.size.clone()
    size[:, 2] = CROWN_HEIGHT_M
    return Boxes.of(over, size, boxes.yaw).contains(points).sum(1)


def add_frame(count: Count, case: Case, found: Boxes, frame: AgentFrame, truth: Boxes, min_score: float) -> None:
    """Add one frame of one agent; truth: all vehicles, in its frame."""
    points = frame.points.xyz
    held, near = truth.contains(points).sum(1), truth.center[:, :2].norm(dim=1) < case.range_m
    # Without vehicles of its own, a frame is all clutter: no box may be there.
    counted = (held >= case.min_points) & near
    taken = match(found, truth) & counted
    count.frames += 1
    count.vehicles += int(counted.sum())
    count.matched += int(taken.sum())
    if case.split_by_crowns:
        covered = counted & (count_points_above(truth, points) >= ROOF_POINTS)
        count.under_crowns += int(covered.sum())
        count.matched_under_crowns += int((taken & covered).sum())
    strong = found[found.score > min_score]
    touching = pairwise_iou(strong.bev(), truth.bev()).amax(1) > 0 if len(truth) else torch.zeros(len(strong)).bool()
    count.false_boxes += int((~touching).sum())


def iterate_frames(recording: Recording, stride: int) -> Iterator[tuple[int, str, AgentFrame, Boxes, bool]]:
    """Yield agent, scenario, frame, true boxes in its frame, and whether it is evaluated."""
    for scenario in recording.scenarios:
        evaluated = recording.eval_indices(scenario)[::stride]
        for index in range(recording.length(scenario)):
            if index not in evaluated and index + 1 not in evaluated:
                continue
            snapshot = recording.snapshot(scenario, index)
            assert snapshot.truth is not None
            for row, frame in enumerate(snapshot.frames):
                boxes = true_boxes(snapshot.truth, row, frame.agent_id)
                yield row, scenario, frame, boxes, index in evaluated


def true_boxes(truth: GroundTruth, row: int, agent_id: int) -> Boxes:
    """Return all vehicles but the agent's own body, in its frame."""
    vehicles = truth.boxes.of_classes()
    others = vehicles[vehicles.id != agent_id]
    return others.transform(truth.world_from_agent[row].inverse()).to(torch.float32)


def run_case(name: str, recording: Recording, detector: BoxDetector, min_score: float, stride: int) -> Count:
    """Run every agent of a recording alone."""
    count, agents = Count(name), dict[tuple[int, str], Agent]()
    for row, scenario, frame, truth, is_evaluated in iterate_frames(recording, stride):
        if agents and next(iter(agents))[1] != scenario:
            agents.clear()
        agent = agents.setdefault((row, scenario), Agent(detector))
        found = agent.perceive(frame).boxes
        if is_evaluated:
            add_frame(count, CASES[name], found, frame, truth, min_score)
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="CASE=FOLDER")
    parser.add_argument("--weights", default="costr-small")
    parser.add_argument("--min-score", type=float, default=0.4)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    detector, counts = load_detector(wanted.weights), []
    for text in wanted.cases:
        name, _, folder = text.partition("=")
        if name not in CASES or not folder:
            parser.error(f"{text}: give CASE=FOLDER, CASE one of {', '.join(CASES)}")
        counts.append(run_case(name, open_recording(folder), detector, wanted.min_score, wanted.stride))
        print(counts[-1].describe(), flush=True)
    if wanted.out:
        settings = {"weights": wanted.weights, "min_score": wanted.min_score, "stride": wanted.stride}
        result = {
            "command": shlex.join(["python", *sys.argv]),
            "fingerprint": detector.fingerprint.hex(),
            "cases": counts,
        }
        write_json(wanted.out, result, settings, seed=0)


if __name__ == "__main__":
    main()
