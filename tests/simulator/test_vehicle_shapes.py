# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from manyeyes.datatypes import VEHICLE_LABELS, Boxes, ConfigError, Transform
from manyeyes.simulator.scene.vehicle_shapes import (
    box_centers,
    make_vehicle_shape,
    place_vehicle_shapes,
    rotation_from_yaw_pitch,
)

SIZES = {"car": (4.4, 1.8, 1.5), "van": (5.6, 2.0, 2.3), "truck": (8.5, 2.5, 3.3), "bus": (12.0, 2.55, 3.2)}


@pytest.mark.parametrize("kind", VEHICLE_LABELS)
def test_every_part_lies_in_the_box_and_the_parts_reach_its_sides(kind: str) -> None:
    for id in range(60):
        body = make_vehicle_shape(kind, SIZES[kind], 3, id)
        low, high = body.center - body.half, body.center + body.half
        half = np.array(SIZES[kind]) / 2
        assert 3 <= len(body.center) <= 6
        assert (low >= np.array([-half[0], -half[1], 0]) - 1e-9).all()
        assert (high <= np.array([half[0], half[1], 2 * half[2]]) + 1e-9).all()
        assert (body.half > 0).all()
        np.testing.assert_allclose(high.max(0), [half[0], half[1], 2 * half[2]], atol=1e-9)
        np.testing.assert_allclose(low.min(0), [-half[0], -half[1], 0], atol=1e-9)
        assert ((body.reflectivity > 0) & (body.reflectivity <= 0.95)).all()


def test_the_same_vehicle_has_the_same_body_and_others_differ() -> None:
    one, same, other = (make_vehicle_shape("car", SIZES["car"], 1, id) for id in (5, 5, 6))
    np.testing.assert_array_equal(one.center, same.center)
    assert np.abs(one.center - other.center).max() > 1e-3


def test_parts_stay_in_the_box_on_a_slope() -> None:
    yaw, pitch, position = np.array([0.7]), np.array([-0.1]), np.array([[3.0, 4.0, 1.0]])
    solids = place_vehicle_shapes([make_vehicle_shape("van", SIZES["van"], 0, 9)], position, yaw, pitch, np.array([9]))
    assert set(solids.instance.tolist()) == {9}
    unit = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (solids.rotation[:, None] @ (unit * solids.half[:, None])[..., None])[..., 0] + solids.center[:, None]
    center = torch.from_numpy(box_centers(position, yaw, pitch, np.array([SIZES["van"][2]])))
    box = Boxes.of(center, torch.tensor([SIZES["van"]], dtype=torch.float64), torch.from_numpy(yaw))
    world_from_van = Transform(torch.from_numpy(rotation_from_yaw_pitch(yaw, pitch)[0]), torch.from_numpy(position[0]))
    local = world_from_van.inverse().apply(torch.from_numpy(corners.reshape(-1, 3)))
    assert bool(box.transform(world_from_van.inverse()).contains(local, 1e-6).all())
    assert corners[..., 2].max() > 1.0 + SIZES["van"][2] + 0.1  # the nose points uphill


def test_rotation_is_that_of_from_rpy() -> None:
    angle = torch.tensor([0.3, -2.0], dtype=torch.float64)
    wanted = Transform.from_rpy(torch.zeros(2, 3, dtype=torch.float64), 0 * angle, angle / 4, angle).rotation
    np.testing.assert_allclose(rotation_from_yaw_pitch(angle.numpy(), angle.numpy() / 4), wanted.numpy(), atol=1e-12)


def test_an_unknown_kind_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="'tram'; choose one of car, van, truck, bus"):
        make_vehicle_shape("tram", (4, 2, 1), 0, 0)


def test_no_vehicles_are_no_solids() -> None:
    none = np.zeros(0)
    solids = place_vehicle_shapes([], np.zeros((0, 3)), none, none, np.zeros(0, np.int64))
    assert len(solids) == 0
