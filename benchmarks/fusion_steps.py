# SPDX-License-Identifier: Apache-2.0
"""CPU time of a training step of every fusion that is compared, parameters, and the hours of all runs that follow from it.

Each preset starts from the shipped weights as far as they fit, in the middle of its run, where cells are pruned; one thread. The
samples of a batch are the same for all presets. A step is draw, forward, backward, optimiser and moving average; the median counts.

python benchmarks/fusion_steps.py --data FOLDER [--presets fusion/fast ...] [--steps 5] [--out benchmarks/results/fusion_steps.json]
"""

from __future__ import annotations

import argparse
import json
import platform
import shlex
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from manyeyes._io import atomic_write
from manyeyes.datasets.registry import open_recording
from manyeyes.training.detector.fusion_presets import FUSION_PLANS, FUSION_TRAINING_PRESETS
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.trainer import Trainer

ROOT = Path(__file__).resolve().parents[1]
WARMUP = 1
STAGES = {f"stage-a/{name}": config for name, config in FUSION_PLANS["stage-a"].stages}


def measure(config: DetectorTrainConfig, data: Path, steps: int, seed: int = 5) -> dict[str, float]:
    """Return the median CPU time of a step, seconds, and the number of parameters of the fusion and of the whole model."""
    weights = ROOT / "src" / "manyeyes" / "models" / "weights" / "costr-small.safetensors"
    task = DetectorTask(config, open_recording(data, "train"), seed, start=weights)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(task, Path(folder))
        trainer.step = task.steps // 2
        spent: list[float] = []
        for _ in range(WARMUP + steps):
            before = time.process_time()
            trainer.advance()
            spent.append(time.process_time() - before)
        fusion, whole = (sum(p.numel() for p in m.parameters()) for m in (trainer.model.fusion, trainer.model))
    return {"seconds": round(statistics.median(spent[WARMUP:]), 3), "fusion_parameters": fusion, "parameters": whole}


def format_table(rows: dict[str, dict[str, Any]]) -> str:
    """Return a table of the presets: seconds a step, hours of the run, and parameters of the fusion."""
    lines = ["| preset | s/step | steps | hours | parameters of the fusion |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        hours = row["seconds"] * row["steps"] / 3600
        lines.append(
            f"| `{name}` | {row['seconds']:.2f} | {row['steps']} | {hours:.2f} | {row['fusion_parameters']:,} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, write the results after every preset, and print them as a table."""
    # A step of stage C is that of stage B.
    compared = {name: config for name, config in FUSION_TRAINING_PRESETS.items() if not name.startswith("stage-c/")}
    presets = {**STAGES, **compared}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--presets", nargs="+", choices=presets, default=list(presets))
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "fusion_steps.json")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, dict[str, Any]] = {}
    if chosen.out.exists():
        rows = json.loads(chosen.out.read_text())["presets"]
    for name in chosen.presets:
        rows[name] = {**measure(presets[name], chosen.data, chosen.steps), "steps": presets[name].steps}
        print(name, rows[name], file=sys.stderr, flush=True)
        command = shlex.join(["python", "benchmarks/fusion_steps.py", "--data", "FOLDER", "--steps", str(chosen.steps)])
        machine = {"processor": platform.processor() or platform.machine(), "torch": torch.__version__, "threads": 1}
        result = {"command": command, **machine, "presets": {key: rows[key] for key in presets if key in rows}}
        atomic_write(chosen.out, (json.dumps(result, indent=1) + "\n").encode())
    print(format_table({key: rows[key] for key in presets if key in rows}))


if __name__ == "__main__":
    main()
