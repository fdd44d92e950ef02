# SPDX-License-Identifier: Apache-2.0
"""Several processes start at once with one folder: one of them writes to it, or they share it where that is meant."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.probes.commands import Outcome, start

if TYPE_CHECKING:
    from tests.probes.runs import Run

pytestmark = pytest.mark.slow


def race(one: Run, folder: Path, count: int) -> list[Outcome]:
    """Start a command several times at once, and wait for all."""
    processes = [start(one.command(folder), folder, folder.with_name(f"log-{i}")) for i in range(count)]
    return [process.wait() for process in processes]


@pytest.mark.parametrize(("name", "count"), [("train", 4), ("simulate", 2)])
def test_one_of_several_processes_runs_and_the_others_are_refused_by_its_name(
    name: str, count: int, runs: dict[str, Run], tmp_path: Path, is_long: bool
) -> None:
    one, folder = runs[name], tmp_path / "run"
    for _ in range(10 if is_long else 1):
        outcomes = race(one, folder, count)
        (winner,) = (outcome for outcome in outcomes if outcome.code == 0)
        for loser in outcomes:
            if loser is not winner:
                (line,) = (text for text in loser.text.splitlines() if text.startswith("manyeyes: "))
                assert loser.code == 1 and f"{folder}: process {winner.pid} on " in line and f"manyeyes {name} " in line
        assert one.summarize(folder) == one.summarize(one.folder)
        folder.rename(tmp_path / f"done-{len(list(tmp_path.iterdir()))}")


def test_processes_share_the_folder_of_a_study(runs: dict[str, Run], tmp_path: Path, is_long: bool) -> None:
    one, folder = runs["study"], tmp_path / "run"
    outcomes = race(one, folder, 4 if is_long else 2)
    assert [outcome.code for outcome in outcomes] == [0] * len(outcomes), outcomes
    assert one.summarize(folder) == one.summarize(one.folder)
