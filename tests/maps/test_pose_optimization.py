# SPDX-License-Identifier: Apache-2.0
"""After a sweep the displacement that all corrections share is removed, and what is left is each observation's own offset."""

import numpy as np
import pytest

from manyeyes.maps.fusion.pose_config import PoseSolverConfig
from manyeyes.maps.fusion.pose_optimization import PoseSolution, merge_solutions

CONFIG = PoseSolverConfig()
NUMBER = len(CONFIG.schedule) - 1


def make_solution(correction: np.ndarray, surveyed: tuple[int, ...] = ()) -> PoseSolution:
    """Observations of as many agents, 10 m apart, well observed by their lines; correction: (O, 2) metres."""
    count = len(correction)
    names = tuple(f"{k:02}" for k in range(count))
    start, prior = np.zeros((count, 3)), np.tile(np.diag([0.5, 0.5, 0.01]), (count, 1, 1))
    start[:, 0] = 10.0 * np.arange(count)
    pose = start.copy()
    pose[:, :2] += correction
    one, zero = np.ones(count), np.zeros(count)
    is_surveyed = np.isin(np.arange(count), surveyed).astype(float)
    return PoseSolution(
        names, names, names, prior, start, pose, 1e-3 * prior, 0.2 * one, np.ones((count, 3)), zero, zero, np.zeros((count, 2)),
        one, one, is_surveyed, np.zeros((count, 2)), 1e3 * np.linalg.inv(prior), np.zeros((count, 3)), np.zeros((count, 3)),
    )  # fmt: skip


def test_a_displacement_that_all_share_is_removed() -> None:
    found = merge_solutions([make_solution(np.tile([0.3, -0.2], (6, 1)))], CONFIG, NUMBER)
    # The prior poses of six agents keep a seventh of it.
    np.testing.assert_allclose(found.pose, found.initial_pose, atol=0.05)
    np.testing.assert_allclose(found.relative_offset, 0.0, atol=0.05)


def test_relative_offsets_are_corrections_less_what_all_share() -> None:
    before = make_solution(np.random.default_rng(3).normal([0.4, -0.3], 0.2, (12, 2)), surveyed=(4,))
    found = merge_solutions([before], CONFIG, NUMBER)
    moved = (found.pose - found.initial_pose)[:, :2]
    common = (before.pose - found.pose)[:, :2]
    others = np.arange(12) != 4
    assert (np.abs(common[others]) > 0.05).all()
    np.testing.assert_allclose(found.relative_offset[others], moved[others], atol=1e-12)
    # A surveyed pole keeps its pose, and its offset is relative to the others all the same.
    assert common[4].tolist() == [0.0, 0.0]
    assert found.relative_offset[4] == pytest.approx(moved[4] - common[others].mean(0), abs=0.05)
