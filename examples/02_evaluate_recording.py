# SPDX-License-Identifier: Apache-2.0
"""Simulate the drive of the demo, send bytes over a radio channel, and evaluate four fusion strategies on every fifth frame."""

import sys
import tempfile
from functools import partial
from pathlib import Path

from manyeyes import Opv2vRecording
from manyeyes.agents.replay import ReplayConfig
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, run_benchmark
from manyeyes.simulator.presets import simulate

if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "drive"
    if not folder.exists():
        simulate("demo", folder, seed=0)
    config = BenchmarkConfig(replay=ReplayConfig(channel="its-g5-27mbps", latency_budget_s=0.1), frame_stride=5)
    results = run_benchmark(partial(Opv2vRecording, folder, "test"), config)
    alone = results[0].ap[0].ap
    for row in results:
        sent, ap = row.communication, row.ap[0].ap
        size = (
            f"{sent.bytes_per_message:7.0f} bytes a message, {ap - alone:+.3f}" if sent.num_messages else "nothing sent"
        )
        print(f"{row.method:13} AP@0.5 {ap:.3f}  AP@0.7 {row.ap[1].ap:.3f}  {size}")
