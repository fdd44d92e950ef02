# SPDX-License-Identifier: Apache-2.0
"""Correctors that need no prior, side by side on boxes with the errors of real ones: answers, errors, nulls and processor time.

Scenes are those of benchmarks/pose_real.py, eight objects in common, on a seed of its own. *Wrong* are answers with an error of
3 m or more, of all scenes. *Nulls* are agents at two places: every answer is wrong. Baselines without a test of acceptance answer
whatever has enough pairs. Times are of one call, after a first one that is not counted.

python -m benchmarks.pose_global [--scenes 100] [--nulls 100] [--out benchmarks/results/pose_global.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from benchmarks.pose_real import Outcome, judge, observe

from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PoseCorrector
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkScene, LandmarkSpec, make_landmark_scene
from manyeyes.studies.provenance import write_json

SEED, COMMON = 4711, 8
BOXES = {"15 x 17": (15, 17), "25 x 31": (25, 31), "40 x 40": (40, 40)}
"""Boxes of both agents, the common ones included."""
CORRECTORS = ("voting", "clipper", "max-clique", "vips", "v2x-reg-odist", "v2x-reg-oiou")


@dataclass(frozen=True)
class Row:
    """One corrector at one density: fractions of scenes, and milliseconds of a call (median and 95th percentile)."""

    corrector: str
    boxes: str
    answered: float
    within_1m_1deg: float
    wrong: float
    null_answered: float
    median_ms: float
    p95_ms: float


def run(correct: PoseCorrector, scenes: Sequence[LandmarkScene]) -> tuple[list[Outcome], list[float]]:
    """Return the outcomes of scenes and the milliseconds of each call."""
    outcomes, times_ms = [], []
    correct(*observe(scenes[0]), None)
    for scene in scenes:
        begin = time.process_time()
        estimate = correct(*observe(scene), None)
        times_ms.append(1e3 * (time.process_time() - begin))
        outcomes.append(judge(estimate, scene.ego_from_other))
    return outcomes, times_ms


def compare(count: int, null_count: int) -> Iterator[Row]:
    """Yield a row for each density and corrector."""
    for size, (ego, other) in BOXES.items():
        spec = LandmarkSpec(COMMON, ego - COMMON, other - COMMON, REAL_BOXES)
        null = LandmarkSpec(0, ego, other, REAL_BOXES, disjoint=True)
        scenes = [make_landmark_scene(spec, SEED, n) for n in range(count)]
        nulls = [make_landmark_scene(null, SEED + 1, n) for n in range(null_count)]
        for name in CORRECTORS:
            outcomes, times_ms = run(load_corrector(name), scenes)
            of_nulls, null_times_ms = run(load_corrector(name), nulls)
            yield Row(
                name,
                size,
                float(np.mean([o.status.has_estimate for o in outcomes])),
                float(np.mean([o.is_within(1.0) for o in outcomes])),
                float(np.mean([o.status.has_estimate and o.error_m >= 3.0 for o in outcomes])),
                float(np.mean([o.status.has_estimate for o in of_nulls])),
                float(np.median(times_ms + null_times_ms)),
                float(np.percentile(times_ms + null_times_ms, 95)),
            )


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--nulls", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pose_global.json"))
    options = parser.parse_args()
    rows = []
    for row in compare(options.scenes, options.nulls):
        sys.stdout.write(
            f"{row.boxes:8} {row.corrector:14} answered {row.answered:.3f}, within 1 m, 1 deg {row.within_1m_1deg:.3f}, wrong "
            f"{row.wrong:.3f}, nulls {row.null_answered:.3f}, {row.median_ms:.1f} ms (p95 {row.p95_ms:.1f})\n"
        )
        sys.stdout.flush()
        rows.append(row)
    command = f"python -m benchmarks.pose_global {shlex.join(sys.argv[1:])}".strip()
    settings = {"scenes": options.scenes, "nulls": options.nulls, "common": COMMON}
    result = {"benchmark": "pose_global", "command": command, "settings": settings, "rows": [asdict(r) for r in rows]}
    write_json(options.out, result, {"command": command}, SEED)


if __name__ == "__main__":
    main()
