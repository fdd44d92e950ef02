# SPDX-License-Identifier: Apache-2.0
"""Reliability of the scores of methods on a split: of boxes with scores in an interval, the fraction that is correct at IoU 0.5.

The channel is ideal. The figure of the documentation is drawn from the result.

python benchmarks/reliability.py --data data/carla-towns-small --split test [--frame-stride 12] [--methods ...]
    [--weights costr-small] --out benchmarks/results/detection/reliability.json
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from manyeyes.agents.replay import WARMUP_FRAMES, ReplayConfig
from manyeyes.datasets.opv2v.reader import Opv2vRecording
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, run_benchmarks
from manyeyes.evaluation.statistics.reliability import ReliabilityBin
from manyeyes.models import pretrained
from manyeyes.studies.provenance import write_json

METHODS = ("no-fusion-temporal", "late-temporal", "intermediate-temporal", "early-temporal")


@dataclass(frozen=True)
class Row:
    """Bins of the scores of one method, and their expected calibration error."""

    method: str
    bins: tuple[ReliabilityBin, ...]
    expected_error: float


def measure(opener: partial[Opv2vRecording], config: BenchmarkConfig) -> list[Row]:
    """Evaluate the methods of a benchmark and return the reliability of the scores of each."""
    (tallies,) = run_benchmarks(opener, [config], 1)
    found = [(tally.method, tally.compute_reliability()) for tally in tallies]
    return [Row(method, reliability.bins, reliability.expected_error) for method, reliability in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--frame-stride", type=int, default=1)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--weights", default="costr-small")
    parser.add_argument("--out", type=Path, required=True)
    wanted = parser.parse_args()
    torch.set_num_threads(1)
    replay = ReplayConfig(warmup_frames=WARMUP_FRAMES)
    config = BenchmarkConfig(
        pretrained.load(wanted.weights), tuple(wanted.methods), "global-sort", replay, frame_stride=wanted.frame_stride
    )
    rows = measure(partial(Opv2vRecording, wanted.data, wanted.split), config)
    for row in rows:
        print(f"{row.method}: expected calibration error {row.expected_error:.3f}")
    command = shlex.join(["python", *sys.argv])
    result = {"command": command, "split": wanted.split, "frame_stride": wanted.frame_stride, "rows": rows}
    write_json(wanted.out, result, {"weights": wanted.weights}, seed=0)


if __name__ == "__main__":
    main()
