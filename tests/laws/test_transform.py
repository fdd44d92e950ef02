# SPDX-License-Identifier: Apache-2.0
"""Rigid motions are a group that acts on points, clouds and boxes alike."""

from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import given

from manyeyes.datatypes import Boxes, PointCloud, Transform
from manyeyes.datatypes.keypoints import Keypoints

TOLERANCE = 1e-9


@given(a=..., b=..., c=...)
def test_composition_is_associative(assert_same, a: Transform, b: Transform, c: Transform) -> None:
    assert_same((a @ b) @ c, a @ (b @ c), TOLERANCE)


@given(a=...)
def test_the_identity_is_neutral(assert_same, a: Transform) -> None:
    assert_same(a @ Transform.identity(), a, TOLERANCE)
    assert_same(Transform.identity() @ a, a, TOLERANCE)


@given(a=..., b=...)
def test_a_motion_and_its_inverse_cancel(assert_same, a: Transform, b: Transform) -> None:
    assert_same(a @ a.inverse(), Transform.identity(), TOLERANCE)
    assert_same(a.inverse().inverse(), a, TOLERANCE)
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse(), TOLERANCE)


@given(a=..., b=...)
def test_the_matrix_is_a_homomorphism(assert_same, a: Transform, b: Transform) -> None:
    assert_same((a @ b).matrix(), a.matrix() @ b.matrix(), TOLERANCE)
    assert_same(Transform.from_matrix(a.matrix()), a)


@given(a=..., b=..., c=...)
def test_stacked_motions_act_one_by_one(assert_same, a: Transform, b: Transform, c: Transform) -> None:
    stacked = Transform.stack([a, b]) @ c
    assert_same(stacked[0], a @ c, TOLERANCE)
    assert_same(stacked[1], b @ c, TOLERANCE)


@given(boxes=..., a=...)
def test_points_clouds_and_boxes_move_alike(assert_same, boxes: Boxes, a: Transform) -> None:
    points = boxes.center.float()
    moved = a.apply(points)
    assert_same(PointCloud.of(points).transform(a).xyz, moved)
    assert_same(boxes.to(torch.float32).transform(a).center, moved)
    descriptors = torch.zeros(len(boxes), 2)
    assert_same(Keypoints(boxes.to(torch.float32), descriptors).transform(a).boxes.center, moved)


def make_upright(motion: Transform) -> Transform:
    return Transform.from_xyz_yaw(*motion.translation.tolist(), float(motion.yaw))


@given(cloud=..., a=..., b=...)
def test_clouds_move_by_one_motion_after_the_other(assert_same, cloud: PointCloud, a: Transform, b: Transform) -> None:
    assert_same(cloud.transform(b).transform(a), cloud.transform(a @ b), 1e-3)
    assert_same(cloud.transform(a).transform(a.inverse()), cloud, 1e-3)


@given(boxes=..., a=..., b=...)
def test_boxes_move_by_one_upright_motion_after_the_other(
    assert_same, boxes: Boxes, a: Transform, b: Transform
) -> None:
    """Upright only: a heading is projected onto the ground after each motion."""
    a, b, boxes = make_upright(a), make_upright(b), boxes.to(torch.float64)
    twice, once = boxes.transform(b).transform(a), boxes.transform(a @ b)
    assert_same(replace(twice, yaw=twice.yaw.sin()), replace(once, yaw=once.yaw.sin()), 1e-8)
    assert_same(twice.yaw.cos(), once.yaw.cos(), 1e-8)
    assert_same(twice.corners(), (a @ b).apply(boxes.corners()), 1e-8)
