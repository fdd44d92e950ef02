# SPDX-License-Identifier: Apache-2.0
"""The table of LiDARs: its rows, what scans with them give, and errors of a wrong row."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.lidar.intensity import INTENSITY_LAWS, IntensityLaw
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.sensors.lidar import ASPHALT, PAINT, RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import BeamUnit, LidarSpec, spread_beams
from manyeyes.simulator.sensors.lidars import lidar_spec, lidar_specs, read_lidars

HERE = Transform.from_xyz_yaw(0, 0)
# name: heads of beams, lowest and highest elevation in degrees, azimuths a turn, as their makers state them.
STATED = {
    "spinning-64": ((64,), -25.0, 2.0, 1800),
    "opv2v": ((64,), -25.0, 2.0, 1016),
    "opv2v-32": ((32,), -25.0, 2.0, 1016),
    "opv2v-16": ((16,), -25.0, 2.0, 1016),
    "opv2v-128": ((128,), -25.0, 2.0, 1016),
    "opv2v-roadside": ((64,), -32.0, 0.0, 1016),
    "opv2v-roadside-32": ((32,), -32.0, 0.0, 1016),
    "opv2v-roadside-16": ((16,), -32.0, 0.0, 1016),
    "opv2v-roadside-128": ((128,), -32.0, 0.0, 1016),
    "v2xset": ((32,), -25.0, 2.0, 1562),
    "vlp-16": ((16,), -15.0, 15.0, 1800),
    "hdl-32e": ((32,), -30.67, 10.67, 2172),
    "hdl-64e": ((64,), -24.33, 2.0, 2083),
    "argoverse2": ((32, 32), -25.0, 25.0, 1800),
    "dair-vehicle": ((40,), -16.0, 7.0, 1800),
    "dair-infrastructure": ((300,), -34.0, 6.0, 1800),
    "dair-pandar40p": ((40,), -25.0, 15.0, 1800),
    "os1-128": ((128,), -22.5, 22.5, 2048),
    "pandar64": ((64,), -25.0, 15.0, 1800),
    "unseen-sensor": ((56, 24), -38.0, 1.0, 1200),
}
# Returns and sums of x, y, z, intensity and time of the scene below, by the code before the table (commit f80ac70).
MATERIAL_SUMS = {
    "opv2v": (46324, (3114.909, -2576.5695, 847.2495, 4569.6674, -2312.7762)),
    "opv2v-16": (11378, (3962.0535, 347.8026, 279.1321, 1128.38, -565.937)),
    "opv2v-roadside-32": (24320, (3965.3385, 204.8689, 552.4687, 2722.7011, -1215.1744)),
    "spinning-64": (89120, (8487.8975, -4528.377, 1665.0435, 8793.9139, -4448.943)),
    "dair-vehicle": (40393, (17465.383, -396.4824, 1403.7904, 4111.4502, -2017.0014)),
    "dair-infrastructure": (116227, (2885595.0628, -2458.944, 62178.7282, 17962.2606, -5812.4022)),
}


def make_ground(slope: float = 0.0) -> HeightField:
    x = np.arange(-150, 150.1, 0.5)
    surface = np.full((2400, 2400), ASPHALT, np.uint8)
    surface[:, 1280:1300] = PAINT
    return HeightField(np.tile(slope * x, (len(x), 1)).astype(np.float32), surface, -150.0, -150.0, 0.5, 0.125)


def make_cars(*places: tuple[float, float]) -> Primitives:
    ids = np.arange(1, len(places) + 1)
    bodies = [make_vehicle_shape("car", (4.4, 1.8, 1.5), 0, int(i)) for i in ids]
    position = np.array([[*p, 0.0] for p in places])
    return place_vehicle_shapes(bodies, position, np.zeros(len(ids)), np.zeros(len(ids)), ids)


def make_quiet(spec: LidarSpec) -> LidarSpec:
    """Without noise, loss and tilt."""
    return replace(
        spec,
        roll_rad=0.0,
        pitch_rad=0.0,
        range_sigma_m=0.0,
        drop_general=0.0,
        drop_dark=0.0,
        drop_grazing=0.0,
        range_10_percent_m=0.0,
    )


def test_every_row_has_the_stated_beams_field_of_view_and_azimuths() -> None:
    assert set(lidar_specs()) == set(STATED)
    for name, (beams, lower, upper, per_turn) in STATED.items():
        spec = lidar_spec(name)
        assert spec.name == name
        assert tuple(len(unit.elevations_rad) for unit in spec.units) == beams, name
        assert spec.field_of_view_deg == pytest.approx((lower, upper), abs=1e-9), name
        assert spec.per_turn == per_turn, name


def test_known_spacings_of_beams() -> None:
    degrees = {name: np.degrees(lidar_spec(name).units[0].elevation) for name in STATED}
    assert np.diff(degrees["v2xset"]) == pytest.approx(np.full(31, 0.871), abs=1e-3)
    assert np.diff(degrees["hdl-64e"])[[0, 40]] == pytest.approx([0.5, 1 / 3], abs=2e-3)
    assert (np.diff(degrees["dair-pandar40p"]) < 0.34).sum() == 24
    assert (np.diff(degrees["pandar64"]) < 0.17).sum() == 48
    up, down = (np.degrees(unit.elevation) for unit in reversed(lidar_spec("argoverse2").units))
    assert up == pytest.approx(-down[::-1])


@pytest.mark.parametrize("name", MATERIAL_SUMS)
def test_with_material_intensity_todays_sensors_are_unchanged(name: str) -> None:
    scene = RaycastScene(make_cars((10, 0), (-14, 6), (30, 4)), make_ground(0.02))
    cloud, _ = scan(scene, HERE, replace(lidar_spec(name), intensity=INTENSITY_LAWS["material"]), (3, name))
    count, sums = MATERIAL_SUMS[name]
    assert len(cloud) == count
    assert cloud.time_s is not None
    found = torch.cat([cloud.xyz, cloud.intensity[:, None], cloud.time_s[:, None]], 1).double().sum(0)
    assert found.tolist() == pytest.approx(sums, rel=1e-5, abs=2e-3)


@pytest.mark.parametrize("name", ["dair-pandar40p", "argoverse2", "unseen-sensor", "hdl-64e"])
def test_returns_of_a_plane_lie_where_each_beam_meets_it(name: str) -> None:
    spec = make_quiet(lidar_spec(name))
    cloud, _ = scan(RaycastScene(Primitives.empty(), make_ground()), HERE, spec, (0,))
    radius = np.sort(cloud.xyz[:, :2].norm(dim=1).double().numpy())
    expected = []
    for unit in spec.units:
        height, elevation = spec.height_m + unit.offset_m, unit.elevation
        reach = np.full(elevation.shape, np.inf)
        down = elevation < 0
        reach[down] = height / -np.sin(elevation[down])
        met = reach < spec.max_range_m
        expected.append(np.repeat(height / -np.tan(elevation[met]), spec.per_turn))
    rings = np.sort(np.concatenate(expected))
    assert len(rings) > 20 * 1000
    inside = rings < 140  # of the raster
    assert len(radius) == pytest.approx(len(rings), rel=1e-3)
    assert np.abs(radius[: inside.sum()] - rings[inside]).max() < 0.02


def test_a_stack_sees_what_its_heads_see() -> None:
    spec = make_quiet(lidar_spec("argoverse2"))
    scene = RaycastScene(make_cars((10, 0)), make_ground())
    both, _ = scan(scene, HERE, spec, (0,))
    counts = []
    for unit in spec.units:
        alone = replace(spec, units=(BeamUnit(unit.elevations_rad),), height_m=spec.height_m + unit.offset_m)
        counts.append(len(scan(scene, HERE, alone, (0,))[0]))
    assert len(both) == sum(counts)


def test_the_frame_of_a_tilted_sensor_has_its_axes_and_its_origin_on_the_road() -> None:
    """Ahead is down: the road rises in the sensor's frame ahead, and falls behind."""
    spec = replace(make_quiet(lidar_spec("spinning-64")), pitch_rad=np.radians(1.5), roll_rad=np.radians(-1.0))
    mount = Transform.from_xyz_yaw(3, -2, 0, 0.4)
    pose = spec.agent_pose(mount)
    cloud, _ = scan(RaycastScene(Primitives.empty(), make_ground()), pose, spec, (0,))
    world = pose.apply(cloud.xyz.double())
    assert float(world[:, 2].abs().max()) < 5e-3
    x, y, z = cloud.xyz.unbind(1)
    fitted = torch.linalg.lstsq(torch.stack([x, y, torch.ones_like(x)], 1).double(), z.double()[:, None]).solution
    assert fitted[:, 0].tolist() == pytest.approx([np.tan(np.radians(1.5)), np.tan(np.radians(1.0)), 0.0], abs=2e-3)
    sensor = torch.tensor([[0.0, 0.0, spec.height_m]], dtype=torch.float64)
    torch.testing.assert_close(pose.apply(sensor), mount.apply(sensor))
    level = replace(spec, roll_rad=0.0, pitch_rad=0.0)
    assert level.agent_pose(mount) is mount


