# SPDX-License-Identifier: Apache-2.0
"""CPU time of a training step of the detector against an older commit, and equality of loss and gradients.

Each version runs in a process of its own, so that numba's caches stay apart, with one thread. Both start from the shipped weights
in the middle of a training preset, where cells are pruned. They run the same steps in turn, and the first one alternates: draw
the samples of a batch, forward, backward, optimiser step, moving average. The ratio is that of summed CPU times, with a 95 %
interval by a bootstrap over steps. Before that, both compute loss and gradients of the same batches at the same weights: the
difference of a batch is the norm of that of all gradients over the norm of the older gradients; the worst tensor is stated too.

Samples are those of each version. A baseline before 251ae3d, as the default one, does not level them, so that its losses and
gradients differ: ``--batches 0`` leaves their comparison out. It is meant for baselines of equal samples.

Sensors are those of the recording. It holds eight scenarios of carla-towns-small's training towns, and is simulated once.

python benchmarks/train_step.py [--baseline COMMIT] [--presets costr-small/stage4 costr-small/stage1] [--steps 40] [--batches 6]
    [--data FOLDER] [--out benchmarks/results/train_step.json]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
PRESETS = ("costr-small/stage4", "costr-small/stage1")
WARMUP = 3
PARTS: tuple[str, ...] = ("draw", "loss", "backward")
BAR = 0.7
"""Maximum ratio of CPU times (issue 23, section 4)."""


class Worker:
    """One version of the package in a process of its own, which executes commands one by one."""

    def __init__(self, source: Path, preset: str, data: Path) -> None:
        command = [sys.executable, __file__, "--work", "--presets", preset, "--data", str(data)]
        environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def call(self, *words: str) -> dict[str, float]:
        """Execute one command and return its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(" ".join(words) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            sys.exit("A version of the package stopped; its message is above.")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def work(preset: str, data: Path) -> None:
    """Execute commands from the standard input: ``step``, or ``gradients NUMBER FILE``."""
    from manyeyes.datasets.opv2v import Opv2vRecording
    from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
    from manyeyes.training.detector.task import DetectorTask
    from manyeyes.training.trainer import Trainer

    torch.set_num_threads(1)
    weights = ROOT / "src" / "manyeyes" / "models" / "weights" / "costr-small.safetensors"
    spent = dict.fromkeys(PARTS, 0.0)
    config = DETECTOR_TRAINING_PRESETS[preset]
    if hasattr(config.augment, "sensors"):  # older versions have none
        config = replace(config, augment=replace(config.augment, sensors=None))
    task = DetectorTask(config, Opv2vRecording(data), start=weights)
    _time_parts(task, spent)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(task, Path(folder))
        trainer.step = task.steps // 2
        for line in sys.stdin:
            name, *given = line.split()
            if name == "step":
                spent.update(dict.fromkeys(PARTS, 0.0))
                before = time.process_time()
                loss = trainer.advance().loss
                print(json.dumps({"cpu": time.process_time() - before, "value": loss, **spent}), flush=True)
            else:
                numbers = range(int(given[0]), int(given[0]) + task.config.batch)
                state = {key: value.clone() for key, value in trainer.model.state_dict().items()}
                trainer.model.train()
                loss, _ = task.loss(trainer.model, [task.draw(n) for n in numbers], numbers, trainer.step)
                loss.backward()
                named = trainer.model.named_parameters()
                torch.save({key: p.grad for key, p in named if p.grad is not None}, given[1])
                trainer.model.zero_grad(set_to_none=True)
                trainer.model.load_state_dict(state)
                print(json.dumps({"value": float(loss.detach())}), flush=True)


def _time_parts(task: object, spent: dict[str, float]) -> None:
    """Add the CPU time of the parts of a step to spent."""

    def timed(owner: object, name: str, part: str) -> None:
        function = getattr(owner, name)

        def call(*args: object) -> object:
            before = time.process_time()
            result = function(*args)
            spent[part] += time.process_time() - before
            return result

        setattr(owner, name, call)

    for owner, name, part in ((task, "draw", "draw"), (task, "loss", "loss"), (torch.Tensor, "backward", "backward")):
        timed(owner, name, part)


def make_recording(folder: Path) -> Path:
    """Simulate the recording into a folder unless it is there; returns the folder of its scenarios."""
    if not (folder / "manifest.json").exists():
        from manyeyes.simulator.presets import make_jobs, simulation_preset
        from manyeyes.simulator.record import record

        jobs = [job for job in make_jobs(simulation_preset("carla-towns-small"), 0) if job.split == "train"][:40:5]
        record(jobs, folder, 1, None, {"preset": "carla-towns-small, every fifth of 40 training scenes", "seed": 0})
    return folder / "train"


def checkout(commit: str, folder: Path) -> Path:
    """Extract the package of a commit unless it is there; returns the folder to import it from."""
    name = subprocess.run(["git", "rev-parse", commit], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    place = folder / name.strip()[:12]
    if not place.exists():
        place.mkdir(parents=True)
        archive = subprocess.run(["git", "archive", commit, "src"], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x", "-C", str(place)], input=archive, check=True)
    return place / "src"


@dataclass(frozen=True)
class Difference:
    """Largest relative difference over batches: of the loss, of all gradients together, and of any one tensor's gradient."""

    loss: float
    gradients: float
    worst_tensor: float
    worst_name: str


def compare_gradients(old: Worker, new: Worker, batches: int) -> Difference:
    """Compare loss and gradients of the same batches at the same weights."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for batch in range(batches):
            files = [Path(folder) / f"{name}.pt" for name in ("old", "new")]
            values = [w.call("gradients", str(10**6 + 100 * batch), str(f))["value"] for w, f in zip((old, new), files)]
            a, b = (torch.load(file) for file in files)
            assert a.keys() == b.keys()
            norm = {key: float(a[key].double().norm()) for key in a}
            error = {key: float((a[key].double() - b[key]).norm()) for key in a}
            scale = math.hypot(*norm.values())
            each = {key: error[key] / max(norm[key], 1e-4 * scale) for key in a}
            worst = max(each, key=lambda key: each[key])
            found.append((abs(values[1] / values[0] - 1), math.hypot(*error.values()) / scale, each[worst], worst))
    worst = max(found, key=lambda f: f[2])
    return Difference(max(f[0] for f in found), max(f[1] for f in found), worst[2], worst[3])


def measure(old: Worker, new: Worker, steps: int) -> dict[str, object]:
    """Run steps in turn; returns CPU times in milliseconds, their ratio and its interval."""
    rows = []
    for step in range(WARMUP + steps):
        order = (old, new) if step % 2 else (new, old)
        answers = [worker.call("step") for worker in order]
        rows.append(answers if step % 2 else answers[::-1])
    rows = rows[WARMUP:]
    cpu = np.array([[side["cpu"] for side in pair] for pair in rows])
    drawn = np.random.default_rng(0).integers(0, steps, (2000, steps))
    sums = cpu[drawn].sum(1)
    low, high = np.quantile(sums[:, 1] / sums[:, 0], (0.025, 0.975))
    parts = {
        part: [round(1e3 * float(np.mean([pair[side][part] for pair in rows])), 1) for side in (0, 1)] for part in PARTS
    }
    return {
        "cpu_ms": [round(1e3 * float(v), 1) for v in cpu.mean(0)],
        "ratio": round(float(cpu[:, 1].sum() / cpu[:, 0].sum()), 4),
        "ratio_95": [round(float(low), 4), round(float(high), 4)],
        "parts_ms": parts,
        "loss_difference_of_last_step": abs(rows[-1][1]["value"] / rows[-1][0]["value"] - 1),
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Measure every preset, print and store the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cache = Path(os.environ.get("MANYEYES_CACHE") or Path.home() / ".cache" / "manyeyes") / "benchmarks"
    parser.add_argument("--baseline", default="f80ac70")
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--batches", type=int, default=6)
    parser.add_argument("--data", type=Path, default=cache / "train_step")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "train_step.json")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.work:
        work(args.presets[0], args.data)
        return
    data, source = make_recording(args.data), checkout(args.baseline, cache / "checkouts")
    results = {}
    for preset in args.presets:
        old, new = (Worker(place, preset, data) for place in (source, ROOT / "src"))
        difference = asdict(compare_gradients(old, new, args.batches)) if args.batches else None
        results[preset] = {**measure(old, new, args.steps), "difference": difference}
        for worker in (old, new):
            worker.close()
        print(preset, json.dumps(results[preset], indent=1))
    from manyeyes.studies.provenance import git_commit

    # Folders of this machine mean nothing elsewhere.
    words = [Path(word).name if word.startswith("/") else word for word in (sys.argv[1:] if argv is None else argv)]
    load = [round(value, 1) for value in os.getloadavg()]
    content = {
        "command": shlex.join(["python", "benchmarks/train_step.py", *words]),
        "baseline": args.baseline,
        "commit": git_commit(),
        "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
        "load_average": dict(zip(("1_min", "5_min", "15_min"), load)),
        "bar": BAR,
        "presets": results,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
