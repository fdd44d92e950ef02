# SPDX-License-Identifier: Apache-2.0
"""Detection AP with the default corrector and with that of a baseline commit, on the same messages, in one process.

The study pose-noise-ap, with the corrector ``voting`` of the commit beside the present one: landmarks, priors and everything around
the corrector are the present ones. Pose errors are those of the table that the commit's documents hold: a new one in each frame,
stated as a covariance.

python benchmarks/pose_noise_baseline.py --data data/carla-towns-small [--baseline a6c4d23] [--split test] [--scenario-stride 1]
    [--perturbations "0.8°" "0.8 m" "2°, 2 m"] [--out out/pose_noise_baseline]
"""

from __future__ import annotations

import argparse
import importlib
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from versions import ROOT, Version, checkout, use_own_cache

CACHE = use_own_cache()
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from numba.core import caching  # noqa: E402

from manyeyes.cli.main import main as run_command  # noqa: E402
from manyeyes.pose.landmarks import Landmarks  # noqa: E402
from manyeyes.pose.registry import register_pose_corrector  # noqa: E402
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3  # noqa: E402

LANDMARK_COLUMNS = ("xy", "yaw", "size", "score", "sigma_xy", "sigma_yaw", "p_flip", "instant")
"""In the order of the baseline's constructor, which names p_flip differently."""
PERTURBATIONS = ("clean", "0.8°", "0.8 m", "2°, 2 m")
FRAME_STRIDE = 6
"""Two frames of each scenario."""


@dataclass
class BaselineVoting(Version):
    """The default corrector of a checkout, behind the present interface."""

    def start(self) -> None:
        """Import the checkout."""
        # a6c4d23 adds its own lock of numba's files, which this version holds already.
        locked = caching.IndexDataCacheFile
        caching.IndexDataCacheFile = locked.__base__
        with self.active():
            self.landmarks = importlib.import_module("manyeyes.alignment.landmarks").Landmarks
            self.prior = importlib.import_module("manyeyes.alignment.estimate").PoseClaim
            self.transform = importlib.import_module("manyeyes.datatypes").Transform
            self.correct = importlib.import_module("manyeyes.alignment.rivals.table").CORRECTORS["vote"]
        caching.IndexDataCacheFile = locked

    def __call__(self, ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
        """Estimate ego_from_other by the checkout's corrector."""
        with self.active():
            sides = [self.landmarks(*(getattr(side, name) for name in LANDMARK_COLUMNS)) for side in (ego, other)]
            found = self.correct(*sides, None if prior is None else self._convert(prior))
            pose = found.pose
        return PoseEstimate(
            None if pose is None else lift_to_se3(pose, prior),
            found.covariance,
            PoseStatus(found.status.value),
            found.inliers,
            found.runner_up,
            found.margin,
            found.pairs,
            found.measured,
            found.measured_covariance,
            found.distance,
        )

    def _convert(self, prior: PosePrior) -> Any:
        transform = prior.ego_from_other
        columns = {field.name: getattr(transform, field.name) for field in fields(self.transform)}
        return self.prior(self.transform(**columns), prior.covariance)


def main() -> int:
    """The comparison, as a report of the study."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--baseline", default="a6c4d23")
    parser.add_argument("--scenario-stride", type=int, default=1)
    parser.add_argument("--perturbations", nargs="+", default=list(PERTURBATIONS))
    parser.add_argument("--out", type=Path, default=Path("out/pose_noise_baseline"))
    options = parser.parse_args()
    name = f"voting-{options.baseline}"
    with checkout(options.baseline) as code:
        baseline = BaselineVoting(code / "src")
        baseline.start()
        register_pose_corrector(name)(baseline)
        return run_command(
            ["study", "pose-noise-ap", "--data", options.data, "--split", options.split, "--workers", "1",
             "--frame-stride", str(FRAME_STRIDE), "--scenario-stride", str(options.scenario_stride),
             "--claimed-covariance", "true", "--noise-in-time", "independent", "--no-odometry-drift",
             "--methods", "no-fusion-temporal", "intermediate-temporal", "--correctors", "identity", "voting", name,
             "--perturbations", *options.perturbations, "--out", str(options.out)]
        )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