def test_carlas_law_depends_on_range_alone() -> None:
    spec = make_quiet(lidar_spec("opv2v"))
    cloud, _ = scan(RaycastScene(make_cars((10, 0)), make_ground()), HERE, spec, (0,))
    reach = (cloud.xyz - torch.tensor([0.0, 0.0, spec.height_m])).norm(dim=1)
    torch.testing.assert_close(cloud.intensity, torch.exp(-0.004 * reach))


def test_laws_change_intensity_alone() -> None:
    scene, spec = RaycastScene(make_cars((10, 0)), make_ground()), lidar_spec("opv2v-16")
    clouds = {name: scan(scene, HERE, replace(spec, intensity=law), (1,))[0] for name, law in INTENSITY_LAWS.items()}
    for name, cloud in clouds.items():
        assert torch.equal(cloud.xyz, clouds["material"].xyz), name
        assert name == "material" or not torch.equal(cloud.intensity, clouds["material"].intensity), name


def test_gains_of_beams_stay_and_noise_does_not() -> None:
    scene = RaycastScene(Primitives.empty(), make_ground())
    spec = make_quiet(lidar_spec("opv2v-16"))
    for kind, stays in (("per-beam-gain", True), ("noise", False)):
        law = replace(spec, intensity=IntensityLaw(kind))
        one, two = (scan(scene, HERE, law, (0, frame), sensor_key=("a",))[0] for frame in (1, 2))
        assert torch.equal(one.intensity, two.intensity) == stays


