# SPDX-License-Identifier: Apache-2.0
"""Time of a training step in float32 and in bfloat16, in turn in one process, on a GPU.

Samples are drawn before, so that a step is its loss, gradients, optimiser step and moving average. Cells are pruned from the first
step on. A step is timed until the device has caught up; the ratio is that of medians.

python benchmarks/gpu_precision.py --data data/carla-sensors-small [--presets costr-opv2v costr-small/stage4] [--steps 20]
    [--device cuda] [--out out/gpu_precision.json]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from manyeyes.datasets.base import Recording
from manyeyes.datasets.registry import open_recording
from manyeyes.studies import provenance
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.samples import Sample
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.devices import resolve_device
from manyeyes.training.mixed_precision import Precision
from manyeyes.training.trainer import Trainer

PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")
WARMUP = 3


class _DrawnTask(DetectorTask):
    """A task whose samples are drawn once, four batches, and then repeated."""

    def __init__(self, config: DetectorTrainConfig, recording: Recording) -> None:
        super().__init__(config, recording)
        self._samples = [super(_DrawnTask, self).draw(number) for number in range(4 * config.batch)]

    def draw(self, number: int) -> Sample:
        """Return a sample that was drawn before."""
        return self._samples[number % len(self._samples)]


def time_steps(preset: str, data: Path, device: torch.device, steps: int, folder: Path) -> dict[str, list[float]]:
    """Return seconds of each step by precision; both advance in turn."""
    config = replace(DETECTOR_TRAINING_PRESETS[preset], prune_warmup_start=-1.0, prune_warmup_end=-0.5)
    recording = open_recording(data, "train")
    trainers = {
        p: Trainer(_DrawnTask(replace(config, precision=p), recording), folder / preset / p, device) for p in PRECISIONS
    }
    for trainer in trainers.values():
        for _ in range(WARMUP):
            trainer.advance()
    seconds: dict[str, list[float]] = {p: [] for p in PRECISIONS}
    for step in range(steps):
        for precision in PRECISIONS if step % 2 else PRECISIONS[::-1]:
            began = time.perf_counter()
            trainers[precision].advance()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds[precision].append(time.perf_counter() - began)
    return seconds


def main() -> None:
    """Time the presets, print medians and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--presets", nargs="+", default=["costr-opv2v", "costr-small/stage4"])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--out", type=Path, default=Path("out") / "gpu_precision.json")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    device = resolve_device(chosen.device)
    rows = []
    with tempfile.TemporaryDirectory(prefix="manyeyes-precision-") as folder:
        for preset in chosen.presets:
            seconds = time_steps(preset, chosen.data, device, chosen.steps, Path(folder))
            medians = {p: 1e3 * statistics.median(seconds[p]) for p in PRECISIONS}
            ratio = medians["bfloat16"] / medians["float32"]
            rows.append({"preset": preset, "median_ms": medians, "ratio": ratio, "seconds": seconds})
            print(preset, {p: round(v, 1) for p, v in medians.items()}, f"ratio {ratio:.3f}", flush=True)
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    provenance.write_json(chosen.out, {"device": name, "rows": rows}, {"options": vars(chosen)}, 0)


if __name__ == "__main__":
    main()
