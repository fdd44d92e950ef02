# SPDX-License-Identifier: Apache-2.0
"""AP of presets of the published data sets after 200 steps on simulated scenes, beside the network of costr-small.

costr-opv2v is trained on scenes of 64 beams in OPV2V's layout, costr-dair on scenes with DAIR-V2X's sensors and layout, each from
random weights. The small network has the same range, samples, learning rate and steps, so that only the networks differ. Scenes
are those of the presets smoke-opv2v and dair-crossing on the generated towns of SPLITS. AP is that of the split val, over the
range of the detector. Two hundred steps show that a preset learns; they do not rank networks.
Stopped runs go on: each run keeps its state in its folder, every 10 steps, and finished evaluations are kept.

python benchmarks/preset_steps.py [--presets costr-opv2v costr-dair] [--steps 200] [--data data/preset_steps]
    [--runs runs/preset_steps] [--frames 40] [--out benchmarks/results/preset_steps.json]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from manyeyes import benchmark
from manyeyes.datasets.base import iter_eval_frames
from manyeyes.datasets.registry import open_recording
from manyeyes.evaluation.detection.recording_filters import FrameStride
from manyeyes.models.detector.presets import COSTR_SMALL
from manyeyes.simulator.presets import SplitPreset, make_jobs, simulation_preset
from manyeyes.simulator.record import record
from manyeyes.studies.provenance import write_json
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

SCENES = {"costr-opv2v": "smoke-opv2v", "costr-dair": "dair-crossing"}
"""Presets of training, and the preset of simulation whose sensors and layout stand for their data set."""
SPLITS = (
    SplitPreset("train", ("generated-1", "generated-4", "generated-6", "generated-7"), 16),
    SplitPreset("val", ("generated-2", "generated-8"), 4),
)
FRAMES = 5
NETWORKS = ("preset", "small")
METHODS = ("no-fusion", "intermediate-temporal")
LEARNING_RATE = 1e-3
"""Of both networks: the published 2e-4 moves little in 200 steps."""


@dataclass(frozen=True)
class Row:
    """AP of one network; cpu_s_per_step: of training, in the last part of the run where it was stopped."""

    preset: str
    network: str
    steps: int
    cpu_s_per_step: float | None
    frames: int
    ap50: dict[str, float]
    ap70: dict[str, float]


def make_config(preset: str, network: str, steps: int) -> DetectorTrainConfig:
    """Return the settings of a run: those of the preset with fewer steps, and for "small" another network at its range."""
    config = DETECTOR_TRAINING_PRESETS[preset]
    detector = config.detector
    if network == "small":
        detector = replace(COSTR_SMALL, grid=detector.grid, output_range=detector.output_range, sweeps=detector.sweeps)
    return replace(
        config, detector=detector, steps=steps, learning_rate=LEARNING_RATE, warmup_steps=steps // 10, save_every=10
    )


def find_row(root: Path, preset: str, network: str, steps: int, runs: Path, max_frames: int) -> Row:
    """Train, or go on, and evaluate; a finished row is read."""
    folder = runs / f"{preset}-{network}"
    kept = folder / "row.json"
    if kept.exists():
        row = Row(**json.loads(kept.read_text(encoding="utf-8"))["result"])
        if row.steps == steps:
            return row
    folder.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(DetectorTask(make_config(preset, network, steps), open_recording(root, "train")), folder)
    left, start = steps - trainer.step, time.process_time()
    weights = trainer.run(report=lambda at: print(f"{preset} {network} {at.step}: {at.loss:.3f}", flush=True))
    seconds = (time.process_time() - start) / left if left else None
    held = open_recording(root, "val")
    stride = max(1, sum(1 for _ in iter_eval_frames(held)) // max_frames)
    found = benchmark(FrameStride(held, stride), weights, METHODS).methods
    frames = sum(1 for _ in iter_eval_frames(FrameStride(held, stride)))
    ap50, ap70 = ({result.method: result.intervals[i].value for result in found} for i in range(2))
    row = Row(preset, network, steps, seconds, frames, ap50, ap70)
    write_json(kept, row, {"preset": preset, "network": network, "steps": steps}, 0)
    return row


def simulate_scenes(preset: str, root: Path) -> Path:
    """Simulate the scenes of a preset of training, unless they are there; returns their folder."""
    name = SCENES[preset]
    folder = root / name
    jobs = make_jobs(replace(simulation_preset(name), splits=SPLITS, frames=FRAMES), 0)
    record(jobs, folder, 1, None, {"preset": f"{name}, splits of benchmarks/preset_steps.py", "seed": 0})
    return folder


def format_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of a page in Markdown: AP of both networks of one preset."""
    lines = [
        "| network | steps | AP@0.5 intermediate | AP@0.5 no fusion | CPU time of a step [s] |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        name = f"`{row['preset']}`" if row["network"] == "preset" else "small network, same range"
        ap, seconds = row["ap50"], row["cpu_s_per_step"]
        shown = "" if seconds is None else f"{seconds:.2f}"
        alone, together = (ap[method] for method in METHODS)
        lines.append(f"| {name} | {row['steps']} | {together:.3f} | {alone:.3f} | {shown} |")
    return "\n".join(lines)


def main() -> None:
    """Train and evaluate both networks of both presets, print and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--frames", type=int, default=40, help="frames that are evaluated at most")
    parser.add_argument("--data", type=Path, default=Path("data/preset_steps"))
    parser.add_argument("--runs", type=Path, default=Path("runs/preset_steps"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/preset_steps.json"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        find_row(root, preset, network, given.steps, given.runs, given.frames)
        for preset, root in [(preset, simulate_scenes(preset, given.data)) for preset in given.presets]
        for network in NETWORKS
    ]
    for row in rows:
        print(row)
    write_json(given.out, rows, {"steps": given.steps, "learning_rate": LEARNING_RATE, "frames": given.frames}, 0)


if __name__ == "__main__":
    main()
