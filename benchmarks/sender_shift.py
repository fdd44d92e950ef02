# SPDX-License-Identifier: Apache-2.0
"""AP of intermediate fusion with and without the shift of senders, under pose errors that persist and are not told.

python benchmarks/sender_shift.py --data DATA --split val [--every 40] [--warmup 7] [--out benchmarks/results/sender_shift.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from manyeyes import open_recording
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.replay import ReplayConfig
from manyeyes.datasets.odometry_drift import OdometryDrift
from manyeyes.datasets.perturbation import NoiseInTime, PoseNoise
from manyeyes.evaluation.detection.accumulator import IOU_THRESHOLDS, MethodResult
from manyeyes.evaluation.detection.benchmark import (
    BenchmarkConfig,
    find_thresholds,
    load_detector,
    resolve_protocol,
    run_benchmarks,
)
from manyeyes.studies.provenance import write_json

METHODS = ("intermediate", "intermediate-shift", "intermediate-temporal", "intermediate-shift-temporal")
LEVELS: tuple[tuple[float, NoiseInTime], ...] = (
    (0.0, "autoregressive"), (0.4, "autoregressive"), (0.8, "autoregressive"), (0.4, "constant"), (0.8, "constant"),
)  # fmt: skip


def describe(
    condition: dict[str, Any], config: BenchmarkConfig, results: dict[str, MethodResult]
) -> list[dict[str, Any]]:
    """One row a method, with its difference to plain intermediate fusion and to the ego alone, of the same form."""
    protocol, rows = resolve_protocol(config), []
    for name, result in results.items():
        row, form = {**condition, "method": name}, "-temporal" if name.endswith("-temporal") else ""
        for column, iou in enumerate(IOU_THRESHOLDS):
            interval = result.intervals[column]
            row[f"ap@{iou:g}"] = [interval.value, interval.low, interval.high]
            for base in (f"intermediate{form}", f"no-fusion{form}"):
                if base in results and name != base:
                    gain = result.paired_difference(results[base], column, protocol)
                    row[f"less {base} @{iou:g}"] = [gain.value, gain.low, gain.high]
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--split", default="val")
    parser.add_argument("--every", type=int, default=40)
    parser.add_argument("--warmup", type=int, default=7)
    parser.add_argument("--weights", default="costr-small")
    parser.add_argument("--correctors", nargs="*", default=["off", "voting"])
    parser.add_argument("--methods", nargs="*", default=METHODS)
    parser.add_argument("--sigmas", nargs="*", type=float, default=[0.0, 0.4, 0.8])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    opening = partial(open_recording, given.data, given.split)
    conditions, configs = [], []
    for corrector in given.correctors:
        correction = None if corrector == "off" else PoseCorrection(corrector)
        for sigma_m, in_time in [level for level in LEVELS if level[0] in given.sigmas]:
            noise = PoseNoise(in_time=in_time).at_level(sigma_m, 0.0)
            replay = ReplayConfig(warmup_frames=given.warmup, pose_correction=correction)
            drift = OdometryDrift()
            conditions.append({"corrector": corrector, "sigma_m": sigma_m, "in_time": in_time if sigma_m else "none"})
            configs.append(
                BenchmarkConfig(
                    given.weights, tuple(given.methods), replay=replay, pose_noise=noise, odometry_drift=drift,
                    frame_stride=given.every,
                )
            )  # fmt: skip
    detector, rows, start = load_detector(given.weights), [], time.time()
    for condition, config, tallies in zip(conditions, configs, run_benchmarks(opening, configs)):
        results = {t.method: t.compute_results(find_thresholds(detector, t.method))[0] for t in tallies}
        found = describe(condition, config, results)
        rows += found
        for row in found:
            print(
                *(f"{k}={[round(v, 3) for v in x] if isinstance(x, list) else x}" for k, x in row.items()), flush=True
            )
    print(f"{time.time() - start:.0f} s")
    if given.out:
        command = f"python benchmarks/sender_shift.py {shlex.join(sys.argv[1:])}"
        write_json(given.out, {"command": command, "rows": rows}, vars(given), 0)


if __name__ == "__main__":
    main()
