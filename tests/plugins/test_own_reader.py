# SPDX-License-Identifier: Apache-2.0
"""A reader of a user's own: one installed module, and commands open its recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

PACKAGE = Path(__file__).parent / "own_reader"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SIZE = np.array([[4.6, 1.9, 1.6]])


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two agents and a parked car, at three instants; the data set has one split."""
    root = tmp_path_factory.mktemp("clouds")
    folder, rng = root / "test" / "crossing", np.random.default_rng(0)
    folder.mkdir(parents=True)
    rows = ["index,agent,time_s,x,y,z,yaw"]
    for index in range(3):
        np.savez(folder / f"{index}.npz", center=[[8.0, 5.0, 0.8]], size=SIZE, yaw=[0.0], id=[9])
        for agent, x in ((4, index * 1.0), (7, 16.0)):
            rows.append(f"{index},{agent},{index * 0.1},{x},0,0,0")
            ground = rng.uniform(-25, 25, (1500, 3)) * (1, 1, 0)
            body = (rng.random((200, 3)) - 0.5) * SIZE + (8 - x, 5, 0.8)
            points = np.concatenate((ground, body)).astype(np.float32)
            np.savez(folder / f"{index}-{agent}.npz", points=points, intensity=np.full(len(points), 0.2))
    (folder / "poses.csv").write_text("\n".join(rows))
    return root


@pytest.mark.slow
def test_view_replay_and_evaluate_open_its_recordings(clouds: Path, install, manyeyes, tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), tmp_path / "tiny.safetensors", {})
    site, out = install("own_reader"), str(tmp_path)
    played = ("--split", "test", "--weights", f"{out}/tiny.safetensors", "--methods", "no-fusion", "early")
    viewed = manyeyes(site, "view", str(clouds), "--split", "test", "--out", f"{out}/frame.png")
    assert viewed.returncode == 0 and "crossing, frames 0 to 0" in viewed.stdout, viewed.stderr
    replayed = manyeyes(site, "replay", str(clouds), "--no-animate", "--out", f"{out}/replay", *played)
    assert replayed.returncode == 0 and (tmp_path / "replay" / "report.html").is_file(), replayed.stderr
    evaluated = manyeyes(
        site, "evaluate", "--data", str(clouds), "--timing-frames", "0", "--workers", "2", "--out", out, *played
    )
    assert evaluated.returncode == 0, evaluated.stderr
    none, early = json.loads((tmp_path / "results.json").read_text())["result"]["stats"]
    assert [method["ap_summaries"][0]["n_gt"] for method in (none, early)] == [3, 3]
    assert early["communication"]["bytes_per_message"] > 1000


@pytest.mark.slow
def test_without_its_entry_point_it_is_not_found(clouds: Path, manyeyes, tmp_path: Path) -> None:
    viewed = manyeyes(PACKAGE, "view", str(clouds), "--split", "test", "--out", str(tmp_path / "frame.png"))
    assert viewed.returncode == 1
    assert "no recording in a known layout (argoverse2: logs" in viewed.stderr and "Traceback" not in viewed.stderr


def test_it_is_one_short_module_with_the_reader_of_the_example() -> None:
    (module,) = PACKAGE.glob("*.py")
    text = module.read_text()
    assert len(text.splitlines()) <= 40
    reader = text[text.index("def has_poses") :]
    assert "def snapshot" in reader and reader in (EXAMPLES / "10_own_data.py").read_text()
