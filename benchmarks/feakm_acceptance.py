# SPDX-License-Identifier: Apache-2.0
"""Choose the acceptance score of FeaKM's corrector: views of different scenes, which have no pose, and true pairs of agents.

For each limit: the fraction of pairs of views of different scenes that are answered, and of true pairs of agents those that are
answered and those within 1 m and 1 degree, all without priors. The limit to take is the smallest at which at most 0.5 % of the
pairs of different scenes are answered. It is chosen on the validation town.

python -m benchmarks.feakm_acceptance [--data data/carla-towns-small] [--split val] [--frame-stride 4] [--pairs 600]
    [--out benchmarks/results/feakm_acceptance.json]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.pose_real import Line, Outcome, judge, make_rate_line, write_lines
from numpy.typing import NDArray

from manyeyes.datasets.registry import open_recording
from manyeyes.evaluation.pose.accuracy import LandmarkPair, iterate_landmark_pairs
from manyeyes.models import pretrained
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.corrector import AcceptanceTest
from manyeyes.pose.feakm import ConsensusConfig, FeakmCorrector, solve_with_consensus
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate, project_to_se2

SEED = 0
LIMITS = (12.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0, 20.0, 22.0, 24.0)
MAX_NULL_FRACTION = 0.005
Matched = tuple[Landmarks, Landmarks, NDArray[np.int64]]


def match(corrector: FeakmCorrector, ego: Landmarks, other: Landmarks) -> Matched:
    """Return both sets of landmarks and the rows that the net matches."""
    found = [np.zeros((0, 2), np.int64)]

    def keep(ego: Landmarks, other: Landmarks, pairs: NDArray[np.int64], prior: PosePrior | None) -> PoseEstimate:
        found[0] = pairs
        return no_estimate(prior)

    replace(corrector, solver=keep)(ego, other, None)
    return ego, other, found[0]


def draw_null_views(pairs: Sequence[LandmarkPair], count: int) -> Iterator[tuple[Landmarks, Landmarks]]:
    """Yield views of two different scenarios."""
    for n in range(count):
        rng = keyed_generator(SEED, "views", n)
        first = pairs[int(rng.integers(len(pairs)))]
        others = [p for p in pairs if p.scenario != first.scenario]
        yield first.ego, others[int(rng.integers(len(others)))].other


def sweep_limits(pairs: Sequence[LandmarkPair], corrector: FeakmCorrector, count: int) -> Iterator[Line]:
    """Yield the lines of every limit."""
    nulls = [match(corrector, *views) for views in draw_null_views(pairs, count)]
    true = [match(corrector, pair.ego, pair.other) for pair in pairs]
    truths = [project_to_se2(pair.ego_from_other) for pair in pairs]
    for limit in LIMITS:
        config = ConsensusConfig(accept=AcceptanceTest(min_score=limit))
        answered = [solve_with_consensus(*one, None, config).status.has_estimate for one in nulls]
        outcomes: list[Outcome] = [
            judge(solve_with_consensus(*one, None, config), truth) for one, truth in zip(true, truths)
        ]
        what = f"limit {limit:g}"
        yield make_rate_line(f"{what}: different scenes answered", answered, (None, MAX_NULL_FRACTION))
        yield make_rate_line(f"{what}: true pairs answered", [o.status.has_estimate for o in outcomes], (None, None))
        yield make_rate_line(f"{what}: within 1 m, 1 deg", [o.is_within(1.0) for o in outcomes], (None, None))


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path("data/carla-towns-small"))
    parser.add_argument("--split", default="val")
    parser.add_argument("--frame-stride", type=int, default=4)
    parser.add_argument("--pairs", type=int, default=600)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/feakm_acceptance.json"))
    options = parser.parse_args()
    net = pretrained.load_feakm()
    recording = open_recording(options.data, options.split)
    pairs = list(iterate_landmark_pairs(recording, pretrained.load(), frame_stride=options.frame_stride, net=net))
    lines = list[Line]()
    for line in sweep_limits(pairs, FeakmCorrector.of(net), options.pairs):
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
        lines.append(line)
    write_lines(options.out, "feakm_acceptance", lines, SEED)


if __name__ == "__main__":
    main()
