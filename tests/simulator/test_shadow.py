# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, Primitives, reference_hit
from manyeyes.simulator.sensors.shadow import build_shadow_index, sun_and_sky_visibility

SUN = np.array([0.48, -0.36, 0.8])


def crowd(count: int, density: float = 0.0) -> Primitives:
    rng = np.random.default_rng(1)
    angle = rng.uniform(-3, 3, count)
    rotation = np.zeros((count, 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1] = np.cos(angle), -np.sin(angle)
    rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 2, 2] = np.sin(angle), np.cos(angle), 1
    kind = rng.integers(3, size=count).astype(np.uint8)
    center = np.stack((rng.uniform(-20, 20, count), rng.uniform(-20, 20, count), rng.uniform(0, 8, count)), -1)
    return Primitives(
        kind, center, rotation, rng.uniform(0.3, 4, (count, 3)), np.where(kind == ELLIPSOID, density, 0.0),
        np.zeros(count, np.int64), np.full(count, 0.5),
    )  # fmt: skip


def points(count: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.stack((rng.uniform(-30, 30, count), rng.uniform(-30, 30, count), rng.uniform(0, 3, count)), -1)


def test_equals_every_point_against_every_solid() -> None:
    solids, at = crowd(60), points(300)
    lit, _ = sun_and_sky_visibility(build_shadow_index(solids, SUN, 0.0), at, np.zeros(len(at), bool))
    slow = np.ones(len(at), bool)
    for i in range(len(solids)):
        o = (at - solids.center[i]) @ solids.rotation[i]
        inside = (np.abs(o) < solids.half[i]).all(1)
        for n in np.flatnonzero(~inside):
            t, _, _ = reference_hit(int(solids.kind[i]), o[n], (SUN @ solids.rotation[i])[None], solids.half[i])
            slow[n] &= not t[0] < np.inf
        slow[inside] = lit[inside] > 0  # no point of a surface is within a solid: undefined
    assert 0.3 < slow.mean() < 0.9
    assert {int(k) for k in solids.kind} == {BOX, CYLINDER, ELLIPSOID}
    assert (slow == (lit > 0)).all()


def test_a_crown_shades_by_its_leaves_and_dims_within() -> None:
    crown = Primitives(
        np.array([ELLIPSOID], np.uint8), np.array([[0.0, 0, 6]]), np.eye(3)[None], np.array([[2.0, 2, 2]]),
        np.array([0.5]), np.zeros(1, np.int64), np.array([0.5]),
    )  # fmt: skip
    x, y = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    below = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), -1)
    shadows = build_shadow_index(crown, np.array([0.0, 0, 1]), 0.0)
    lit, _ = sun_and_sky_visibility(shadows, below, np.ones(len(below), bool))
    assert set(np.unique(lit)) == {0.0, 1.0}
    chord = 2 * np.sqrt(4 - x**2 - y**2)
    # Cubes of leaves are crossed straight, two thirds as often as by rays of any direction.
    assert lit.mean() == pytest.approx(np.exp(-0.5 * 2 / 3 * chord).mean(), abs=0.06)
    within = np.array([[0, 0, 5.0], [0, 0, 7.9]])
    dim, bright = sun_and_sky_visibility(shadows, within, np.zeros(2, bool))[0]
    assert (dim, bright) == pytest.approx((np.exp(-0.5 * 0.5 * 3.0), np.exp(-0.5 * 0.5 * 0.1)))


def test_the_ground_beside_a_wall_has_less_sky_visibility() -> None:
    wall = Primitives(
        np.array([BOX], np.uint8), np.array([[0.0, 0, 1]]), np.eye(3)[None], np.array([[3.0, 0.5, 1]]), np.zeros(1),
        np.zeros(1, np.int64), np.array([0.5]),
    )  # fmt: skip
    at = np.array([[0.0, 0.5, 0], [0, 0.95, 0], [0, 1.5, 0], [0, 0.6, 3]])
    _, open_sky = sun_and_sky_visibility(build_shadow_index(wall, SUN, 0.0), at, np.ones(4, bool))
    assert open_sky == pytest.approx([0.35, 0.675, 1.0, 1.0])
    assert (sun_and_sky_visibility(build_shadow_index(wall, SUN, 0.0), at, np.zeros(4, bool))[1] == 1).all()


def test_nothing_shades_nothing() -> None:
    lit, open_sky = sun_and_sky_visibility(
        build_shadow_index(Primitives.empty(), SUN, 0.0), points(5), np.ones(5, bool)
    )
    assert (lit == 1).all()
    assert (open_sky == 1).all()
