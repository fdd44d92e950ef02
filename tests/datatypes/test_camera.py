# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from manyeyes.datatypes import Camera, CameraImage, ShapeError, Transform

# Two metres above the agent's origin, looking along its y axis: right is the agent's x, down its -z, ahead its y.
FACING_LEFT = Transform(
    torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64),
    torch.tensor([0.0, 0, 2], dtype=torch.float64),
)
INTRINSIC = torch.tensor([[100.0, 0, 40], [0, 50, 30], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(INTRINSIC, FACING_LEFT, 80, 60)


def test_a_point_projects_as_in_the_drawing() -> None:
    #   3 m to the agent's right-hand side of the axis, 1 m below the camera, 10 m ahead of it
    pixel, depth = CAMERA.project(torch.tensor([[3.0, 10, 1], [0, 5, 2], [0, -5, 2]], dtype=torch.float64))
    assert pixel[:2].tolist() == [[40 + 100 * 0.3, 30 + 50 * 0.1], [40, 30]]
    assert depth.tolist() == [10, 5, -5]


def test_points_on_a_pixels_ray_project_to_its_centre() -> None:
    rays = CAMERA.rays()
    points = FACING_LEFT.translation + rays * torch.linspace(0.5, 90, 60 * 80, dtype=torch.float64).reshape(60, 80, 1)
    pixel, depth = CAMERA.project(points)
    row, column = torch.meshgrid(torch.arange(60), torch.arange(80), indexing="ij")
    torch.testing.assert_close(pixel, torch.stack((column, row), -1) + 0.5, check_dtype=False)
    torch.testing.assert_close(depth.flatten(), torch.linspace(0.5, 90, 60 * 80, dtype=torch.float64))


def test_resizing_keeps_the_view() -> None:
    point = torch.tensor([[1.0, 7, 0]], dtype=torch.float64)
    small = CAMERA.resize(40, 20)
    torch.testing.assert_close(
        small.project(point)[0], CAMERA.project(point)[0] / torch.tensor([2.0, 3.0], dtype=torch.float64)
    )
    assert (small.width, small.height) == (40, 20)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match=r"intrinsic \(3, 3\).*got \(2, 3\)"):
        Camera(INTRINSIC[:2], FACING_LEFT, 80, 60)
    with pytest.raises(ShapeError, match="got 80 x 0"):
        Camera(INTRINSIC, FACING_LEFT, 80, 0)
    with pytest.raises(ShapeError, match=r"needs \(3, 60, 80\) uint8; got \(3, 60, 80\) torch.float32"):
        CameraImage(CAMERA, torch.zeros(3, 60, 80))
