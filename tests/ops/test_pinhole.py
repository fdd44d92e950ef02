# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.ops.pinhole import LEAF_M, PinholeCamera, cast_pinhole, cast_pinhole_reference
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, GROUND, NOTHING, HeightField, Primitives, SensorPose

# world_from_camera of a level camera that looks along +x: its right is -y, its down is -z.
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
INTRINSIC = np.array([[33.5, 0, 40], [0, 33.5, 30], [0, 0, 1]])
EYE = np.array([0.3, -0.2, 3.0])


def turn(yaw: float, pitch: float = 0.0) -> np.ndarray:
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])


def solid(kind: int, center, half, rotation=None, density=0.0, instance=0) -> Primitives:
    return Primitives(
        np.array([kind], np.uint8),
        np.array([center], float),
        (np.eye(3) if rotation is None else rotation)[None],
        np.array([half], float),
        np.array([density]),
        np.array([instance]),
        np.array([0.5]),
    )


def field(height) -> HeightField:
    axis = np.arange(-60, 60.1, 0.5)
    x, y = np.meshgrid(axis, axis)
    return HeightField((height(x, y) + 0 * x).astype(np.float32), np.ones((10, 10), np.uint8), -60.0, -60.0, 0.5, 12.0)


def flat(z: float) -> HeightField:
    return field(lambda x, y: z)


def hills() -> HeightField:
    return field(lambda x, y: 0.06 * x + 1.2 * np.sin(x / 9) * np.cos(y / 13))


def crowd(seed: int) -> Primitives:
    rng = np.random.default_rng(seed)
    many = []
    for i in range(30):
        angle = rng.uniform(-0.8, 0.8)
        place = np.array([*(rng.uniform(1, 40) * np.array([np.cos(angle), np.sin(angle)])), rng.uniform(0, 4)])
        kind = int(rng.integers(3))
        half = rng.uniform(0.2, 2.5, 3)
        if kind == CYLINDER:
            half[:2] = rng.uniform(0.1, 1)
        density = float(rng.uniform(0.3, 2)) if kind == ELLIPSOID and i % 2 else 0.0
        many.append(solid(kind, place, half, turn(rng.uniform(-4, 4), rng.uniform(-0.2, 0.2)), density, i))
    return Primitives.cat(many)


@pytest.mark.slow
@pytest.mark.parametrize("ground", [flat(-1.0), hills()], ids=["flat", "hills"])
@pytest.mark.parametrize("seed", [2, 9])
def test_equals_every_ray_against_every_primitive(seed: int, ground: HeightField) -> None:
    small = np.diag([0.5, 0.5, 1.0]) @ INTRINSIC
    args = (crowd(seed), ground, SensorPose(EYE, turn(0.1, 0.05) @ AHEAD), PinholeCamera(small, 40, 30), 50.0, 11, 4)
    fast, slow = cast_pinhole(*args), cast_pinhole_reference(*args)
    same = fast.primitive == slow.primitive
    assert same.mean() > 0.998
    assert {int(k) for k in np.unique(args[0].kind[slow.primitive[slow.primitive >= 0]])} == {BOX, CYLINDER, ELLIPSOID}
    opaque = same & (slow.primitive >= 0) & (args[0].density[slow.primitive] == 0)
    np.testing.assert_allclose(fast.depth_m[opaque], slow.depth_m[opaque], atol=1e-9)
    leafy = same & (slow.primitive >= 0) & ~opaque
    assert leafy.sum() > 20
    # The twin steps over corners of leaves that are thinner than a millimetre.
    assert (np.abs(fast.depth_m[leafy] - slow.depth_m[leafy]) < 0.002).mean() > 0.97
    ground_seen = same & (slow.primitive == GROUND)
    assert ground_seen.sum() > 80
    # The twin's steps are 1 cm of depth.
    np.testing.assert_allclose(fast.depth_m[ground_seen], slow.depth_m[ground_seen], atol=0.02)
    assert (fast.primitive != 4).all()


