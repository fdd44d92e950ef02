# SPDX-License-Identifier: Apache-2.0
"""The smallest commands that simulate, train and run a study, and what a reader requires of their folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from tests.probes.commands import run_here

from manyeyes._lock import LOCK
from manyeyes._records import load_record
from manyeyes.datasets.manifest import MANIFEST
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.simulator.presets import SimulationPreset, SplitPreset
from manyeyes.studies.engine.conditions import MethodMatches
from manyeyes.training.presets import TRAINING_PRESETS

PRESET = "probe"
"""Name of the simulation and of the training for the command line."""
TRAINING = replace(TRAINING_PRESETS["costr-tiny"], steps=4, save_every=1)


@dataclass(frozen=True)
class Run:
    """A command that was run once. words: without ``--out``. folder: of that run. operations: number of its file operations.

    check: asserts that a folder is readable. summarize: what equal runs have in common.
    """

    words: tuple[object, ...]
    folder: Path
    check: Callable[[Path], None]
    summarize: Callable[[Path], dict[str, Any]]
    operations: int = 0

    def command(self, out: Path) -> tuple[object, ...]:
        """Return the words of the command that writes to a folder."""
        return (*self.words, "--out", out)


def make_simulation(num_scenarios: int) -> SimulationPreset:
    """Return a preset of two frames a scenario."""
    split = SplitPreset("test", ("generated-3",), num_scenarios, (16,))
    return SimulationPreset((split,), frames=2, history_frames=0, vehicles=(2, 2), roadside_chance=0.0, min_vehicles=4)


def prepare_runs(folder: Path) -> dict[str, Run]:
    """Run every command once in a folder: simulate a recording, train on it, and evaluate untrained weights on it."""
    torch.manual_seed(0)
    weights, data = folder / "untrained.safetensors", folder / "simulate-0"
    checkpoint.save(Detector(COSTR_TINY), weights, {})
    simulate = ("simulate", "--preset", PRESET, "--workers", 1)
    train = ("train", "--data", data, "--split", "test", "--preset", PRESET)
    study = ("study", "num-agents", "--data", data, "--split", "test", "--workers", 1, "--weights", weights)
    study = (*study, "--methods", "no-fusion", "late")
    runs = {
        "simulate": Run(simulate, data, check_recording, summarize_recording),
        "train": Run(train, folder / "train-0", check_training, summarize_training),
        "study": Run(study, folder / "study-0", check_study, summarize_study),
    }
    return {name: replace(r, operations=run_here(r.command(r.folder), r.folder)) for name, r in runs.items()}


def check_recording(folder: Path) -> None:
    """Finished scenarios are whole; a recording with a manifest is complete."""
    finished = [path.parent.name for path in folder.glob("test/*/scenario.json") if path.parent.suffix == ""]
    if finished:
        assert Opv2vRecording(folder, "test", use_cache=False).verify(finished).count == 0
    if (folder / MANIFEST).exists():
        assert len(list(folder.glob("*/*/scenario.json"))) == len(
            json.loads((folder / MANIFEST).read_text())["scenarios"]
        )


def check_training(folder: Path) -> None:
    """The saved state is whole, and the log has every step up to it."""
    if (folder / "last.pt").exists():
        state = torch.load(folder / "last.pt", weights_only=True)
        lines = (folder / "log.jsonl").read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines[: state["step"]]] == list(range(1, state["step"] + 1))
    if (folder / "weights.safetensors").exists():
        load_file(folder / "weights.safetensors")


def check_study(folder: Path) -> None:
    """Every cell is whole."""
    for path in folder.rglob("*.cell"):
        assert load_record(path, MethodMatches) is not None
    for path in folder.glob("*.json"):
        json.loads(path.read_text())


def summarize_recording(folder: Path) -> dict[str, Any]:
    """Return all files, but the provenance of the last command."""
    return _digests(folder, "simulate.json")


def summarize_training(folder: Path) -> dict[str, Any]:
    """Return tensors, log, picture and result; states and cards hold times too."""
    state = torch.load(folder / "last.pt", weights_only=True)
    tensors = {
        "state": _flatten({**state, "seconds": 0.0}),
        "weights": _flatten(load_file(folder / "weights.safetensors")),
    }
    result = json.loads((folder / "train.json").read_text())["result"]
    files = _digests(folder, "last.pt", "weights.safetensors", "train.json")
    return {**tensors, "result": {**result, "seconds": None}, **files, "names": _names(folder)}


def summarize_study(folder: Path) -> dict[str, Any]:
    """Return cells, tables and pictures, and the result without its provenance."""
    result = json.loads((folder / "num-agents.json").read_text())["result"]
    return {"result": result, "names": _names(folder), **_digests(folder, "num-agents.json")}


def _digests(folder: Path, *excluded: str) -> dict[str, str]:
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in excluded)
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def _names(folder: Path) -> list[str]:
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    assert LOCK not in names
    return names


def _flatten(value: Any) -> Any:
    """Return tensors as bytes, so that equal values are equal."""
    if isinstance(value, torch.Tensor):
        return str(value.dtype), tuple(value.shape), value.numpy().tobytes()
    if isinstance(value, dict):
        return {key: _flatten(item) for key, item in value.items()}
    return [_flatten(item) for item in value] if isinstance(value, (list, tuple)) else value
