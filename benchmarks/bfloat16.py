# SPDX-License-Identifier: Apache-2.0
"""Average precision of shipped weights with products of bfloat16 against those of float32, on drives of Town07 (val).

Every agent is ego, the channel is ideal. Bar: AP at IoU 0.5 and 0.7, with and without fusion, differs by at most 0.002.

python benchmarks/bfloat16.py [--weights costr-small] [--recording ROOT] [--drives 4] [--beams 16]
    [--out benchmarks/results/bfloat16.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from manyeyes.agents.replay import WARMUP_FRAMES, ReplayConfig
from manyeyes.datasets.opv2v.reader import Opv2vRecording
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, run_benchmarks
from manyeyes.models import pretrained
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16
from manyeyes.simulator.presets import SIMULATION_PRESETS, make_jobs
from manyeyes.simulator.record import record
from manyeyes.studies.provenance import write_json

MAX_DIFFERENCE = 0.002
"""Bar: largest difference of an AP."""


@dataclass(frozen=True)
class Row:
    """AP of one method at IoU 0.5 and 0.7, by products, and bytes of a message."""

    method: str
    ap_float32: tuple[float, ...]
    ap_bfloat16: tuple[float, ...]
    max_difference: float
    bytes_float32: float
    bytes_bfloat16: float


def simulate(folder: Path, beams: int, count: int) -> None:
    """Write drives of Town07 with so many beams."""
    preset = SIMULATION_PRESETS["carla-towns-small"]
    splits = tuple(replace(p, count=count, lidar_beams=(beams,)) for p in preset.splits if p.split == "val")
    record(make_jobs(replace(preset, splits=splits), seed=0), folder, settings={"beams": beams})


def compare(weights: str, recording: Path) -> list[Row]:
    """Return the rows of both methods."""
    replay = ReplayConfig(warmup_frames=WARMUP_FRAMES, all_egos=True)
    configs = [
        BenchmarkConfig(
            pretrained.load(weights, in_bfloat16=kind), ("intermediate-temporal", "none"), "global-sort", replay
        )
        for kind in (False, True)
    ]
    rows = []
    results = [
        [result for tally in found for result in tally.compute_results()]
        for found in run_benchmarks(partial(Opv2vRecording, recording, "val"), configs, 1)
    ]
    for a, b in zip(*results):
        old, new = (tuple(interval.value for interval in r.intervals) for r in (a, b))
        largest = max(abs(x - y) for x, y in zip(old, new))
        rows.append(
            Row(a.method, old, new, largest, a.communication.bytes_per_message, b.communication.bytes_per_message)
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="costr-small")
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--beams", type=int, default=16)
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    if not HAS_BFLOAT16:
        sys.exit("This processor has no products of bfloat16 (AVX512-BF16): there is nothing to compare.")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as spare:
        folder = wanted.recording or Path(spare)
        if wanted.recording is None:
            simulate(folder, wanted.beams, wanted.drives)
        rows = compare(wanted.weights, folder)
    if wanted.out:
        settings = {
            "weights": wanted.weights, "drives": wanted.drives, "beams": wanted.beams, "max_difference": MAX_DIFFERENCE,
        }  # fmt: skip
        command = shlex.join(["python", *sys.argv])
        write_json(wanted.out, {"command": command, "settings": settings, "rows": rows}, settings, seed=0)
    if max(row.max_difference for row in rows) > MAX_DIFFERENCE:
        sys.exit(f"An AP differs by more than {MAX_DIFFERENCE}.")


if __name__ == "__main__":
    main()
