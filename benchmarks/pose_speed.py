# SPDX-License-Identifier: Apache-2.0
"""Processor time of the default corrector and of a baseline commit's, in turn in one process, on the same boxes.

Scenes are true ones without a prior, with the errors of real boxes and eight objects in common: 40 x 40 and 200 x 200 boxes. Each
round times baseline, present, present and baseline; the ratio is that of the sums of all rounds, its interval that of a bootstrap
over rounds. The target is at most 1.3.

python benchmarks/pose_speed.py [--baseline a6c4d23] [--rounds 10] [--out benchmarks/results/pose_speed.json]
"""

from __future__ import annotations

import argparse
import importlib
import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import caching
from versions import ROOT, Version, checkout, use_own_cache

CACHE = use_own_cache()
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from manyeyes.pose.landmarks import Landmarks  # noqa: E402
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES  # noqa: E402
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene  # noqa: E402
from manyeyes.studies.provenance import write_json  # noqa: E402

SEED, COMMON, MAX_RATIO = 2031, 8, 1.3
SIZES = {"40 x 40": 40, "200 x 200": 200}
"""Boxes of each agent, common ones included; of 200, most are false ones, since a crossing has fewer vehicles."""
COLUMNS = ("xy", "yaw", "size", "score", "sigma_xy", "sigma_yaw", "p_flip", "instant")
Pair = tuple[tuple[Any, ...], tuple[Any, ...]]


@dataclass
class CorrectorVersion(Version):
    """One checkout of the package: its type of landmarks and its default corrector."""

    landmarks: Any = None
    correct: Any = None
    is_baseline: bool = field(default=False)

    def start(self) -> None:
        """Import the package."""
        # a6c4d23 adds its own lock of numba's files, which this version holds already.
        locked = caching.IndexDataCacheFile
        if self.is_baseline:
            caching.IndexDataCacheFile = locked.__base__
        with self.active():
            if self.is_baseline:
                self.landmarks = importlib.import_module("manyeyes.alignment.landmarks").Landmarks
                self.correct = importlib.import_module("manyeyes.alignment.rivals.table").CORRECTORS["vote"]
            else:
                self.landmarks = importlib.import_module("manyeyes.pose.landmarks").Landmarks
                self.correct = importlib.import_module("manyeyes.pose.registry").load_corrector("voting")
        caching.IndexDataCacheFile = locked

    def time(self, pairs: Sequence[Pair]) -> float:
        """Return the processor seconds of all pairs."""
        with self.active():
            sets = [(self.landmarks(*ego), self.landmarks(*other)) for ego, other in pairs]
            begin = time.process_time()
            for ego, other in sets:
                self.correct(ego, other, None)
            return time.process_time() - begin


@dataclass(frozen=True)
class Row:
    """One size: milliseconds of a call, the ratio present over baseline with its 95 % interval."""

    boxes: str
    baseline_ms: float
    present_ms: float
    ratio: float
    low: float
    high: float
    met: bool


def make_pairs(size: int, count: int) -> list[Pair]:
    """Return columns of both agents' landmarks; boxes that the crossing lacks are false ones anywhere within 80 m."""
    pairs = []
    for n in range(count):
        scene = make_landmark_scene(LandmarkSpec(COMMON, size - COMMON, size - COMMON, REAL_BOXES), SEED, n)
        rng = np.random.default_rng((SEED, n))
        sides = []
        for boxes in (scene.ego[0], scene.other[0]):
            marks = Landmarks.of_boxes(boxes)
            sides.append(
                tuple(getattr(Landmarks.cat([marks, _draw_false(size - len(marks), rng)]), c) for c in COLUMNS)
            )
        pairs.append((sides[0], sides[1]))
    return pairs


def _draw_false(count: int, rng: np.random.Generator) -> Landmarks:
    ones = np.ones(max(count, 0))
    size = np.array([4.5, 1.85]) + np.array([0.3, 0.08]) * rng.standard_normal((len(ones), 2))
    xy, yaw = rng.uniform(-80, 80, (len(ones), 2)), rng.uniform(-np.pi, np.pi, len(ones))
    return Landmarks(xy, yaw, size, 0.5 * ones, 0.25 * ones, 0.07 * ones, 0.06 * ones, np.zeros(len(ones), np.int64))


def compare(versions: Sequence[CorrectorVersion], size: str, rounds: int) -> Row:
    """Time baseline, present, present, baseline in each round."""
    count = 4 if SIZES[size] <= 40 else 1
    baseline, present = list[float](), list[float]()
    for n in range(rounds + 1):
        pairs = make_pairs(SIZES[size], count)
        spent = [versions[which].time(pairs) for which in (0, 1, 1, 0)]
        if n:  # the first round compiles
            baseline.append(spent[0] + spent[3])
            present.append(spent[1] + spent[2])
    times = np.array([baseline, present])
    drawn = times[:, np.random.default_rng(0).integers(0, rounds, (2000, rounds))].sum(-1)
    low, high = np.quantile(drawn[1] / drawn[0], (0.025, 0.975))
    old, new = 1e3 * times.sum(1) / (2 * count * rounds)
    return Row(size, float(old), float(new), float(new / old), float(low), float(high), bool(new / old <= MAX_RATIO))


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--baseline", default="a6c4d23")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/pose_speed.json")
    options = parser.parse_args()
    with ExitStack() as stack:
        code = stack.enter_context(checkout(options.baseline))
        versions = [CorrectorVersion(code / "src", is_baseline=True), CorrectorVersion(ROOT / "src")]
        for version in versions:
            version.start()
        rows = []
        for size in SIZES:
            rows.append(compare(versions, size, options.rounds))
            print(rows[-1], flush=True)
    command = shlex.join(["python", "benchmarks/pose_speed.py", *sys.argv[1:]])
    settings = {"baseline": options.baseline, "rounds": options.rounds, "max_ratio": MAX_RATIO}
    result = {"benchmark": "pose_speed", "command": command, "settings": settings, "rows": [asdict(r) for r in rows]}
    write_json(options.out, result, settings, SEED)


if __name__ == "__main__":
    main()