def test_a_box_covers_the_pixels_of_the_formula() -> None:
    #   a wall 2 m wide and 1 m high, its face 10 m ahead, seen through f = 33.5 px: 6.7 x 3.35 px about the middle
    wall = solid(BOX, (10.5, 0, 0), (0.5, 1.0, 0.5))
    sight = cast_pinhole(wall, flat(-100.0), SensorPose(np.zeros(3), AHEAD), PinholeCamera(INTRINSIC, 80, 60), 50.0)
    rows, columns = np.nonzero(sight.primitive == 0)
    assert (columns.min(), columns.max()) == (37, 42)
    assert (rows.min(), rows.max()) == (28, 31)
    assert np.allclose(sight.depth_m[sight.primitive == 0], 10.0)
    assert (sight.primitive[sight.primitive != 0] == NOTHING).all()


def test_a_box_that_extends_behind_the_camera_is_rendered() -> None:
    wall = solid(BOX, (0, 3, 0), (30.0, 0.5, 5.0))
    sight = cast_pinhole(wall, flat(-100.0), SensorPose(np.zeros(3), AHEAD), PinholeCamera(INTRINSIC, 80, 60), 50.0)
    assert (sight.primitive[30, :30] == 0).all()
    assert (sight.primitive[30, 44:] == NOTHING).all()
    behind = replace(wall, center=np.array([[-40.0, 0, 0]]))
    assert (
        cast_pinhole(
            behind, flat(-100.0), SensorPose(np.zeros(3), AHEAD), PinholeCamera(INTRINSIC, 80, 60), 50.0
        ).primitive
        == NOTHING
    ).all()


def test_foliage_transmission_follows_its_density() -> None:
    density, thick = 0.6, 2.0
    slab = turn(0.5, 0.3)
    crown = solid(ELLIPSOID, 20 * slab[:, 0], (thick / 2, 60.0, 60.0), slab, density)
    fine = np.array([[400.0, 0, 100], [0, 400.0, 100], [0, 0, 1]])
    sight = cast_pinhole(
        crown,
        flat(-100.0),
        SensorPose(np.zeros(3), slab @ turn(0.6, 0.5) @ AHEAD),
        PinholeCamera(fine, 200, 200),
        90.0,
        5,
    )
    chord = thick / turn(0.6, 0.5)[0, 0]
    assert abs((sight.primitive == NOTHING).mean() - np.exp(-density * chord)) < 0.06


def test_leaves_are_equal_for_all_cameras() -> None:
    crown = solid(ELLIPSOID, (12, 0, 0), (2.0, 2.0, 2.0), density=1.0)
    sight = cast_pinhole(crown, flat(-100.0), SensorPose(np.zeros(3), AHEAD), PinholeCamera(INTRINSIC, 80, 60), 60.0, 5)
    rows, columns = np.nonzero(sight.primitive == 0)
    assert len(rows) > 50
    one_pixel = np.array([[100.0, 0, 0.5], [0, 100.0, 0.5], [0, 0, 1]])
    for row, column in list(zip(rows, columns))[::5]:
        ray = AHEAD @ np.array([(column + 0.5 - 40) / 33.5, (row + 0.5 - 30) / 33.5, 1.0])
        leaf = (sight.depth_m[row, column] + 0.01) * ray
        eye = np.array([3.0, -2.0, 1.5])
        ahead = (leaf - eye) / np.linalg.norm(leaf - eye)
        right = np.cross(ahead, (0.0, 0, 1)) / np.hypot(*ahead[:2])
        world_from_camera = np.stack([right, np.cross(ahead, right), ahead], 1)
        met = cast_pinhole(
            crown, flat(-100.0), SensorPose(eye, world_from_camera), PinholeCamera(one_pixel, 1, 1), 60.0, 5
        )
        assert met.depth_m[0, 0] <= np.linalg.norm(leaf - eye) + LEAF_M
