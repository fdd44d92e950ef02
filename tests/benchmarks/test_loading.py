# SPDX-License-Identifier: Apache-2.0
"""Frames of a recording linked many times: as many as asked for, in scenarios of bounded length, to and fro in time."""

import importlib.util
import sys
from pathlib import Path

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "loading.py"


def test_frames_are_linked_to_and_fro(tmp_path):
    spec = importlib.util.spec_from_file_location("loading", PATH)
    assert spec is not None and spec.loader is not None
    loading = importlib.util.module_from_spec(spec)
    sys.modules["loading"] = loading
    spec.loader.exec_module(loading)
    agent = tmp_path / "source" / "drive" / "7"
    agent.mkdir(parents=True)
    (agent.parent / "data_protocol.yaml").write_text("")
    for name in ("000000", "000002", "000004"):
        (agent / f"{name}.pcd").write_text(name)
        (agent / f"{name}.yaml").write_text(name)
    loading.link_frames(tmp_path / "source", tmp_path / "linked", loading.SCENARIO_FRAMES + 2)
    scenarios = sorted((tmp_path / "linked").iterdir())
    clouds = [sorted((scenario / "7").glob("*.pcd")) for scenario in scenarios]
    assert [len(found) for found in clouds] == [loading.SCENARIO_FRAMES, 2]
    assert [path.read_text() for path in clouds[0][:6]] == ["000000", "000002", "000004", "000002", "000000", "000002"]
    assert clouds[0][0].stat().st_ino == (agent / "000000.pcd").stat().st_ino
