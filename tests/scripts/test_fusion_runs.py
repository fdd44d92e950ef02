# SPDX-License-Identifier: Apache-2.0
"""The runs of compared fusions: order, resumption, failures, and time."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from manyeyes.training.presets import TRAINING_PLANS, TRAINING_PRESETS

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "fusion_runs.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fusion_runs", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fusion_runs"] = module
    spec.loader.exec_module(module)
    return module


def test_every_run_has_a_preset_and_comes_after_its_base(script) -> None:
    runs = script.make_runs([5, 6, 7], ["fast"])
    assert len(set(runs)) == len(runs) and runs[0].preset == "stage-a"
    for number, run in enumerate(runs):
        assert run.preset in TRAINING_PRESETS or run.preset in TRAINING_PLANS
        assert run.base is None or script.Run(run.base, 5, None) in runs[:number]


def test_a_beginning_of_the_order_is_whole_rows(script) -> None:
    """First every fusion has one seed; then a fusion has all seeds before the next one has more than one."""
    runs = [run for run in script.make_runs([5, 6, 7]) if run.preset in {f"fusion/{n}" for n in script.INSIDE_FUSIONS}]
    count = len(script.INSIDE_FUSIONS)
    assert {run.seed for run in runs[:count]} == {5} and len({run.preset for run in runs[:count]}) == count
    assert [run.preset for run in runs[count::2]] == [run.preset for run in runs[count + 1 :: 2]]
    assert runs[0].preset == "fusion/fast"


def fake(out: Path, fails: str = "") -> object:
    """A command that writes the weights of a run, or fails; it notes the run."""

    def command(run) -> list[str]:
        path, note = out / run.folder / "weights.safetensors", out / "notes.txt"
        code = f"open({str(note)!r}, 'a').write({run.preset + chr(10)!r}); "
        code += "raise SystemExit(2)" if run.preset == fails else f"open({str(path)!r}, 'w')"
        return [sys.executable, "-S", "-c", code]

    return command


def test_finished_runs_are_not_repeated_and_a_failed_one_stops_no_other(script, tmp_path: Path) -> None:
    runs = [script.Run("stage-a", 5, None), script.Run("fusion/max", 5), script.Run("fusion/fast", 5)]
    states = script.carry_out(runs, fake(tmp_path, "fusion/max"), tmp_path)
    assert [state.state for state in states] == ["finished", "failed", "finished"]
    again = script.carry_out(runs, fake(tmp_path), tmp_path)
    assert [state.state for state in again] == ["finished"] * 3 and again[0] == states[0]
    assert (tmp_path / "notes.txt").read_text().split() == ["stage-a", "fusion/max", "fusion/fast", "fusion/max"]
    stored = json.loads((tmp_path / "runs.json").read_text())
    assert [entry["preset"] for entry in stored] == [run.preset for run in runs]


def test_runs_without_their_base_and_after_the_time_are_left(script, tmp_path: Path) -> None:
    runs = [script.Run("stage-a", 5, None), script.Run("fusion/max", 5)]
    states = script.carry_out(runs, fake(tmp_path, "stage-a"), tmp_path)
    assert [state.state for state in states] == ["failed", "left"]
    assert [state.state for state in script.carry_out(runs, fake(tmp_path), tmp_path, end_s=0.0)] == ["left", "left"]


def test_several_runs_at_a_time_wait_for_their_base(script, tmp_path: Path) -> None:
    """Two runs wait for each other, which only ends where both run at the same time; neither begins before the base is finished."""
    runs = [script.Run("fusion/max", 5), script.Run("fusion/fast", 5), script.Run("stage-a", 5, None)]

    def command(run) -> list[str]:
        own, base = tmp_path / run.folder, tmp_path / "stage-a/seed-5"
        others = [tmp_path / r.folder for r in runs[:2]] if run.base else []
        code = f"import pathlib, time; P = pathlib.Path; P({str(own)!r}, 'begun').touch(); "
        code += f"assert {run.base is None} or P({str(base)!r}, 'weights.safetensors').exists(); "
        code += f"t = time.time()\nwhile not all(P(o, 'begun').exists() for o in {list(map(str, others))}):\n"
        code += " time.sleep(.01)\n assert time.time() < t + 30\n"
        return [sys.executable, "-S", "-c", code + f"P({str(own)!r}, 'weights.safetensors').touch()"]

    states = script.carry_out(runs, command, tmp_path, jobs=2)
    assert [state.state for state in states] == ["finished"] * 3


def test_the_command_starts_from_the_base_of_the_first_seed(script, tmp_path: Path) -> None:
    command = script.make_command(script.Run("fusion/max", 6), 5, [Path("a"), Path("b")], tmp_path, ["--batch", "2"])
    text = " ".join(command[3:])
    assert text.startswith("train --preset fusion/max --seed 6 --data a b --out") and text.endswith("--batch 2")
    assert f"--weights {tmp_path / 'stage-a/seed-5/weights.safetensors'}" in text
