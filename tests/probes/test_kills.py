# SPDX-License-Identifier: Apache-2.0
"""SIGKILL at random times and at random file operations: the folder stays readable, and the run resumes to the same result."""

from __future__ import annotations

import json
import random
import shutil
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.probes.commands import run, start

if TYPE_CHECKING:
    from tests.probes.runs import Run

SEED = 22
NUM_KILLS = {"simulate": 1, "train": 2, "study": 2}
"""In a short run; 40 of each in a long one."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["simulate", "train", "study"])
def test_a_killed_run_is_readable_and_resumes_to_the_same_result(
    name: str, runs: dict[str, Run], tmp_path: Path, is_long: bool
) -> None:
    one, draw = runs[name], random.Random(f"{SEED} {name}")
    expected, folder, log = one.summarize(one.folder), tmp_path / "run", tmp_path / "log"
    num_kills, tries, seconds = 40 if is_long else NUM_KILLS[name], 0, 0.0
    counts = {"operation": 0, "time": 0}
    while sum(counts.values()) < num_kills:
        tries += 1
        kind = "operation" if tries % 2 or not seconds else "time"
        process = start(
            one.command(folder), folder, log, draw.randint(1, one.operations) if kind == "operation" else None
        )
        if kind == "time":
            process.kill_after(draw.uniform(0, seconds))
        outcome = process.wait()
        if outcome.code != 0:  # else it ended before
            assert outcome.code == -signal.SIGKILL, outcome.text
            counts[kind] += 1
            one.check(folder)
            seconds = run(one.command(folder), folder, log).seconds
        assert one.summarize(folder) == expected, (tries, kind)
        shutil.rmtree(folder)
    print(json.dumps({"command": name, "kills": counts, "runs": tries}))
