# SPDX-License-Identifier: Apache-2.0
"""A training state in a small file: the model returns bit by bit, the rest within the rounding, and the run goes on."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manyeyes.datatypes import CheckpointError
from manyeyes.models.detector.presets import COSTR_BASE, COSTR_TINY
from manyeyes.training import packed_state
from manyeyes.training.detector.samples import AugmentConfig
from manyeyes.training.detector.task import DetectorTask, DetectorTrainConfig
from manyeyes.training.packed_state import MAX_BYTES, pack_state, unpack_state
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training

REPOSITORY = Path(__file__).resolve().parents[2]
CONFIG = DetectorTrainConfig(
    COSTR_TINY, steps=6, batch=1, warmup_steps=1, save_every=2, augment=AugmentConfig(max_agents=2)
)


def task(toy) -> DetectorTask:
    return DetectorTask(CONFIG, toy(agents_n=2, points_per_car=20, ground_points=60, frames=3), 1)


@pytest.fixture
def trained(toy, tmp_path) -> Path:
    trainer = Trainer(task(toy), tmp_path / "run")
    for _ in range(3):
        trainer.advance()
    trainer.save()
    return trainer.path


@pytest.mark.slow
def test_the_model_returns_bit_by_bit_and_the_rest_within_the_rounding(trained, toy, tmp_path):
    num_bytes = pack_state(trained, tmp_path / "packed")
    assert num_bytes == (tmp_path / "packed").stat().st_size < trained.stat().st_size * 0.75
    (tmp_path / "again").mkdir()
    unpack_state(tmp_path / "packed", tmp_path / "again" / "last.pt")
    before, after = (torch.load(path, weights_only=True) for path in (trained, tmp_path / "again" / "last.pt"))
    assert {k: before[k] for k in ("config", "seed", "step", "seconds", "loss", "begun")} == {
        k: after[k] for k in ("config", "seed", "step", "seconds", "loss", "begun")
    }
    model = before["model"]
    for name, value in model.items():
        assert torch.equal(after["model"][name], value), name
        mean, returned = before["average"][name], after["average"][name]
        assert returned.dtype == mean.dtype
        assert ((returned - mean).abs() <= 2**-8 * (mean - value).abs() + 2**-22 * value.abs()).all(), name
    for key, moments in before["optimiser"]["state"].items():
        for name, value in moments.items():
            returned = after["optimiser"]["state"][key][name]
            assert returned.dtype == value.dtype and ((returned - value).abs() <= 2**-8 * value.abs()).all(), name
    assert before["optimiser"]["param_groups"] == after["optimiser"]["param_groups"]


@pytest.mark.slow
def test_an_unpacked_run_goes_on_near_the_packed_one(trained, toy, tmp_path):
    pack_state(trained, tmp_path / "packed")
    (tmp_path / "again").mkdir()
    unpack_state(tmp_path / "packed", tmp_path / "again" / "last.pt")
    one, other = Trainer(task(toy), trained.parent), Trainer(task(toy), tmp_path / "again")
    assert one.step == other.step == 3
    losses = [(one.advance().loss, other.advance().loss) for _ in range(2)]
    assert losses[0][0] == losses[0][1] and losses[1][0] == pytest.approx(losses[1][1], rel=1e-2)


@pytest.mark.slow
def test_the_state_of_costr_base_fits_into_the_maximum(toy, tmp_path):
    recording = toy(agents_n=1, points_per_car=5, ground_points=20)
    trainer = Trainer(DetectorTask(replace(CONFIG, detector=COSTR_BASE), recording), tmp_path / "run")
    trainer.advance()
    trainer.save()
    assert 5_000_000 < pack_state(trainer.path, tmp_path / "packed") <= MAX_BYTES


@pytest.mark.slow
def test_damaged_and_foreign_files_are_refused(trained, tmp_path, monkeypatch):
    pack_state(trained, tmp_path / "packed")
    (tmp_path / "half").write_bytes((tmp_path / "packed").read_bytes()[:-100])
    for name in ("half", "run/last.pt"):
        with pytest.raises(CheckpointError, match="not a whole packed state"):
            unpack_state(tmp_path / name, tmp_path / "out")
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="no training state"):
        pack_state(tmp_path / "other.pt", tmp_path / "out")
    monkeypatch.setattr(packed_state, "MAX_BYTES", 1000)
    with pytest.raises(CheckpointError, match=r"bytes packed, more than 1,000"):
        pack_state(trained, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_script_packs_a_plan_and_keeps_newer_states(trained, tmp_path):
    spec = importlib.util.spec_from_file_location("pack_run", REPOSITORY / "scripts" / "pack_run.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    plan, kept, again = tmp_path / "plan", tmp_path / "kept", tmp_path / "again"
    (plan / "one").mkdir(parents=True)
    (plan / "one" / "weights.safetensors").write_bytes(b"weights")
    trained.parent.rename(plan / "two")
    assert script.pack_run(plan, kept) == [kept / "one" / "weights.safetensors", kept / "two" / "last.packed"]
    assert script.unpack_run(kept, again) == [again / "one" / "weights.safetensors", again / "two" / "last.pt"]
    assert script.unpack_run(kept, again) == []
    (plan / "two" / "weights.safetensors").write_bytes(b"more")
    script.pack_run(plan, kept)
    assert sorted(p.name for p in kept.rglob("*") if p.is_file()) == ["weights.safetensors", "weights.safetensors"]
