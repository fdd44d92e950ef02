# SPDX-License-Identifier: Apache-2.0
"""The picture of a relative pose shows both agents' boxes, the pairs and the prior."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import correct_pose
from manyeyes.pose.types import PosePrior
from manyeyes.viz.birds_eye import AGENT_COLOURS, FAINT, FOUND
from manyeyes.viz.pose_pair import draw_pose_pair


def count_pixels(image, colour) -> int:
    return int((np.abs(np.asarray(image).astype(int) - colour).max(-1) < 40).sum())


def test_pairs_and_prior_are_drawn() -> None:
    pytest.importorskip("PIL", reason="the 'view' extra is not installed")
    rng = np.random.default_rng(0)
    boxes = np.column_stack(
        (rng.uniform(-30, 30, (8, 2)), rng.uniform(-3, 3, 8), np.full(8, 4.5), np.full(8, 1.9), np.ones(8))
    )
    ego, pose = Landmarks.of(boxes), np.array([5.0, 9.0, 0.4])
    other = ego.transform(np.array([-8.11, -6.34, -0.4]))
    prior = PosePrior.of(pose + [3.0, 0.0, 0.0], 3.0, 0.1)
    found = draw_pose_pair(ego, other, prior, correct_pose(ego, other, prior))
    assert min(count_pixels(found, colour) for colour in (*AGENT_COLOURS[:2], FAINT)) > 50
    # Pairs of exact boxes coincide; without an estimate there is no second agent.
    nothing = draw_pose_pair(ego, other[np.array([0])], None, correct_pose(ego, other[np.array([0])]))
    assert count_pixels(nothing, AGENT_COLOURS[1]) == count_pixels(nothing, FOUND) == 0
