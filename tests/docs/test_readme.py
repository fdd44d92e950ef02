# SPDX-License-Identifier: Apache-2.0
"""The Python of the README runs as it stands, in a folder outside the checkout, with what a reader fills in."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
MAX_LINES = 150
BEFORE = """
import numpy as np
import torch
from torch import nn
from manyeyes import Agent, AgentFrame, BevGrid, BoxDetector, Boxes, PointCloud, Transform, get_strategy, register_fusion

def my_network(xyz):
    return [[10.0, 0.0, 0.8]], [[4.5, 1.9, 1.6]], [0.0]

points = np.random.default_rng(0).uniform((-40, -20, 0), (40, 20, 2), (5000, 3))
sensors = {agent: (points, np.full(5000, 0.3), np.eye(4)) for agent in (1, -1)}
"""
AFTER = """
frame = AgentFrame.of(PointCloud.of(points, np.full(5000, 0.3)), Transform.from_matrix(np.eye(4)), 1)
late = get_strategy("late")
packets = Agent(MyDetector(), late).share(frame)
assert packets and len(Agent(MyDetector(), late).perceive(frame).boxes) == 1

from dataclasses import replace
from manyeyes.models.detector.detector import Detector
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
config = replace(DETECTOR_TRAINING_PRESETS["costr-tiny"].detector, fusion="mine")
assert isinstance(Detector(config).fusion, MyFusion)
"""


def test_the_readme_is_short_and_shows_use_detector_and_fusion() -> None:
    assert len(README.splitlines()) <= MAX_LINES
    assert [name in block for name, block in zip(("load_detector()", "BoxDetector", "register_fusion"), BLOCKS)] == [
        True, True, True,
    ]  # fmt: skip
    assert len(BLOCKS) == 3


@pytest.mark.slow
def test_the_python_of_the_readme_runs_outside_the_checkout(tmp_path: Path) -> None:
    script = tmp_path / "readme.py"
    script.write_text("\n".join((BEFORE, *BLOCKS, AFTER)), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    run = subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert re.fullmatch(
        r"(\d+ boxes of score above 0\.5 with 0 bytes)\n(\d+ boxes of score above 0\.5 with [1-9]\d* bytes)\n",
        run.stdout,
    )