def test_dark_targets_are_lost_beyond_the_range_at_10_percent() -> None:
    """Asphalt returns 0.12 times the loss by incidence: it is lost beyond about 40 m where a tenth is at 45 m."""
    scene, whole = RaycastScene(Primitives.empty(), make_ground()), make_quiet(lidar_spec("opv2v"))
    clouds = [scan(scene, HERE, spec, (0,))[0] for spec in (replace(whole, range_10_percent_m=45.0), whole)]
    behind = [cloud.xyz[cloud.xyz[:, 0] < 0].norm(dim=1).max() for cloud in clouds]  # without the paint
    assert 34 < float(behind[0]) < 45 < 60 < float(behind[1])


def test_nearer_returns_than_the_minimum_are_lost() -> None:
    scene, spec = RaycastScene(Primitives.empty(), make_ground()), make_quiet(lidar_spec("opv2v"))
    assert float(scan(scene, HERE, replace(spec, min_range_m=9.0), (0,))[0].xyz[:, :2].norm(dim=1).min()) > 8.7


def test_spurious_returns_come_from_the_air_and_have_no_instance() -> None:
    scene, clear = RaycastScene(Primitives.empty(), make_ground()), make_quiet(lidar_spec("opv2v-32"))
    rain, instance = scan(scene, HERE, replace(clear, spurious_fraction=0.1), (0,))
    above = (rain.xyz[:, 2] > 0.05).double().mean()
    assert 0.07 < float(above) < 0.11
    assert not instance.any()
    assert len(rain) >= len(scan(scene, HERE, clear, (0,))[0])


def test_a_sensor_of_fixed_pulses_has_fewer_azimuths_at_a_higher_rate() -> None:
    assert lidar_spec("os1-128").at_rate(20.0).per_turn == 1024
    assert lidar_spec("opv2v").at_rate(20.0).per_turn == 1016


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("per_turn = 9", "source needs a text"),
        ('source = "x"\nper_turn = 900\nbeam = 3', "unknown field 'beam'; choose from min_range_m"),
        ('source = "x"\nper_turn = 900', "units needs a list of one head or more"),
        ('source = "x"\nunits = [{ even = [[2, 0, 9]] }]', "give one of per_turn and azimuth_step_deg"),
        ('source = "x"\nper_turn = 900\nunits = [{ even = [[2, 0, 9]] }]\nintensity = "bright"', "No intensity law"),
        ('source = "x"\nper_turn = 900\nunits = [{ even = [[1, 0, 9]] }]', "even needs blocks"),
        ('source = "x"\nper_turn = 900\nunits = [{ elevations_deg = [1.0, 1.0] }]', "at least two beams, ascending"),
        ('source = "x"\nper_turn = 900\nunits = [{ even = [[2, 0, 9]] }]\nheight_m = true', "height_m needs a finite"),
        ('source = "x"\nper_turn = 900\nunits = [{ even = [[2, 0, 9]] }]\nheight_m = 99.0', "height_m needs 0.3 … 20"),
        ('like = "b"', "like needs the name of a row without like"),
    ],
)
def test_an_error_names_the_file_the_row_and_the_field(row: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"lidars\.toml, \[mine\]: .*{message}"):
        read_lidars(f"[mine]\n{row}\n")


def test_what_is_not_toml_is_named() -> None:
    with pytest.raises(ConfigError, match=r"lidars\.toml: expected TOML"):
        read_lidars("[mine")


def test_beams_are_spread_evenly() -> None:
    assert np.degrees(spread_beams(5, -4, 4).elevation) == pytest.approx([-4, -2, 0, 2, 4])
