# SPDX-License-Identifier: Apache-2.0
"""Two vehicles that observe each other, whose middles are up to 2 m from the origins of their frames.

Tables: ``offset``: by offset and number of common objects, with known and unknown bodies, on the same scenes; priors have errors of
1 m and 1 degree. Targets compare with an offset of 0. Wrong answers (more than 3 m) are counted over all offsets of a number of
common objects. ``estimated``: bodies estimated over ten instants with six common objects (pose/body_estimate.py), then used with
two and three.

python -m benchmarks.pose_body [--tables offset estimated] [--scale 1.0] [--out benchmarks/results/pose_body.json]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks.pose_real import Line, Outcome, judge, make_mean_line, make_rate_line, observe, write_lines

from manyeyes.evaluation.pose.metrics import PriorNoise
from manyeyes.pose.body_estimate import BodyEstimate, append_body, update_body
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmark_traffic import relative_pose
from manyeyes.simulator.fleet.landmarks import LandmarkScene, LandmarkSpec, make_landmark_scene

SEED = 2029
OFFSETS_M, COMMON = (0.0, 1.0, 1.5, 2.0), (2, 3, 4, 6)
NOISE = PriorNoise("gaussian", 1.0, 1.0, SEED)


def make_spec(common: int, offset_m: float, instants: int = 1) -> LandmarkSpec:
    """Return two vehicles near each other."""
    return LandmarkSpec(common, 8, 10, REAL_BOXES, num_instants=instants, placement="near", body_offset_m=offset_m)


def offset(count: int) -> Iterator[Line]:
    """Yield the lines of known and unknown bodies."""
    correct = load_corrector("voting")
    for common in COMMON:
        reference: dict[bool, float] = {}
        wrong: dict[bool, list[bool]] = {True: [], False: []}
        for offset_m in OFFSETS_M:
            outcomes: dict[bool, list[Outcome]] = {True: [], False: []}
            for n in range(count):
                scene = make_landmark_scene(make_spec(common, offset_m), SEED, n)
                prior = NOISE.make_prior(scene.ego_from_other, n)
                for is_known, found in outcomes.items():
                    sides = [side.with_body(scene.body if is_known else None) for side in observe(scene)]
                    found.append(judge(correct(sides[0], sides[1], prior), scene.ego_from_other))
            for is_known, found in outcomes.items():
                success = [o.is_within(1.0) for o in found]
                wrong[is_known] += [o.status.has_estimate and o.error_m > 3.0 for o in found]
                reference.setdefault(is_known, float(np.mean(success)))
                loss = 0.01 if is_known else 0.05 if common >= 4 else None
                least = None if loss is None or offset_m == 0 else reference[is_known] - loss
                what = f"body {'known' if is_known else 'unknown'}, {common} common, {offset_m:g} m"
                yield make_rate_line(f"{what}: within 1 m, 1 deg", success, (least, None))
        for is_known, hits in wrong.items():
            what = f"body {'known' if is_known else 'unknown'}, {common} common, all offsets"
            yield make_rate_line(f"{what}: wrong by more than 3 m", hits, (None, None if is_known else 0.002))


def estimated(count: int) -> Iterator[Line]:
    """Yield the error of estimated bodies, and the success with known, unknown and estimated ones."""
    correct, offset_m = load_corrector("voting"), OFFSETS_M[-1]
    bodies = [estimate_bodies(make_landmark_scene(make_spec(6, offset_m, 10), SEED + 1, n), n) for n in range(count)]
    found = [body for pair in bodies for body in pair if body is not None]
    yield make_rate_line("estimated bodies: measured", [b is not None for p in bodies for b in p], (None, None))
    errors = np.array([body.xy - [offset_m, 0.0] for body in found])
    yield make_mean_line("estimated bodies: error in m", np.hypot(*errors.T).tolist(), (None, 0.3))
    nees = [float((e**2).sum() / body.sigma_m() ** 2) for e, body in zip(errors, found)]
    yield make_mean_line("estimated bodies: mean squared error over variance, two axes", nees, (None, 3.0))
    for common in (2, 3):
        outcomes: dict[str, list[Outcome]] = {"known": [], "unknown": [], "estimated": []}
        for n in range(count):
            scene = make_landmark_scene(make_spec(common, offset_m), SEED + 2, n)
            prior, sides = NOISE.make_prior(scene.ego_from_other, n), observe(scene)
            states: dict[str, tuple[BodyEstimate | None, ...]] = {"unknown": (None, None), "estimated": bodies[n]}
            for name, each in outcomes.items():
                ego, other = (
                    side.with_body(scene.body) if name == "known" else append_body(side, None, body)
                    for side, body in zip(sides, states.get(name, (None, None)))
                )
                each.append(judge(correct(ego, other, prior), scene.ego_from_other))
        known = float(np.mean([o.is_within(1.0) for o in outcomes["known"]]))
        for name, each in outcomes.items():
            what, least = f"{common} common, {offset_m:g} m, body {name}", known - 0.05 if name == "estimated" else None
            yield make_rate_line(f"{what}: within 1 m, 1 deg", [o.is_within(1.0) for o in each], (least, None))
            wrong = [o.status.has_estimate and o.error_m > 3.0 for o in each]
            yield make_rate_line(
                f"{what}: wrong by more than 3 m", wrong, (None, 0.002 if name == "estimated" else None)
            )


def estimate_bodies(scene: LandmarkScene, number: int) -> tuple[BodyEstimate | None, BodyEstimate | None]:
    """Return the bodies of ego and other, from all instants of a drive, oldest first."""
    correct, ego_body, other_body = load_corrector("voting"), None, None
    for instant in reversed(range(len(scene.ego))):
        ego, other = (Landmarks.of_boxes(boxes[instant]) for boxes in (scene.ego, scene.other))
        truth = relative_pose(scene.ego_from_then[instant], scene.ego_from_other)
        prior = NOISE.make_prior(truth, f"drive {number}", instant)
        estimate = correct(append_body(ego, None, ego_body), append_body(other, None, other_body), prior)
        if estimate.status.has_estimate:
            time_s, pairs = float(-instant), estimate.pairs
            other_body = update_body(other_body, ego, other, pairs, time_s)
            ego_body = update_body(ego_body, other, ego, pairs[:, ::-1], time_s)
    return ego_body, other_body


TABLES = {"offset": (offset, 750), "estimated": (estimated, 200)}
"""Tables and the number of scenes of each of their lines."""


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers of scenes")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_body.json"))
    options = parser.parse_args()
    lines = []
    for name in options.tables:
        table, count = TABLES[name]
        for line in table(max(round(options.scale * count), 2)):
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
            lines.append(line)
    write_lines(options.out, "pose_body", lines, SEED)


if __name__ == "__main__":
    main()
