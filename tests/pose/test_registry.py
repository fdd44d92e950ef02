# SPDX-License-Identifier: Apache-2.0
"""Correctors by name, those of other distributions too, and the function that takes numpy arrays."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import manyeyes
from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.models import checkpoint, pretrained
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import (
    POSE_CORRECTORS,
    correct_pose,
    list_correctors,
    load_corrector,
    register_pose_corrector,
)
from manyeyes.pose.types import PosePrior, PoseStatus, no_estimate

THEIRS = """
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import no_estimate

@register_pose_corrector("their-corrector")
def correct(ego, other, prior):
    return no_estimate(prior)
"""
PLACES = np.array([[12.0, 4.0], [-9.0, 15.0], [21.0, -11.0], [-17.0, -6.0], [5.0, 23.0], [30.0, 9.0]])
YAWS = np.array([0.1, 1.2, -0.4, 2.0, 0.7, -1.1])
POSE = np.array([8.0, -3.0, 0.6])


def make_boxes(xy: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    return np.column_stack((xy, np.zeros(6), np.tile([4.5, 1.9, 1.6], (6, 1)), yaw))


def observe_from(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return make_boxes((PLACES - pose[:2]) @ np.array([[c, -s], [s, c]]), YAWS - pose[2])


@pytest.mark.parametrize("prior", [None, PosePrior.of(POSE + [0.4, -0.3, 0.02], 0.5, 0.05)], ids=["no prior", "prior"])
def test_boxes_as_arrays_give_the_pose(prior) -> None:
    estimate = correct_pose(observe_from(np.zeros(3)), observe_from(POSE).tolist(), prior)
    assert estimate.status.has_estimate and estimate.inliers == 6
    np.testing.assert_allclose(estimate.measured, POSE, atol=1e-6)


def test_planar_rows_with_scores_and_a_prior_with_a_covariance_give_the_same_pose() -> None:
    ego, other = (boxes[:, [0, 1, 6, 3, 4, 6]] for boxes in (observe_from(np.zeros(3)), observe_from(POSE)))
    ego[:, 5], other[:, 5] = 0.9, 0.8
    covariance = np.array([[0.25, 0.1, 0.0], [0.1, 0.25, 0.0], [0.0, 0.0, 0.0025]])
    estimate = manyeyes.correct_pose(
        ego, other.tolist(), manyeyes.PosePrior.from_pose(POSE + [0.3, 0.2, 0.01], covariance)
    )
    assert estimate.status is PoseStatus.OK and estimate.inliers == 6 and estimate.covariance.shape == (3, 3)
    np.testing.assert_allclose(estimate.measured, POSE, atol=1e-6)
    assert (Landmarks.of(ego).score == 0.9).all()
    by_volume = correct_pose(observe_from(np.zeros(3)), observe_from(POSE))
    np.testing.assert_allclose(correct_pose(ego, other).pose, by_volume.pose, atol=1e-9)
    with pytest.raises(ShapeError, match=r"covariance \(3, 3\)"):
        PosePrior.from_pose(POSE, np.zeros(3))


def test_states_without_a_measured_pose_keep_the_prior_or_give_none() -> None:
    ego, strangers = observe_from(np.zeros(3)), observe_from(POSE)[:1]
    assert correct_pose(ego, strangers).status is PoseStatus.NO_MATCH and correct_pose(ego, strangers).pose is None
    prior = PosePrior.of([1.0, 2.0, 0.5], 1.0, 0.1)
    kept = correct_pose(ego, np.zeros((0, 6)), prior)
    assert kept.status is PoseStatus.NO_MATCH and kept.inliers == 0 and kept.measured is None
    np.testing.assert_allclose(kept.pose, prior.pose)
    np.testing.assert_allclose(kept.covariance, prior.covariance)


def test_another_corrector_takes_the_same_arrays() -> None:
    ego, other = observe_from(np.zeros(3)), observe_from(POSE)
    kept = correct_pose(ego, other, PosePrior.of([1.0, 2.0, 0.5], 1.0, 0.1), "identity")
    assert kept.status is PoseStatus.OK
    np.testing.assert_allclose(kept.pose, [1.0, 2.0, 0.5])


def test_clouds_as_arrays_reach_a_corrector_of_clouds() -> None:
    assert list_correctors("clouds") == ("gicp", "scan-registration")
    assert correct_pose(np.zeros((2, 3)), np.zeros((5, 3)), None, "scan-registration").status is PoseStatus.NO_MATCH


def test_wrong_shapes_name_the_columns() -> None:
    with pytest.raises(ShapeError, match=r"boxes \(N, 7\).*got \(6, 5\)"):
        correct_pose(np.zeros((6, 5)), np.zeros((6, 7)))
    with pytest.raises(ShapeError, match=r"x, y and yaw \(3,\); got \(2,\)"):
        PosePrior.of([1.0, 2.0], 1.0, 0.1)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("magic", "known: clipper, coalign, feaco, feakm, fpv-rcnn"),
        ("voting@8", "corrector with weights"),
        ("feakm@x", "4 or 8"),
        ("gicp", "compares whole clouds.*vips, voting"),
    ],
)
def test_a_name_that_cannot_be_used_is_one_error(name: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        load_corrector(name)


def test_feakm_has_the_shipped_weights() -> None:
    four, eight = load_corrector("feakm"), load_corrector("feakm@8")
    shipped = checkpoint.fingerprint(pretrained.load_feakm())
    for corrector in (four, eight):
        assert isinstance(corrector, FeakmCorrector) and checkpoint.fingerprint(corrector.net) == shipped
    assert four != eight


def test_a_distribution_that_is_installed_adds_a_corrector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "their_module.py").write_text(THEIRS)
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[manyeyes.pose_corrector]\ntheir-corrector = their_module\n")
    assert "their-corrector" not in list_correctors("landmarks")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(POSE_CORRECTORS, "_entry_points", None)
    monkeypatch.setattr(POSE_CORRECTORS, "_items", dict(POSE_CORRECTORS._items))
    try:
        assert "their-corrector" in list_correctors("landmarks")
        estimate = correct_pose(np.zeros((0, 7)), np.zeros((0, 7)), None, "their-corrector")
        assert estimate.status is PoseStatus.NO_MATCH
        with pytest.raises(ConfigError, match="registered already"):
            register_pose_corrector("their-corrector")(no_estimate)
    finally:
        POSE_CORRECTORS._entry_points = None
        sys.modules.pop("their_module", None)
