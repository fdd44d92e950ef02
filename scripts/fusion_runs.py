# SPDX-License-Identifier: Apache-2.0
"""Train all fusions that are compared, run after run, so that what is finished at any time is whole rows of the tables.

python scripts/fusion_runs.py --data FOLDER --out runs/fusions [--seeds 5 6 7] [--stage-c fast v2vnet] [--hours 8] [--jobs 2]

Order: the base (stage-a); every fusion inside with the first seed; six bare ones; early fusion; the other seeds, fusion by
fusion; the rows of CoSTr's Table III; the other bare ones; stage C. The rows of Table III and stage C start from random weights,
the others from the base. A run has a folder OUT/NAME/seed-N, and is finished when its weights.safetensors is there. The same
command goes on after it was stopped, in the middle of a run too. OUT/runs.json says which runs are finished, failed or left, and
how long they took. A failed run does not stop the others; those that start from it are left.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path

from manyeyes._io import atomic_write
from manyeyes.training.detector.fusion_presets import BARE_FUSIONS, INSIDE_FUSIONS, STAGE_C_FUSIONS, TABLE3_ROWS

WEIGHTS = "weights.safetensors"
FIRST_BARE = BARE_FUSIONS[:6]
"""Bare fusions that are trained before other seeds."""


@dataclass(frozen=True)
class Run:
    """A preset or plan of training with a seed, and the preset or plan that it starts from."""

    preset: str
    seed: int
    base: str | None = "stage-a"

    @property
    def folder(self) -> Path:
        """Folder of the run, in that of all runs."""
        return Path(self.preset) / f"seed-{self.seed}"


@dataclass(frozen=True)
class State:
    """What became of a run: finished, failed or left; seconds of the process that finished or failed it."""

    preset: str
    seed: int
    state: str
    seconds: float = 0.0


def make_runs(seeds: Sequence[int], stage_c: Sequence[str] = ()) -> list[Run]:
    """Return all runs in their order; all start from the base of the first seed."""
    first, *others = seeds
    runs = [Run("stage-a", first, None)]
    runs += [Run(f"fusion/{name}", first) for name in INSIDE_FUSIONS]
    runs += [Run(f"fusion/{name}/bare", first) for name in FIRST_BARE]
    runs.append(Run("early", first))
    runs += [Run(f"fusion/{name}", seed) for name in INSIDE_FUSIONS for seed in others]
    runs += [Run(f"table3/{name}", first, None) for name in TABLE3_ROWS]
    runs += [Run(f"fusion/{name}/bare", first) for name in BARE_FUSIONS if name not in FIRST_BARE]
    return runs + [Run(f"stage-c/{name}", first, None) for name in stage_c]


def make_command(run: Run, base_seed: int, data: Sequence[Path], out: Path, options: Sequence[str]) -> list[str]:
    """Return the command that trains a run, or goes on with it."""
    command = [sys.executable, "-m", "manyeyes.cli.main", "train", "--preset", run.preset, "--seed", str(run.seed)]
    command += ["--data", *map(str, data), "--out", str(out / run.folder)]
    if run.base is not None:
        command += ["--weights", str(out / Run(run.base, base_seed).folder / WEIGHTS)]
    return [*command, *options]


def carry_out(
    runs: Sequence[Run],
    command_of: Callable[[Run], Sequence[str]],
    out: Path,
    end_s: float = float("inf"),
    jobs: int = 1,
) -> list[State]:
    """Train what is not finished, jobs runs at a time, and write runs.json after every run.

    A run waits for its base; none begins after end_s of ``time.monotonic``.
    """
    states = {run: State(run.preset, run.seed, "finished" if _is_finished(run, out) else "left") for run in runs}
    if (out / "runs.json").exists():
        for entry in json.loads((out / "runs.json").read_text()):
            before = State(**entry)
            known = next((r for r in runs if (r.preset, r.seed) == (before.preset, before.seed)), None)
            if known is not None and before.state == states[known].state == "finished":
                states[known] = before
    waiting = [run for run in runs if states[run].state != "finished"]
    with ThreadPoolExecutor(jobs) as pool:
        running: dict[Future[State], Run] = {}
        while waiting or running:
            bases = [None if run.base is None else Run(run.base, runs[0].seed) for run in waiting]
            ready = [run for run, base in zip(waiting, bases) if base is None or _is_finished(base, out)]
            for run in ready[: jobs - len(running)] if time.monotonic() < end_s else ():
                waiting.remove(run)
                running[pool.submit(_train, run, command_of(run), out)] = run
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                run, state = running.pop(future), future.result()
                states[run] = state
                print(f"{state.state}: {run.preset}, seed {run.seed}, {state.seconds:.0f} s", flush=True)
            _write(list(states.values()), out)
    _write(list(states.values()), out)
    return list(states.values())


def _train(run: Run, command: Sequence[str], out: Path) -> State:
    """Train one run in a process of its own, whose output is appended to output.txt of its folder."""
    folder, begin = out / run.folder, time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "output.txt").open("a") as log:
        failed = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
    finished = not failed and _is_finished(run, out)
    return State(run.preset, run.seed, "finished" if finished else "failed", round(time.monotonic() - begin, 1))


def _is_finished(run: Run, out: Path) -> bool:
    return (out / run.folder / WEIGHTS).exists()


def _write(states: list[State], out: Path) -> None:
    atomic_write(out / "runs.json", (json.dumps([asdict(state) for state in states], indent=1) + "\n").encode())


def main() -> int:
    """Train, or list the runs; the exit code is 1 if any failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, default=Path("runs") / "fusions")
    parser.add_argument("--seeds", type=int, nargs="+", default=[5, 6, 7])
    parser.add_argument("--stage-c", nargs="*", choices=STAGE_C_FUSIONS, default=[], help="fast, and the best baseline")
    parser.add_argument("--hours", type=float, default=float("inf"), help="after this time no run begins")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, each on one thread")
    parser.add_argument("--list", action="store_true", help="print the runs in their order, and train nothing")
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="of manyeyes train, for every run")
    chosen = parser.parse_args()
    if chosen.jobs < 1:
        parser.error("--jobs: at least 1")
    runs = make_runs(chosen.seeds, chosen.stage_c)
    if chosen.list:
        for run in runs:
            print(("finished" if _is_finished(run, chosen.out) else "left").ljust(9), run.preset, run.seed)
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    end_s = time.monotonic() + 3600 * chosen.hours

    def command_of(run: Run) -> list[str]:
        return make_command(run, chosen.seeds[0], chosen.data, chosen.out, chosen.options)

    states = carry_out(runs, command_of, chosen.out, end_s, chosen.jobs)
    left = [state for state in states if state.state != "finished"]
    for state in left:
        print(f"{state.state}: {state.preset}, seed {state.seed}")
    return int(any(state.state == "failed" for state in left))


if __name__ == "__main__":
    sys.exit(main())
