# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.sensors.lidar import ASPHALT, PAINT, RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import LidarSpec, spread_beams
from manyeyes.simulator.sensors.lidars import lidar_spec

QUIET = LidarSpec(per_turn=900, drop_general=0, drop_dark=0, drop_grazing=0, range_sigma_m=0)
HERE = Transform.from_xyz_yaw(0, 0)


def ground(slope: float = 0.0) -> HeightField:
    x = np.arange(-150, 150.1, 0.5)
    surface = np.full((2400, 2400), ASPHALT, np.uint8)
    surface[:, 1280:1300] = PAINT
    return HeightField(np.tile(slope * x, (len(x), 1)).astype(np.float32), surface, -150.0, -150.0, 0.5, 0.125)


def cars(*places: tuple[float, float]) -> Primitives:
    ids = np.arange(1, len(places) + 1)
    position = np.array([[*p, 0.0] for p in places])
    bodies = [make_vehicle_shape("car", (4.4, 1.8, 1.5), 0, int(i)) for i in ids]
    return place_vehicle_shapes(bodies, position, np.zeros(len(ids)), np.zeros(len(ids)), ids)


def test_the_road_is_at_zero_and_returns_carry_their_vehicle() -> None:
    cloud, instance = scan(RaycastScene(cars((10, 0), (0, -8)), ground()), HERE, QUIET, (0,))
    assert float(cloud.xyz[torch.from_numpy(instance == 0), 2].abs().max()) < 2e-3
    for id, (x, y) in ((1, (10, 0)), (2, (0, -8))):
        mine = cloud.xyz[torch.from_numpy(instance == id)]
        assert len(mine) > 100
        assert float((mine[:, 0] - x).abs().max()) < 2.21
        assert float((mine[:, 1] - y).abs().max()) < 0.91
    assert float(cloud.time_s.min()) >= -0.1
    assert float(cloud.time_s.max()) <= 0


def test_on_a_slope_the_road_under_a_pitched_agent_is_at_zero() -> None:
    pitch = -math.atan(0.08)
    zero, up = torch.zeros((), dtype=torch.float64), torch.tensor(pitch, dtype=torch.float64)
    pose = Transform.from_rpy(torch.tensor([4.0, 0.0, 0.32], dtype=torch.float64), zero, up, zero)
    cloud, _ = scan(RaycastScene(Primitives.empty(), ground(0.08)), pose, QUIET, (0,))
    near = cloud.xyz[cloud.xyz[:, :2].norm(dim=1) < 30]
    assert len(near) > 10_000
    assert float(near[:, 2].abs().max()) < 5e-3
    upright, _ = scan(RaycastScene(Primitives.empty(), ground(0.08)), Transform.from_xyz_yaw(4, 0, 0.32), QUIET, (0,))
    assert float(upright.xyz[upright.xyz[:, :2].norm(dim=1) < 30, 2].abs().max()) > 1.0


def test_the_carrier_is_not_met() -> None:
    scene = RaycastScene(cars((0, 0), (12, 0)), ground())
    _, with_own = scan(scene, HERE, QUIET, (0,))
    _, without = scan(scene, HERE, QUIET, (0,), own=1)
    assert (with_own == 1).any()
    assert not (without == 1).any()
    assert (without == 2).any()


def test_the_key_decides_noise_and_loss() -> None:
    scene, spec = RaycastScene(cars((10, 0)), ground()), lidar_spec("opv2v")
    one, same, other = (scan(scene, HERE, spec, key)[0] for key in ((1, 2), (1, 2), (1, 3)))
    assert torch.equal(one.xyz, same.xyz)
    assert one.xyz.shape != other.xyz.shape or not torch.equal(one.xyz, other.xyz)


def test_noise_lies_along_the_ray_and_has_the_stated_size() -> None:
    scene = RaycastScene(Primitives.empty(), ground())
    clean, _ = scan(scene, HERE, QUIET, (0,))
    noisy, _ = scan(scene, HERE, replace(QUIET, range_sigma_m=0.05), (0,))
    sensor = torch.tensor([0.0, 0.0, QUIET.height_m])
    r0, r1 = (clean.xyz - sensor).norm(dim=1), (noisy.xyz - sensor).norm(dim=1)
    assert float((r1 - r0).std()) == pytest.approx(0.05, rel=0.03)
    assert float(((clean.xyz - sensor) / r0[:, None] - (noisy.xyz - sensor) / r1[:, None]).abs().max()) < 1e-5


def test_loss_rises_with_range_and_grazing_incidence() -> None:
    scene = RaycastScene(Primitives.empty(), ground())
    kept, _ = scan(scene, HERE, replace(QUIET, drop_dark=0.15, drop_grazing=0.3, drop_general=0.1), (0,))
    whole, _ = scan(scene, HERE, QUIET, (0,))

    def share(low: float, high: float) -> float:
        counts = [int(((r := c.xyz[:, :2].norm(dim=1)) > low).logical_and(r < high).sum()) for c in (kept, whole)]
        return counts[0] / counts[1]

    assert share(0, 15) == pytest.approx(0.9, abs=0.01)
    assert share(95, 119) < share(40, 60) < share(0, 15) - 0.1


def test_paint_is_bright_and_intensity_falls_with_range() -> None:
    cloud, _ = scan(RaycastScene(Primitives.empty(), ground()), HERE, QUIET, (0,))
    x, bright = cloud.xyz[:, 0], cloud.intensity
    near = cloud.xyz.norm(dim=1) < 25
    paint = near & (x > 10.1) & (x < 12.4)
    road = near & ((x < 9.9) | (x > 12.6))
    assert float(bright[paint].min()) > 2.5 * float(bright[road].median())
    assert float(bright.min()) >= 0
    assert float(bright.max()) <= 1
    assert float(bright[cloud.xyz.norm(dim=1) > 60].mean()) < 0.8 * float(bright[road].mean())


def test_points_on_a_vehicle_fall_with_range() -> None:
    counts = []
    for distance in (8.0, 16.0, 32.0, 64.0):
        _, instance = scan(RaycastScene(cars((distance, 0)), ground()), HERE, lidar_spec("opv2v"), (0,))
        counts.append(int((instance == 1).sum()))
    assert counts[0] > 2 * counts[1] > 4 * counts[2] > 8 * counts[3] > 0


def test_the_presets_match_their_names() -> None:
    scene = RaycastScene(cars((10, 0), (-10, 0)), ground())
    for name, low, high in (("opv2v", 40_000, 60_000), ("opv2v-roadside", 40_000, 60_000)):
        cloud, _ = scan(scene, HERE, lidar_spec(name), (0,))
        assert low < len(cloud) < high, name
    forward, instance = scan(scene, HERE, lidar_spec("dair-infrastructure"), (0,))
    assert float(forward.xyz[:, 0].min()) >= 0
    assert set(np.unique(instance)) == {0, 1}
    assert lidar_spec("spinning-64").num_beams * lidar_spec("spinning-64").azimuth.size == 115_200


def test_misuse_is_named() -> None:
    with pytest.raises(ConfigError, match="No LiDAR 'vlp'; choose one of spinning-64, opv2v"):
        lidar_spec("vlp")
    with pytest.raises(ConfigError, match="at least two beams"):
        spread_beams(1, -10, 10)
    with pytest.raises(ConfigError, match=r"LidarSpec without a name: ranges need 0 <= min_range_m < max_range_m; got"):
        LidarSpec(min_range_m=200.0)
