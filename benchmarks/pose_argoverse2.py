# SPDX-License-Identifier: Apache-2.0
"""Pose correction on real boxes of one Argoverse 2 log: all that the real data at hand can give.

Tables: ``detections``: the car's two LiDARs (lasers 0 to 31 and 32 to 63) are read as two agents, each with the shipped detector on
its own points of one sweep; pairs are of both LiDARs and of the two sweeps, 0.1 s apart. Their errors against each other, and
poses without a prior from random subsets with so many objects in common; the other agent's frame is turned and moved anywhere. The
subsets overlap, so that bounds are too narrow. ``layouts``: real traffic with drawn errors: the ego and another labelled vehicle
observe the labelled vehicles within 60 m, the other one 70 % of them. ``nulls``: the same log at least 10 s apart, without the
vehicles that stay parked, so that every answer is wrong.

There are two sweeps and 156 labelled instants of a single drive. Two vehicles that observe each other are not among the data:
see docs/concepts/pose-correction.md.

python -m benchmarks.pose_argoverse2 LOG [--tables detections ...] [--scale 1.0] [--out benchmarks/results/pose_argoverse2.json]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from benchmarks.pose_real import Line, Outcome, judge, make_rate_line, write_lines
from numpy.typing import NDArray

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datasets.argoverse2 import Argoverse2Recording
from manyeyes.datasets.lidar_frame import rotation_of_quaternion
from manyeyes.datatypes import AgentFrame, Boxes, Transform
from manyeyes.models import pretrained
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PosePrior, project_to_se2, wrap_angle
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES, draw_latent, make_errors

Floats = NDArray[np.float64]

SEED = 2033
MIN_SCORE, MATCH_RADIUS_M, RANGE_M = 0.3, 2.0, 60.0
COMMON = (4, 6, 8)
MIN_NULL_GAP_NS = 10 * 10**9
PARKED_M = 1.0
"""A vehicle that is nearer than this to its place at the other instant counts as parked."""
_LASERS_PER_UNIT = 32


@dataclass(frozen=True)
class Log:
    """A log: recording, scenario, time stamps (ns) of the labels, and city_from_ego (3,) at each."""

    recording: Argoverse2Recording
    scenario: str
    times: tuple[int, ...]
    poses: Floats

    @classmethod
    def open(cls, folder: Path) -> Log:
        """Open a log's folder."""
        from pyarrow import feather

        recording = Argoverse2Recording(folder)
        times = np.unique(feather.read_table(folder / "annotations.feather")["timestamp_ns"].to_numpy())
        table = feather.read_table(folder / "city_SE3_egovehicle.feather")
        stamps = table["timestamp_ns"].to_numpy()
        names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
        columns = torch.from_numpy(np.stack([table[name].to_numpy() for name in names], -1).astype(np.float64))
        rows = [int(np.flatnonzero(stamps == time)[0]) for time in times]
        poses = [project_to_se2(Transform(rotation_of_quaternion(columns[r, :4]), columns[r, 4:])) for r in rows]
        return cls(recording, recording.scenarios[0], tuple(int(t) for t in times), np.array(poses))

    def vehicles(self, time: int) -> Boxes:
        """Return the labelled vehicles that hold points, in AV2's ego frame."""
        found = self.recording.annotations(self.scenario, time)
        return found.boxes[found.is_vehicle & (found.interior_points > 0)]


def detect_by_unit(log: Log, index: int, detector: BoxDetector) -> list[Landmarks]:
    """Return the detections of both LiDARs of a sweep, in the frame of its agent, without levelling."""
    from pyarrow import feather

    time = log.recording.sweeps(log.scenario)[index]
    path = log.recording.root / "sensors" / "lidar" / f"{time}.feather"
    unit = torch.from_numpy(feather.read_table(path)["laser_number"].to_numpy().astype(np.int64)) // _LASERS_PER_UNIT
    frame = log.recording.snapshot(log.scenario, index).frames[0]
    return [_detect(replace(frame, points=frame.points[unit == n]), detector) for n in (0, 1)]


def _detect(frame: AgentFrame, detector: BoxDetector) -> Landmarks:
    boxes = PerceptionCache(detector).process(frame).boxes
    return Landmarks.of_boxes(boxes[boxes.score >= MIN_SCORE])


