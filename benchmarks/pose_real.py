# SPDX-License-Identifier: Apache-2.0
"""Acceptance of pose correction on boxes with the errors measured on real boxes (simulator/fleet/landmarks.py).

Tables: ``answers``: true scenes without a prior, by density and common objects. ``nulls``: agents without common objects, and at
one place minutes apart. ``clutter``: 150 false boxes that are fixed to the sensors, 15 true ones, an exact prior; and pairs of
vehicles beside and ahead of each other, each with the identity filter and without it.

Every line states a rate with its one-sided 95 % bound (Clopper-Pearson) and its target. Constants were chosen on seed 101; this
command uses other seeds.

python -m benchmarks.pose_real [--tables answers nulls ...] [--boxes "15 x 17" ...] [--scale 1.0]
    [--out benchmarks/results/pose_real.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, correct_by_voting
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.sensor_clutter import IdentityFilter
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, pose_difference
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkScene, LandmarkSpec, SensorClutter, make_landmark_scene
from manyeyes.studies.provenance import write_json

SEED = 2025
EXACT_SIGMAS = 0.05, np.radians(0.1)
OWN_BOXES = {"15 x 17": (8, 10), "25 x 31": (18, 24), "37 x 47": (30, 40)}
"""Boxes of one agent alone; with seven common ones they are as many as the name says."""
COMMON = {"4": (4,), "5 to 7": (5, 6, 7), "8 to 12": (8, 9, 10, 11, 12)}
MIN_ANSWERED = {("15 x 17", "4"): 0.20, ("15 x 17", "5 to 7"): 0.65, ("15 x 17", "8 to 12"): 0.90}
NULL_BOXES = {"15 x 17": (15, 17), "25 x 31": (25, 31), "37 x 47": (37, 47), "40 x 50": (40, 50)}

WITHOUT_FILTER = partial(
    correct_by_voting,
    config=replace(
        DETECTOR_BOXES_CONFIG,
        vote=replace(DETECTOR_BOXES_CONFIG.vote, identity_filter=IdentityFilter(min_pairs=10**6)),
    ),
)
"""The default corrector without the identity filter."""

Correct = Callable[[Landmarks, Landmarks, "PosePrior | None"], PoseEstimate]


@dataclass(frozen=True)
class Line:
    """A rate or a mean: value, its one-sided bounds (95 %), the number it is of, the target and whether the value meets it."""

    what: str
    value: float
    low: float
    high: float
    count: int
    target: str
    met: bool | None

    def __str__(self) -> str:
        verdict = {True: "met", False: "NOT MET", None: "no target"}[self.met]
        return f"{self.what}: {self.value:.4f} [{self.low:.4f}, {self.high:.4f}] of {self.count}; {self.target or '-'}: {verdict}"


def make_rate_line(
    what: str, hits: Sequence[bool] | NDArray[np.bool_], limits: tuple[float | None, float | None]
) -> Line:
    """Return the line of a rate; limits: smallest and largest value of the target, None for none."""
    n, k = len(hits), int(np.sum(hits))
    low = float(beta.ppf(0.05, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.95, k + 1, n - k)) if k < n else 1.0
    return _make_line(what, k / n if n else float("nan"), low, high, n, limits)


def make_mean_line(what: str, values: Sequence[float], limits: tuple[float | None, float | None]) -> Line:
    """Return the line of a mean, with two standard errors as bounds."""
    mean, error = float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))
    return _make_line(what, mean, mean - 2 * error, mean + 2 * error, len(values), limits)


def _make_line(
    what: str, value: float, low: float, high: float, count: int, limits: tuple[float | None, float | None]
) -> Line:
    least, most = limits
    parts = ([] if least is None else [f"at least {least:g}"]) + ([] if most is None else [f"at most {most:g}"])
    met = None if not parts else (least is None or value >= least) and (most is None or value <= most)
    return Line(what, value, low, high, count, " and ".join(parts), met)


@dataclass(frozen=True)
class Outcome:
    """What a corrector gave for one scene: its status, its error (m, degrees) and its NEES; infinite and NaN without an answer."""

    status: PoseStatus
    error_m: float
    error_deg: float
    nees: float

    def is_within(self, limit: float) -> bool:
        """Return whether the answer is within so many metres and degrees."""
        return self.error_m < limit and self.error_deg < limit


def judge(estimate: PoseEstimate, truth: NDArray[np.float64]) -> Outcome:
    """Return the outcome of an estimate against the true pose (3,)."""
    pose = estimate.pose
    if pose is None or not estimate.status.has_estimate:
        return Outcome(estimate.status, float("inf"), float("inf"), float("nan"))
    error = pose_difference(pose, truth)
    nees = float(error @ np.linalg.solve(estimate.covariance, error))
    return Outcome(estimate.status, float(np.hypot(*error[:2])), float(np.degrees(abs(error[2]))), nees)


def observe(scene: LandmarkScene) -> tuple[Landmarks, Landmarks]:
    """Return the landmarks of both agents, now."""
    return Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0])


def answers(count: int, correct: Correct, sizes: Sequence[str] = tuple(OWN_BOXES)) -> Iterator[Line]:
    """Yield the lines of true scenes without a prior."""
    everything: list[Outcome] = []
    for size, own in ((s, b) for s, b in OWN_BOXES.items() if s in sizes):
        for name, common in COMMON.items():
            if (size, name) not in MIN_ANSWERED and name == "4":
                continue
            outcomes = []
            for n in range(count):
                spec = LandmarkSpec(common[n % len(common)], *own, REAL_BOXES)
                scene = make_landmark_scene(spec, SEED, n)
                outcomes.append(judge(correct(*observe(scene), None), scene.ego_from_other))
            what, answered = f"answers, {size}, {name} common", [o for o in outcomes if o.status.has_estimate]
            everything += answered
            least = MIN_ANSWERED.get((size, name), {"5 to 7": 0.35, "8 to 12": 0.80}.get(name))
            yield make_rate_line(f"{what}: answered", [o.status.has_estimate for o in outcomes], (least, None))
            right = {"5 to 7": 0.95, "8 to 12": 0.98}.get(name)
            yield make_rate_line(
                f"{what}: of these within 1 m, 1 deg", [o.is_within(1.0) for o in answered], (right, None)
            )
            yield make_rate_line(
                f"{what}: of these within 2 m, 2 deg", [o.is_within(2.0) for o in answered], (0.99, None)
            )
            nees = [o.nees for o in answered if o.is_within(2.0)]
            yield make_mean_line(f"{what}: mean NEES", nees, (None, None))
    if not everything:
        return
    nees_all = np.array([o.nees for o in everything if o.is_within(2.0)])
    yield make_mean_line("answers, all: mean NEES", nees_all.tolist(), (2.2, 3.4))
    yield make_rate_line("answers, all: inside the 95 % ellipsoid", nees_all < 7.815, (0.89, None))
    yield make_rate_line("answers, all: inside the 99 % ellipsoid", nees_all < 11.345, (0.96, None))


def nulls(count: int, correct: Correct, sizes: Sequence[str] = tuple(NULL_BOXES)) -> Iterator[Line]:
    """Yield the lines of agents without common objects."""
    for size, boxes in ((s, b) for s, b in NULL_BOXES.items() if s in sizes):
        for name, spec in (
            ("two places", LandmarkSpec(0, *boxes, REAL_BOXES, disjoint=True)),
            ("one place", LandmarkSpec(0, *boxes, REAL_BOXES, parked_fraction=0.5)),
        ):
            outcomes = []
            for n in range(count):
                scene = make_landmark_scene(spec, SEED + 1, n)
                outcomes.append(judge(correct(*observe(scene), None), scene.ego_from_other))
            answered = np.array([o.status.has_estimate for o in outcomes])
            if name == "two places":
                yield make_rate_line(f"nulls, {size}, {name}: answered", answered, (None, 0.002))
                continue
            wrong = answered & np.array([o.error_m > 3.0 for o in outcomes])
            yield make_rate_line(f"nulls, {size}, {name}: answered", answered, (None, None))
            yield make_rate_line(f"nulls, {size}, {name}: wrong by more than 3 m", wrong, (None, 0.005))


def clutter(count: int, correct: Correct, sizes: Sequence[str] = ()) -> Iterator[Line]:
    """Yield the lines of sensor-fixed clutter and of honest pairs close to each other; their densities are their own."""
    for common in (4, 8):
        outcomes = []
        for n in range(count):
            spec = LandmarkSpec(common, 15 - common, 15 - common, REAL_BOXES, clutter=SensorClutter(150))
            scene = make_landmark_scene(spec, SEED + 2, n)
            prior = PosePrior.of(scene.ego_from_other, *EXACT_SIGMAS)
            outcomes.append(judge(correct(*observe(scene), prior), scene.ego_from_other))
        conflict = np.array([o.status is PoseStatus.CONFLICT for o in outcomes])
        far = conflict & np.array([o.error_m > 3.0 for o in outcomes])
        what = f"clutter, {common} common, exact prior"
        yield make_rate_line(f"{what}: CONFLICT more than 3 m off", far, (None, 0.001))
        yield make_rate_line(f"{what}: CONFLICT", conflict, (None, 0.005 if common == 8 else None))
        yield make_rate_line(f"{what}: answered", [o.status.has_estimate for o in outcomes], (None, None))
    for name, spec, prior_sigmas in _honest_pairs():
        found = {"with": list[Outcome](), "without": list[Outcome]()}
        for n in range(count // 10):
            scene = make_landmark_scene(spec, SEED + 3, n)
            prior = None if prior_sigmas is None else PosePrior.of(scene.ego_from_other, *prior_sigmas)
            for which, corrector in (("with", correct), ("without", WITHOUT_FILTER)):
                found[which].append(judge(corrector(*observe(scene), prior), scene.ego_from_other))
        rates = {which: np.array([o.is_within(1.0) for o in outcomes]) for which, outcomes in found.items()}
        what = f"honest pairs, {name}"
        yield make_rate_line(f"{what}, without the filter: within 1 m, 1 deg", rates["without"], (None, None))
        least = float(rates["without"].mean())
        yield make_rate_line(f"{what}: within 1 m, 1 deg", rates["with"], (least, None))


def _honest_pairs() -> Iterator[tuple[str, LandmarkSpec, tuple[float, float] | None]]:
    """Yield pairs of agents without clutter: vehicles beside and ahead of each other, and dense traffic; eight in common."""
    for placement in ("beside", "ahead"):
        for name, sigmas in (("no prior", None), ("exact prior", EXACT_SIGMAS)):
            yield f"{placement}, {name}", LandmarkSpec(8, 18, 24, REAL_BOXES, placement=placement), sigmas
    yield "dense, no prior", LandmarkSpec(8, 30, 40, REAL_BOXES), None


TABLES: dict[str, tuple[Callable[[int, Correct, Sequence[str]], Iterator[Line]], int]] = {
    "answers": (answers, 600),
    "nulls": (nulls, 3000),
    "clutter": (clutter, 3000),
}
"""Tables and the number of scenes of each of their lines."""


def write_lines(out: Path, benchmark: str, lines: Sequence[Line], seed: int) -> None:
    """Write the lines of a benchmark with its command."""
    command = f"python -m benchmarks.{benchmark} {shlex.join(sys.argv[1:])}".strip()
    write_json(
        out,
        {"benchmark": benchmark, "command": command, "lines": [asdict(line) for line in lines]},
        {"command": command},
        seed,
    )


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--boxes", nargs="+", choices=list(NULL_BOXES), default=list(NULL_BOXES), help="densities")
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers of scenes")
    parser.add_argument("--corrector", default="voting")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_real.json"))
    options = parser.parse_args()
    lines = []
    for name in options.tables:
        table, count = TABLES[name]
        for line in table(max(round(options.scale * count), 2), load_corrector(options.corrector), options.boxes):
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
            lines.append(line)
    write_lines(options.out, "pose_real", lines, SEED)


if __name__ == "__main__":
    main()
