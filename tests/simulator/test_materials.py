# SPDX-License-Identifier: Apache-2.0
import numpy as np

from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, Primitives
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.sensors.lighting import draw_light, tone_map
from manyeyes.simulator.sensors.materials import (
    BARK,
    FACADE,
    GLASS,
    GLAZED,
    HEDGE,
    LEAVES,
    METAL,
    PAINTWORK,
    PLATE,
    RUBBER,
    SIGNAL,
    STEEL,
    TARPAULIN,
    WALL,
    Materials,
    make_static_materials,
    make_vehicle_materials,
)


def as_built(kind: int, half: tuple[float, float, float], reflectivity: float, density: float = 0.0) -> Primitives:
    return Primitives(
        np.array([kind], np.uint8), np.zeros((1, 3)), np.eye(3)[None], np.array([half]), np.array([density]),
        np.zeros(1, np.int64), np.array([reflectivity]),
    )  # fmt: skip


def test_static_solids_are_classified_by_their_shape() -> None:
    built = {
        FACADE: as_built(BOX, (5.0, 8.0, 6.0), 0.4),
        WALL: as_built(BOX, (0.12, 4.0, 0.9), 0.4),
        HEDGE: as_built(BOX, (0.4, 3.0, 0.7), 0.25),
        METAL: as_built(CYLINDER, (0.1, 0.1, 3.7), 0.5),
        BARK: as_built(CYLINDER, (0.2, 0.2, 1.6), 0.2),
        LEAVES: as_built(ELLIPSOID, (2.0, 2.0, 1.8), 0.3, 0.8),
        PLATE: as_built(BOX, (0.3, 0.03, 0.3), 0.95),
        SIGNAL: as_built(BOX, (0.16, 0.16, 0.45), 0.1),
    }
    materials = make_static_materials(Primitives.cat(list(built.values())), 3)
    assert materials.material.tolist() == list(built)
    assert ((materials.rgb > 0) & (materials.rgb < 1)).all()
    leaves = materials.rgb[materials.material == LEAVES][0]
    assert leaves.argmax() != 2
    assert not np.array_equal(materials.rgb, make_static_materials(Primitives.cat(list(built.values())), 4).rgb)


def test_vehicles_have_the_materials_of_their_parts_in_the_order_of_their_solids() -> None:
    kinds = ("car", "van", "truck", "bus")
    sizes = np.array([[4.4, 1.8, 1.5], [5.5, 2.0, 2.3], [8.0, 2.5, 3.2], [11.0, 2.5, 3.1]])
    bodies = {i + 1: make_vehicle_shape(kind, tuple(sizes[i]), 0, i + 1) for i, kind in enumerate(kinds)}
    zero = np.zeros(4)
    states = VehicleStates(np.arange(1, 5), np.arange(4), np.zeros((4, 3)), zero, zero, zero, sizes)
    materials = make_vehicle_materials(states, bodies, 5)
    solids = place_vehicle_shapes(list(bodies.values()), states.position, zero, zero, states.id)
    assert len(materials.material) == len(solids)
    of = {kind: set(materials.material[solids.instance == i + 1].tolist()) for i, kind in enumerate(kinds)}
    assert of["car"] == {PAINTWORK, GLAZED, RUBBER}
    assert of["van"] == {PAINTWORK, GLASS, RUBBER}
    assert of["truck"] == {PAINTWORK, TARPAULIN, STEEL, RUBBER}
    assert of["bus"] == {PAINTWORK, GLAZED, RUBBER}
    np.testing.assert_allclose(materials.anchor, solids.center, atol=1e-6)  # they stand at the origin
    axles = materials.axles[solids.instance == 1][0]
    np.testing.assert_allclose(axles[:2], [0.31 * 4.4, -0.29 * 4.4], rtol=1e-5)
    assert np.isinf(axles[2])
    assert axles[3] == np.float32(0.42 * 1.5 / 2)
    assert len(make_vehicle_materials(VehicleStates.empty(), {}, 0).material) == 0
    assert isinstance(Materials.cat([materials, materials]), Materials)


def test_light_follows_from_its_key_and_stands_above_the_horizon() -> None:
    many = [draw_light(seed, "x") for seed in range(40)]
    assert np.array_equal(many[0].sun, draw_light(0, "x").sun)
    assert len({light.cloud for light in many}) > 10
    for light in many:
        assert abs(np.linalg.norm(light.sun) - 1) < 1e-9
        assert np.sin(np.deg2rad(17)) < light.sun[2] < np.sin(np.deg2rad(63))
        rays = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for colour in (light.sky_radiance(rays), light.clear_sky_radiance(rays), light.ambient(rays)):
            assert np.isfinite(colour).all()
            assert colour.min() >= 0
    overcast, clear = max(many, key=lambda one: one.cloud), min(many, key=lambda one: one.cloud)
    assert overcast.sun_rgb.mean() < 0.4 * clear.sun_rgb.mean()


def test_haze_ends_at_the_horizons_colour_and_film_never_clips_below_or_above() -> None:
    light = draw_light(1, "x")
    far = light.apply_haze(np.zeros((1, 3), np.float32), np.array([1e6], np.float32))
    np.testing.assert_allclose(far[0], light.horizon_rgb, rtol=1e-5)
    tones = tone_map(np.linspace(0, 60, 1000, dtype=np.float32)[:, None])
    assert (np.diff(tones[:, 0]) >= 0).all()
    assert 0 <= tones.min() < 0.05 < 0.99 < tones.max() <= 1
