# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from manyeyes.datatypes import LABELS, Boxes, Camera, ConfigError, Transform
from manyeyes.ops.raycast import BOX, HeightField, Primitives
from manyeyes.simulator.scene.scenario import true_boxes
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.sensors.camera import CAMERA_RIGS, CameraSpec, LitScene, RenderedImage, camera_rig, render_image
from manyeyes.simulator.sensors.lidar import ASPHALT, PAINT, RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import LidarSpec
from manyeyes.simulator.sensors.lighting import Light
from manyeyes.simulator.sensors.materials import Materials, make_static_materials, make_vehicle_materials

HERE = Transform.from_xyz_yaw(3.0, -2.0, 0.0, 0.3)
RIG = CAMERA_RIGS["opv2v-small"]
FRONT = replace(RIG[0], samples=1)


def light(sun: tuple[float, float, float] = (0.6, 0.0, 0.8)) -> Light:
    white = np.ones(3, np.float32)
    return Light(np.array(sun), 2 * white, 0.4 * white, 0.5 * white, 0.2, 0.0, 0.0, 5)


def ground() -> HeightField:
    surface = np.full((1600, 1600), ASPHALT, np.uint8)
    surface[:, 860:862] = PAINT
    return HeightField(np.zeros((401, 401), np.float32), surface, -100.0, -100.0, 0.5, 0.125)


def vehicles(*places: tuple[float, float, float], kind: int = 0, size=(4.4, 1.8, 1.5)) -> VehicleStates:
    n = len(places)
    position = np.array([[x, y, 0.0] for x, y, _ in places]).reshape(n, 3)
    return VehicleStates(
        np.arange(1, n + 1), np.full(n, kind), position, np.array([p[2] for p in places]), np.zeros(n), np.zeros(n),
        np.tile(np.array(size), (n, 1)).reshape(n, 3),
    )  # fmt: skip


def make_lit_scene(states: VehicleStates, extra: Primitives | None = None, sun=(0.6, 0.0, 0.8)) -> LitScene:
    bodies = {
        int(i): make_vehicle_shape(LABELS[int(k)], tuple(s), 0, int(i))
        for i, k, s in zip(states.id, states.kind, states.size)
    }
    still = Primitives.empty() if extra is None else extra
    moving = place_vehicle_shapes(list(bodies.values()), states.position, states.yaw, states.pitch, states.id)
    materials = Materials.cat([make_static_materials(still, 0), make_vehicle_materials(states, bodies, 0)])
    return LitScene.of(RaycastScene(Primitives.cat([still, moving]), ground()), materials, light(sun))


def block(center, half, instance=0) -> Primitives:
    one = np.ones(1)
    return Primitives(
        np.array([BOX], np.uint8), np.array([center], float), np.eye(3)[None], np.array([half], float), 0 * one,
        np.array([instance]), 0.5 * one,
    )  # fmt: skip


def corners(boxes: Boxes) -> torch.Tensor:
    """(N, 8, 3), spelt out."""
    unit = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=torch.float64) / 2
    local = unit * boxes.size[:, None]
    c, s = boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None]
    turned = torch.stack(
        (c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1], local[..., 2]), -1
    )
    return boxes.center[:, None] + turned