def pair_up(ego: Landmarks, other: Landmarks, ego_from_other: Floats) -> NDArray[np.int64]:
    """Return (P, 2) rows that are each other's nearest within 2 m under the true pose."""
    if not len(ego) or not len(other):
        return np.zeros((0, 2), np.int64)
    away = np.linalg.norm(ego.xy[:, None] - other.transform(ego_from_other).xy[None], axis=-1)
    nearest, back = away.argmin(1), away.argmin(0)
    rows = np.flatnonzero((back[nearest] == np.arange(len(ego))) & (away.min(1) < MATCH_RADIUS_M))
    return np.stack((rows, nearest[rows]), 1)


def draw_motion(rng: np.random.Generator) -> Floats:
    """Return (3,) a pose anywhere within 50 m."""
    return np.array([*rng.uniform(-50, 50, 2), rng.uniform(-np.pi, np.pi)])


def invert(pose: Floats) -> Floats:
    """Return the inverse of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


def detections(log: Log, count: int) -> Iterator[Line]:
    """Yield the lines of real detections of two real LiDARs."""
    detector = pretrained.load()
    sweeps = [detect_by_unit(log, index, detector) for index in (0, 1)]
    frames = [log.recording.snapshot(log.scenario, index).frames[0] for index in (0, 1)]
    between = project_to_se2(frames[0].world_from_agent.inverse() @ frames[1].world_from_agent)
    sets = [
        *((sweep[0], sweep[1], np.zeros(3)) for sweep in sweeps),
        *((sweeps[0][a], sweeps[1][b], between) for a, b in ((0, 0), (0, 1), (1, 0), (1, 1))),
    ]
    yield from _measure_errors(sets[:2])
    correct = load_corrector("voting")
    for common in COMMON:
        for name, sigma_m in (("no prior", 0.0), ("prior of 2 m and 2 deg", 2.0)):
            outcomes = list[Outcome]()
            for n, (ego, other, truth) in enumerate(sets):
                pairs = pair_up(ego, other, truth)
                for draw in range(count if len(pairs) >= common else 0):
                    rng = keyed_generator(SEED, "subset", n, draw)
                    left_out = rng.permutation(pairs)[common:]
                    motion = draw_motion(rng)
                    seen = other[np.setdiff1d(np.arange(len(other)), left_out[:, 1])].transform(motion)
                    moved = _compose(truth, invert(motion))
                    off = sigma_m * np.array([1.0, 1.0, np.radians(1.0)]) * rng.standard_normal(3)
                    prior = PosePrior.of(moved + off, sigma_m, np.radians(sigma_m)) if sigma_m else None
                    kept = ego[np.setdiff1d(np.arange(len(ego)), left_out[:, 0])]
                    outcomes.append(judge(correct(kept, seen, prior), moved))
            yield from _describe(f"detections of two real LiDARs, {common} common, {name}", outcomes)


def _compose(a: Floats, b: Floats) -> Floats:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrap_angle(a[2] + b[2])])


def _measure_errors(sets: list[tuple[Landmarks, Landmarks, Floats]]) -> Iterator[Line]:
    """Yield the differences of boxes of one vehicle: median absolute ones, times 1.48, as of a normal distribution."""
    along, across, turns = list[float](), list[float](), list[float]()
    for ego, other, truth in sets:
        moved = other.transform(truth)
        for i, k in pair_up(ego, other, truth):
            step = ego.xy[i] - moved.xy[k]
            c, s = np.cos(ego.yaw[i]), np.sin(ego.yaw[i])
            along.append(c * step[0] + s * step[1])
            across.append(c * step[1] - s * step[0])
            turns.append(math.degrees(math.remainder(float(ego.yaw[i] - moved.yaw[k]), math.pi)))
    for name, values in (("longitudinal m", along), ("lateral m", across), ("heading deg", turns)):
        size = 1.4826 * float(np.median(np.abs(values)))
        yield Line(f"errors of pairs of real boxes: {name}", size, size, size, len(values), "", None)


def _describe(what: str, outcomes: list[Outcome]) -> Iterator[Line]:
    answered = [o.status.has_estimate for o in outcomes]
    yield make_rate_line(f"{what}: answered", answered, (None, None))
    yield make_rate_line(f"{what}: within 1 m, 1 deg", [o.is_within(1.0) for o in outcomes], (None, None))
    wrong = [is_answer and o.error_m > 3.0 for is_answer, o in zip(answered, outcomes)]
    yield make_rate_line(f"{what}: wrong by more than 3 m", wrong, (None, 0.005))


def _perturb(boxes: Boxes, rng: np.random.Generator) -> Landmarks:
    """Return labelled boxes with the errors of real detections."""
    marks = Landmarks.of_boxes(boxes)
    errors = make_errors(REAL_BOXES, draw_latent(len(marks), rng))
    c, s = np.cos(marks.yaw), np.sin(marks.yaw)
    xy = marks.xy + np.stack((c * errors.xy[:, 0] - s * errors.xy[:, 1], s * errors.xy[:, 0] + c * errors.xy[:, 1]), 1)
    size = np.maximum(marks.size + errors.size, 0.5)
    return replace(marks, xy=xy, yaw=marks.yaw + errors.yaw, size=size, score=np.ones(len(marks)))


def layouts(log: Log, count: int) -> Iterator[Line]:
    """Yield the lines of two vehicles in real traffic, by objects in common."""
    correct = load_corrector("voting")
    outcomes: dict[str, list[Outcome]] = {"4": [], "5 to 7": [], "8 and more": []}
    for n in range(count):
        rng = keyed_generator(SEED, "layout", n)
        boxes = log.vehicles(log.times[int(rng.integers(len(log.times)))])
        xy = boxes.center[:, :2].numpy()
        near = np.flatnonzero(np.linalg.norm(xy, axis=-1) < RANGE_M)
        row = int(rng.choice(near))
        truth = np.array([*xy[row], float(boxes.yaw[row])])
        is_seen = (np.linalg.norm(xy - xy[row], axis=-1) < RANGE_M) & (rng.random(len(xy)) < 0.7)
        is_seen[row] = False
        common = int(is_seen[near].sum())
        if common < 4:
            continue
        ego = _perturb(boxes[torch.from_numpy(near)], rng)
        other = _perturb(boxes[torch.from_numpy(np.flatnonzero(is_seen))], rng).transform(invert(truth))
        bucket = "4" if common == 4 else "5 to 7" if common < 8 else "8 and more"
        outcomes[bucket].append(judge(correct(ego, other, None), truth))
    for name, found in outcomes.items():
        if found:
            yield from _describe(f"layouts of real traffic, {name} common, no prior", found)


def nulls(log: Log, count: int) -> Iterator[Line]:
    """Yield the lines of one place at least 10 s apart, without what stays."""
    correct, outcomes = load_corrector("voting"), list[Outcome]()
    starts = [n for n, time in enumerate(log.times) if log.times[-1] - time >= MIN_NULL_GAP_NS]
    for n in range(count):
        rng = keyed_generator(SEED, "null", n)
        first = int(rng.choice(starts))
        later = [k for k, time in enumerate(log.times) if time - log.times[first] >= MIN_NULL_GAP_NS]
        second = int(rng.choice(later))
        truth = _compose(invert(log.poses[first]), log.poses[second])
        ego, other = (log.vehicles(log.times[k]) for k in (first, second))
        there = Landmarks.of_boxes(other).transform(truth).xy
        apart = np.linalg.norm(ego.center[:, None, :2].numpy() - there[None], axis=-1)
        moved_ego, moved_other = (torch.from_numpy(apart.min(axis) > PARKED_M) for axis in (1, 0))
        motion = draw_motion(rng)
        sides = _perturb(ego[moved_ego], rng), _perturb(other[moved_other], rng).transform(motion)
        outcomes.append(judge(correct(*sides, None), _compose(truth, invert(motion))))
    answered = [o.status.has_estimate for o in outcomes]
    yield make_rate_line("nulls of one real place, 10 s apart: answered", answered, (None, 0.002))


TABLES = {"detections": (detections, 100), "layouts": (layouts, 600), "nulls": (nulls, 1000)}
"""Tables and the number of scenes of each: for detections, subsets of each of six pairs."""


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("log", type=Path, help="folder of the log: sweeps, annotations and poses")
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers of scenes")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_argoverse2.json"))
    options = parser.parse_args()
    log, lines = Log.open(options.log), list[Line]()
    for name in options.tables:
        table, count = TABLES[name]
        for line in table(log, max(round(options.scale * count), 2)):
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
            lines.append(line)
    write_lines(options.out, "pose_argoverse2", lines, SEED)


if __name__ == "__main__":
    main()
