# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentBody, Boxes, ConfigError, ShapeError
from manyeyes.pose.landmarks import (
    KNOWN_BODY_UNCERTAINTY,
    UNKNOWN_BODY_SIZE_M,
    UNKNOWN_BODY_UNCERTAINTY,
    DetectorUncertainty,
    Landmarks,
)


def marks(n=5, seed=0):
    rng = np.random.default_rng(seed)
    xy, size = rng.uniform(-40, 40, (n, 2)), np.column_stack((rng.normal(4.5, 0.3, n), rng.normal(1.9, 0.1, n)))
    ones = np.ones(n)
    return Landmarks(
        xy, rng.uniform(-3, 3, n), size, rng.random(n), 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(n, np.int64)
    )


def test_no_field_can_carry_an_identity():
    assert not {"id", "track", "truth", "label"} & {f.name for f in fields(Landmarks)}


def test_boxes_keep_their_stated_error_and_get_the_detectors_where_they_state_none():
    boxes = Boxes.of(torch.zeros(2, 3), torch.ones(2, 3), torch.tensor([0.1, 0.2]))
    boxes = replace(
        boxes, sigma_xy=torch.tensor([0.0, 0.5]), sigma_yaw=torch.tensor([0.0, 0.1]), p_flip=torch.tensor([0, 0.2])
    )
    found = Landmarks.of_boxes(boxes, DetectorUncertainty(0.3, 0.05, 0.04))
    np.testing.assert_allclose(found.sigma_xy, [0.3, 0.5])
    np.testing.assert_allclose(found.sigma_yaw, [0.05, 0.1], atol=1e-7)
    np.testing.assert_allclose(found.p_flip, [0.04, 0.2], atol=1e-7)


def test_transform_applies_the_pose():
    moved = marks(1).transform(np.array([1.0, 2.0, np.pi / 2]))
    (x, y), yaw = marks(1).xy[0], marks(1).yaw[0]
    np.testing.assert_allclose(moved.xy[0], [1.0 - y, 2.0 + x])
    assert moved.yaw[0] == pytest.approx(yaw + np.pi / 2)


def test_unusable_landmarks_are_left_out():
    good = marks(8)
    bad = replace(good, xy=good.xy.copy(), size=good.size.copy(), yaw=good.yaw.copy(), sigma_xy=good.sigma_xy.copy())
    bad.xy[0, 0], bad.xy[1, 1], bad.xy[2, 0] = np.nan, 1e9, 900.0
    bad.yaw[3], bad.size[4, 0], bad.sigma_xy[5] = np.inf, -1.0, 0.0
    assert set(bad.select_indices(300.0, 100)) == {6, 7}


def test_the_best_are_kept_whatever_the_order():
    all_ = marks(30)
    order = np.random.default_rng(1).permutation(30)
    kept, other = all_.select_indices(1e3, 10), all_[order].select_indices(1e3, 10)
    assert set(kept) == set(np.argsort(-all_.score)[:10])
    np.testing.assert_array_equal(all_.xy[kept], all_[order].xy[other])


def test_shapes_and_errors_are_checked():
    with pytest.raises(ShapeError, match=r"Landmarks\.yaw"):
        replace(marks(3), yaw=np.zeros(2))
    with pytest.raises(ConfigError, match="sigma_xy_m > 0"):
        DetectorUncertainty(sigma_xy_m=0.0)
    assert len(Landmarks.cat([])) == 0 and len(Landmarks.cat([marks(2), marks(3)])) == 5


def test_descriptors_follow_their_landmarks():
    one, descriptor = marks(3), np.arange(12.0).reshape(3, 4)
    described = replace(one, descriptor=descriptor)
    np.testing.assert_array_equal(described[np.array([2, 0])].descriptor, descriptor[[2, 0]])
    np.testing.assert_array_equal(described.transform(np.ones(3)).descriptor, descriptor)
    np.testing.assert_array_equal(Landmarks.cat([described, described[:1]]).descriptor, descriptor[[0, 1, 2, 0]])
    assert Landmarks.cat([described, one]).descriptor is None and one[:2].descriptor is None
    with pytest.raises(ShapeError, match=r"Landmarks\.descriptor"):
        replace(one, descriptor=descriptor[:2])


BODY = AgentBody.standing(1.4, -0.1, (4.9, 2.1, 1.8), 0.02)


@pytest.mark.parametrize("body", [BODY, None])
def test_the_body_of_the_agent_is_the_last_landmark(body):
    """It has its place, its size and an error of its own; the others stay as they are. Unknown, it is a car near the origin."""
    before = marks(5)
    after = before.with_body(body)
    assert len(after) == 6
    for field in ("xy", "yaw", "size", "score", "sigma_xy", "sigma_yaw", "p_flip", "instant"):
        np.testing.assert_array_equal(getattr(after, field)[:5], getattr(before, field))
    assert after.score[5] == 1.0
    place = (*after.xy[5], after.yaw[5], *after.size[5])
    assert place == ((0.0, 0.0, 0.0, *UNKNOWN_BODY_SIZE_M) if body is None else (1.4, -0.1, 0.02, 4.9, 2.1))
    error = UNKNOWN_BODY_UNCERTAINTY if body is None else KNOWN_BODY_UNCERTAINTY
    assert (after.sigma_xy[5], after.sigma_yaw[5], after.p_flip[5]) == (
        error.sigma_xy_m,
        error.sigma_yaw_rad,
        error.p_flip,
    )
    assert len(Landmarks.empty().with_body(body)) == 1
    assert UNKNOWN_BODY_UNCERTAINTY.sigma_xy_m > 5 * KNOWN_BODY_UNCERTAINTY.sigma_xy_m
