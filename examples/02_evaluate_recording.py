# SPDX-License-Identifier: Apache-2.0
"""Simulate a small drive, send bytes over a radio channel, and evaluate four fusion strategies."""

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
        simulate("smoke-opv2v", folder, seed=0)
    config = BenchmarkConfig(replay=ReplayConfig(channel="its-g5-27mbps", latency_budget_s=0.1))
    for row in run_benchmark(partial(Opv2vRecording, folder, "test"), config):
        sent = row.communication
        size = f"{sent.bytes_per_message:9.0f} bytes a message" if sent.num_messages else "nothing sent"
        print(f"{row.method:13} AP@0.5 {row.ap[0].ap:.3f}  AP@0.7 {row.ap[1].ap:.3f}  {size}")
