# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes import ShapeError
from manyeyes.ops.raycast import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    GROUND,
    NOTHING,
    HeightField,
    Primitives,
    SensorPose,
    cast_rays,
    cast_rays_reference,
)


def turn(yaw: float, pitch: float = 0.0) -> np.ndarray:
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])


def solid(kind: int, center, half, yaw=0.0, pitch=0.0, density=0.0, instance=0) -> Primitives:
    return Primitives(
        np.array([kind], np.uint8),
        np.array([center], float),
        turn(yaw, pitch)[None],
        np.array([half], float),
        np.array([density]),
        np.array([instance]),
        np.array([0.5]),
    )


def flat(height: float = 0.0) -> HeightField:
    surface = np.ones((800, 800), np.uint8)
    surface[:, 400:420] = 2
    return HeightField(np.full((201, 201), height, np.float32), surface, -50.0, -50.0, 0.5, 0.125)


def hills() -> HeightField:
    x, y = np.meshgrid(np.arange(-60, 60.1, 0.5), np.arange(-60, 60.1, 0.5))
    height = 0.06 * x + 1.5 * np.sin(x / 9) * np.cos(y / 13)
    return HeightField(height.astype(np.float32), np.ones((10, 10), np.uint8), -60.0, -60.0, 0.5, 12.0)


def crowd(seed: int, count: int = 40) -> Primitives:
    rng = np.random.default_rng(seed)
    many = []
    for i in range(count):
        place = np.append(
            rng.uniform(4, 45) * np.array([np.cos(t := rng.uniform(0, 7)), np.sin(t)]), rng.uniform(-1, 3)
        )
        kind = int(rng.integers(3))
        half = rng.uniform(0.2, 3, 3)
        if kind == CYLINDER:
            half[:2] = rng.uniform(0.1, 1)
        density = float(rng.uniform(0.2, 2)) if kind == ELLIPSOID and i % 2 else 0.0
        many.append(solid(kind, place, half, rng.uniform(-4, 4), rng.uniform(-0.2, 0.2), density, i))
    return Primitives.cat(many)


ORIGIN = np.array([0.3, -0.2, 2.0])
BEAMS = np.deg2rad(np.linspace(-24, 6, 24))


def circle(n: int) -> np.ndarray:
    return -np.pi + 2 * np.pi * np.arange(n) / n


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("tilt", [0.0, 0.12])
def test_equals_every_ray_against_every_primitive(seed: int, tilt: float) -> None:
    args = (crowd(seed), flat(-20.0), SensorPose(ORIGIN, turn(0.4, tilt)), BEAMS, circle(360), 360, 60.0, 7)
    fast, slow = cast_rays(*args), cast_rays_reference(*args)
    assert (fast.primitive == slow.primitive).mean() > 0.9999
    same = (fast.primitive == slow.primitive) & (slow.primitive >= 0)
    assert same.sum() > 2000
    np.testing.assert_allclose(fast.range_m[same], slow.range_m[same], atol=1e-9)
    np.testing.assert_allclose(fast.cosine[same], slow.cosine[same], atol=1e-7)


@pytest.mark.parametrize("tilt", [0.0, 0.08])
def test_ground_equals_small_steps(tilt: float) -> None:
    args = (crowd(3, 6), hills(), SensorPose(np.array([0.0, 0.0, 2.1]), turn(1.0, tilt)), BEAMS, circle(90), 90, 55.0)
    fast, slow = cast_rays(*args), cast_rays_reference(*args)
    both = (fast.primitive == GROUND) & (slow.primitive == GROUND)
    assert both.sum() > 800
    assert (fast.primitive == slow.primitive).mean() > 0.99  # crests narrower than a step may differ
    error = np.abs(fast.range_m[both] - slow.range_m[both])
    assert np.quantile(error, 0.98) < 0.05


def test_flat_ground_is_exact_and_carries_its_class() -> None:
    hits = cast_rays(
        Primitives.empty(), flat(), SensorPose(np.array([0.0, 0.0, 2.0]), np.eye(3)), BEAMS, circle(360), 360, 40.0
    )
    reach = 2.0 / np.sin(-BEAMS, where=BEAMS < 0, out=np.full_like(BEAMS, 1e-9))
    expected = (reach > 0) & (reach < 39.9) & (BEAMS < 0)
    assert (hits.primitive[:, expected] == GROUND).all()
    assert (hits.primitive[:, ~expected & (reach > 40.1)] == NOTHING).all()
    np.testing.assert_allclose(
        hits.range_m[:, expected], np.broadcast_to(reach[expected], (360, expected.sum())), atol=2e-3
    )
    x = hits.range_m * np.cos(BEAMS) * np.cos(circle(360))[:, None]
    ground = hits.primitive == GROUND
    sure = ground & (np.abs(x) > 0.02) & (np.abs(x - 2.5) > 0.02)
    assert (hits.surface[sure] == np.where((x > 0) & (x < 2.5), 2, 1)[sure]).all()
    np.testing.assert_allclose(hits.cosine[ground], np.broadcast_to(np.sin(-BEAMS), x.shape)[ground], atol=1e-6)


def test_a_sector_equals_that_part_of_the_full_scan() -> None:
    scene, beams = crowd(5), BEAMS
    whole = cast_rays(scene, flat(-20.0), SensorPose(ORIGIN, turn(0.3)), beams, circle(360), 360, 60.0, 0)
    part = cast_rays(
        scene[scene.density == 0], flat(-20.0), SensorPose(ORIGIN, turn(0.3)), beams, circle(360)[130:230], 360, 60.0, 0
    )
    again = cast_rays(
        scene[scene.density == 0], flat(-20.0), SensorPose(ORIGIN, turn(0.3)), beams, circle(360), 360, 60.0, 0
    )
    np.testing.assert_array_equal(part.range_m, again.range_m[130:230])
    assert whole.range_m.shape == (360, 24)


def test_foliage_lets_some_rays_through_and_the_seed_decides_which() -> None:
    tree = solid(ELLIPSOID, (8, 0, 2), (2, 2, 2), density=0.5)
    one = cast_rays(tree, flat(-20.0), SensorPose(ORIGIN, np.eye(3)), BEAMS, circle(720), 720, 60.0, 1)
    two = cast_rays(tree, flat(-20.0), SensorPose(ORIGIN, np.eye(3)), BEAMS, circle(720), 720, 60.0, 2)
    opaque = cast_rays(
        solid(ELLIPSOID, (8, 0, 2), (2, 2, 2)),
        flat(-20.0),
        SensorPose(ORIGIN, np.eye(3)),
        BEAMS,
        circle(720),
        720,
        60.0,
    )
    share = (one.primitive == 0).sum() / (opaque.primitive == 0).sum()
    assert 0.4 < share < 0.9
    assert (one.primitive != two.primitive).any()
    assert ((one.primitive == 0) <= (opaque.primitive == 0)).all()


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match=r"Primitives.half needs shape \(1, 3\)"):
        one = solid(BOX, (0, 0, 0), (1, 1, 1))
        Primitives(one.kind, one.center, one.rotation, one.half[:, :2], one.density, one.instance, one.reflectivity)