def in_hull(hull: ConvexHull, points: np.ndarray) -> np.ndarray:
    """(N,) how far points lie outside, pixels; negative inside."""
    return (points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(1)


def pixels_of(picture: RenderedImage, instance: int) -> np.ndarray:
    """(N, 2) middles of the pixels that show an instance, u and v. Of four rays the first one, a quarter before the middle."""
    rows, columns = np.nonzero(picture.instance == instance)
    return np.stack((columns, rows), -1) + 0.5


# Places (in the world) before each of the four cameras of a vehicle at HERE, by yaw from the agent's heading.
@pytest.mark.parametrize("number", range(4))
def test_corners_of_a_box_land_on_its_silhouette_within_a_pixel(number: int) -> None:
    spec = replace(RIG[number], samples=1)
    for distance, aside, yaw in ((7.0, 0.1, 0.4), (15.0, -0.5, 1.3), (30.0, 0.4, -0.8)):
        angle = 0.3 + spec.yaw_rad + aside
        place = (3.0 + distance * np.cos(angle), -2.0 + distance * np.sin(angle), yaw)
        boxes = true_boxes(vehicles(place))
        whole = Boxes.of(boxes.center, boxes.size, boxes.yaw, id=boxes.id)
        solid = block((0, 0, 0), (2.2, 0.9, 0.75), 1)
        c, s = np.cos(yaw), np.sin(yaw)
        solid = replace(solid, center=boxes.center.numpy(), rotation=np.array([[[c, -s, 0], [s, c, 0], [0, 0, 1]]]))
        picture = render_image(
            LitScene.of(RaycastScene(solid, ground()), make_static_materials(solid, 0), light()), HERE, spec
        )
        pixel, depth = picture.image.camera.project(HERE.inverse().apply(corners(whole)[0]))
        assert bool((depth > 0).all())
        hull, shown = ConvexHull(pixel.numpy()), pixels_of(picture, 1)
        assert len(shown) > 40
        assert in_hull(hull, shown).max() < 1.0
        for vertex in pixel.numpy()[hull.vertices]:
            assert np.hypot(*np.maximum(np.abs(shown - vertex) - 0.5, 0).T).min() < 1.0  # to the pixel's square
        assert abs(len(shown) - hull.volume) < hull.area  # in the plane: surface and circumference


@pytest.mark.parametrize(
    ("kind", "size"), [(0, (4.4, 1.8, 1.5)), (1, (5.5, 2.0, 2.3)), (2, (8.0, 2.5, 3.2)), (3, (11.0, 2.5, 3.1))]
)
def test_a_vehicle_is_shown_as_far_as_its_solids_reach_and_within_its_box(kind: int, size: tuple) -> None:
    seen = make_lit_scene(vehicles((18.0, 4.0, 1.0), kind=kind, size=size))
    picture = render_image(seen, HERE, FRONT)
    shown, camera = pixels_of(picture, 1), picture.image.camera
    box = corners(true_boxes(vehicles((18.0, 4.0, 1.0), kind=kind, size=size)))[0]
    assert in_hull(ConvexHull(camera.project(HERE.inverse().apply(box))[0].numpy()), shown).max() < 1.0
    solids = seen.scene.solids
    unit = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    reach = solids.center[:, None] + np.einsum("nij,nkj->nki", solids.rotation, unit * solids.half[:, None])
    pixel = camera.project(HERE.inverse().apply(torch.from_numpy(reach.reshape(-1, 3))))[0].numpy()
    np.testing.assert_allclose(shown.min(0) - 0.5, pixel.min(0), atol=1.0)
    np.testing.assert_allclose(shown.max(0) + 0.5, pixel.max(0), atol=1.0)


@pytest.mark.slow
def test_camera_and_lidar_at_one_pose_hit_the_same_objects() -> None:
    wall = block((20.0, 8.0, 1.0), (0.3, 4.0, 1.0))
    scene = make_lit_scene(vehicles((12.0, -3.0, 0.4), (26.0, 5.0, 0.0), (30.0, -6.0, 1.0)), wall)
    spec = replace(FRONT, x_m=0.0, z_m=1.9, width=800, height=600, cx=400.0, cy=300.0, fx=335.6, fy=335.6)
    picture = render_image(scene, HERE, spec)
    quiet = LidarSpec(per_turn=900, drop_general=0, drop_dark=0, drop_grazing=0, range_sigma_m=0)
    cloud, instance = scan(scene.scene, HERE, quiet, (0,))
    pixel, depth = picture.image.camera.project(cloud.xyz.double())
    inside = (depth > 1) & (pixel > 1).all(1) & (pixel[:, 0] < 799) & (pixel[:, 1] < 599)
    column, row = pixel[inside].long().T.numpy()
    same = picture.instance[row, column] == instance[inside.numpy()]
    assert set(np.unique(instance[inside.numpy()])) == {0, 1, 2, 3}
    assert same.mean() > 0.99
    near = np.abs(picture.depth_m[row, column] - depth[inside].numpy()) < 0.02 * depth[inside].numpy() + 0.05
    assert near.mean() > 0.96


def brightness(picture: RenderedImage, *points: tuple[float, float, float]) -> list[float]:
    """Mean of nine pixels about points of the world."""
    world = torch.tensor(points, dtype=torch.float64)
    pixel, _ = picture.image.camera.project(HERE.inverse().apply(world))
    grey = picture.image.rgb.float().mean(0)
    return [float(grey[v - 1 : v + 2, u - 1 : u + 2].mean()) for u, v in pixel.long().tolist()]


def test_solids_cast_shadows_away_from_the_sun() -> None:
    # The sun stands to the left of the picture's wall, 37 degrees from the zenith: the shadow of its top falls 0.75 of its
    # height to the right.
    wall = block((12.0, 2.0, 2.0), (1.0, 0.1, 2.0))
    to_the_right = render_image(make_lit_scene(vehicles(), wall, (0.0, 0.6, 0.8)), HERE, FRONT)
    shade, sunny = brightness(to_the_right, (12.0, 0.8, 0.0), (12.0, -1.6, 0.0))
    assert shade < 0.75 * sunny
    to_the_left = render_image(make_lit_scene(vehicles(), wall, (0.0, -0.6, 0.8)), HERE, FRONT)
    assert brightness(to_the_left, (12.0, 0.8, 0.0))[0] == pytest.approx(sunny, rel=0.15)


def test_the_own_vehicle_is_invisible_but_casts_a_shadow() -> None:
    scene = make_lit_scene(vehicles((3.0, -2.0, 0.3)), sun=(-0.8, 0.0, 0.6))
    back = replace(RIG[3], samples=1)
    carrier, without_carrier = (
        render_image(scene, HERE, back, own=1),
        render_image(make_lit_scene(vehicles()), HERE, back),
    )
    assert (carrier.instance == 0).all()
    assert np.array_equal(carrier.depth_m, without_carrier.depth_m)
    front = render_image(scene, HERE, replace(FRONT, x_m=0.0, pitch_rad=0.8), own=1)
    shade, sunny = brightness(front, (5.58, -1.2, 0.0), (9.0, -0.2, 0.0))
    assert shade < 0.75 * sunny


def test_paint_is_brighter_than_the_road_and_lies_where_the_raster_has_it() -> None:
    picture = render_image(make_lit_scene(vehicles()), HERE, FRONT)
    line, left, right = brightness(picture, (7.625, -0.9, 0.0), (7.2, -0.9, 0.0), (8.1, -0.9, 0.0))
    assert line > 1.4 * max(left, right)


def test_rendering_is_deterministic_and_converges_with_finer_rays() -> None:
    scene = make_lit_scene(vehicles((12.0, -3.0, 0.4), (26.0, 5.0, 0.0)))
    one, two = render_image(scene, HERE, FRONT), render_image(scene, HERE, FRONT)
    assert torch.equal(one.image.rgb, two.image.rgb)
    fine = render_image(scene, HERE, RIG[0])
    assert not torch.equal(one.image.rgb, fine.image.rgb)
    assert float((one.image.rgb.float() - fine.image.rgb.float()).abs().mean()) < 3.0


def test_opv2vs_cameras_look_ahead_right_left_and_back() -> None:
    ahead = [spec.camera.agent_from_camera.rotation[:, 2] for spec in CAMERA_RIGS["opv2v"]]
    headings = [round(float(torch.rad2deg(torch.atan2(d[1], d[0])))) for d in ahead]
    assert headings[:3] == [0, -100, 100]
    assert abs(headings[3]) == 180
    places = [spec.camera.agent_from_camera.translation.tolist() for spec in CAMERA_RIGS["opv2v"]]
    assert places == [[2.5, 0, 1], [0, -0.3, 1.8], [0, 0.3, 1.8], [-2, 0, 1.5]]
    pole = CAMERA_RIGS["dair-infrastructure-small"][0].camera
    assert float(pole.agent_from_camera.rotation[2, 2]) == pytest.approx(-np.sin(np.deg2rad(11)))
    for spec in (s for rig in CAMERA_RIGS.values() for s in rig):
        rotation = spec.camera.agent_from_camera.rotation
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64))
        assert float(torch.det(rotation)) == pytest.approx(1)
        assert float(rotation[2, 0]) == 0  # upright: its right is level


def test_images_of_another_size_show_the_same() -> None:
    one, two = FRONT.camera, FRONT.resized(800, 600).camera
    point = torch.tensor([[9.0, 1.0, 0.3]], dtype=torch.float64)
    torch.testing.assert_close(2 * one.project(point)[0], two.project(point)[0])
    assert isinstance(one, Camera)


def test_rows_cut_off_above_move_nothing_below() -> None:
    cut = FRONT.below(30)
    point = torch.tensor([[9.0, 1.0, 0.3]], dtype=torch.float64)
    shift = FRONT.camera.project(point)[0] - cut.camera.project(point)[0]
    torch.testing.assert_close(shift, torch.tensor([[0.0, 30.0]], dtype=torch.float64))
    assert cut.height == FRONT.height - 30 and cut.width == FRONT.width


def test_invalid_values_are_named() -> None:
    with pytest.raises(ConfigError, match="No cameras 'opv'; choose one of none, opv2v"):
        camera_rig("opv")
    with pytest.raises(ConfigError, match="positive focal lengths"):
        CameraSpec(0.0, 1.0, 1.0, 1.0, 2, 2)
