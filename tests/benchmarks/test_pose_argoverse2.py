# SPDX-License-Identifier: Apache-2.0
"""Pairs of boxes of a real log: pairs, frames, and correction in real traffic."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from benchmarks.pose_argoverse2 import Log, detections, invert, layouts, nulls, pair_up

from manyeyes.pose.landmarks import Landmarks

LOG = Path(__file__).resolve().parents[3] / "shared" / "data" / "av2" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
needs_log = pytest.mark.skipif(not LOG.is_dir(), reason=f"{LOG} is absent: the real sweeps are not in this project")


def make_landmarks(xy: list[tuple[float, float]]) -> Landmarks:
    return Landmarks.of(np.array([(x, y, 0.0, 4.5, 1.9, 0.9) for x, y in xy]))


def test_boxes_are_paired_with_each_others_nearest_under_the_true_pose() -> None:
    pose = np.array([10.0, -4.0, np.pi / 2])
    there = make_landmarks([(0.0, 0.0), (9.0, 0.0), (30.0, 5.0), (0.5, 0.0)])
    here = there.transform(pose)[np.array([2, 1, 0])]
    # The fourth is near the first, whose own partner is nearer.
    assert pair_up(here, there, pose).tolist() == [[0, 2], [1, 1], [2, 0]]
    assert pair_up(here, there, np.zeros(3)).tolist() == []
    assert len(pair_up(here, Landmarks.empty(), pose)) == 0
    np.testing.assert_allclose(there.transform(pose).transform(invert(pose)).xy, there.xy, atol=1e-12)


@needs_log
def test_real_traffic_is_matched_and_another_time_is_not() -> None:
    log = Log.open(LOG)
    assert len(log.times) == 156 and log.poses.shape == (156, 3)
    lines = {line.what: line for line in chain(layouts(log, 30), nulls(log, 30))}
    many = "layouts of real traffic, 8 and more common, no prior: "
    assert lines[many + "answered"].value >= 0.9 and lines[many + "within 1 m, 1 deg"].value >= 0.9
    assert lines[many + "wrong by more than 3 m"].value == 0.0
    assert lines["nulls of one real place, 10 s apart: answered"].value == 0.0


@needs_log
@pytest.mark.slow
def test_real_detections_of_two_real_lidars_give_no_wrong_pose() -> None:
    lines = {line.what: line for line in detections(Log.open(LOG), 4)}
    errors = [
        lines[f"errors of pairs of real boxes: {name}"] for name in ("longitudinal m", "lateral m", "heading deg")
    ]
    assert all(line.count > 40 for line in errors)
    assert errors[0].value < 0.8 and errors[1].value < 0.8 and errors[2].value < 12.0
    eight = "detections of two real LiDARs, 8 common, no prior: "
    assert lines[eight + "within 1 m, 1 deg"].value > 0.5 and lines[eight + "wrong by more than 3 m"].value == 0.0
