# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera on an agent, and what it took."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.transform import Transform


@dataclass(frozen=True)
class Camera:
    """A pinhole without distortion.

    intrinsic: (3, 3) float64, pixels; the pixel of column c and row r covers c … c + 1 and r … r + 1, its centre is at + 0.5.
    agent_from_camera: float64; the camera's frame has x to the right, y down and z ahead. width, height: of its images.
    """

    intrinsic: Tensor
    agent_from_camera: Transform
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.intrinsic.shape != (3, 3) or self.agent_from_camera.translation.shape != (3,):
            raise ShapeError(
                "Camera needs intrinsic (3, 3) and one agent_from_camera; got "
                f"{tuple(self.intrinsic.shape)} and {tuple(self.agent_from_camera.translation.shape)}."
            )
        if self.width < 1 or self.height < 1:
            raise ShapeError(f"Camera needs width and height of at least one pixel; got {self.width} x {self.height}.")

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (..., N, 3) of the agent's frame to pixels (..., N, 2), u to the right and v down, and depths (..., N)
        in metres.

        Where the depth is not positive the point is behind the camera, and its pixel means nothing.
        """
        local = self.agent_from_camera.inverse().apply(points)
        scaled = local @ self.intrinsic.to(points.dtype).mT
        return scaled[..., :2] / scaled[..., 2:], local[..., 2]

    def rays(self) -> Tensor:
        """Return (height, width, 3) float64: through each pixel's centre, in the agent's axes, of depth one."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float64) + 0.5,
            torch.arange(self.width, dtype=torch.float64) + 0.5,
            indexing="ij",
        )
        pixel = torch.stack((u, v, torch.ones_like(u)), -1)
        return pixel @ torch.linalg.inv(self.intrinsic.double()).mT @ self.agent_from_camera.rotation.double().mT

    def resize(self, width: int, height: int) -> Camera:
        """Return the same view on another number of pixels."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=self.intrinsic.dtype)
        return Camera(scale[:, None] * self.intrinsic, self.agent_from_camera, width, height)


@dataclass(frozen=True)
class CameraImage:
    """One picture. rgb: (3, height, width) uint8, sRGB."""

    camera: Camera
    rgb: Tensor

    def __post_init__(self) -> None:
        expected = (3, self.camera.height, self.camera.width)
        if self.rgb.shape != expected or self.rgb.dtype != torch.uint8:
            raise ShapeError(f"CameraImage.rgb needs {expected} uint8; got {tuple(self.rgb.shape)} {self.rgb.dtype}.")

    def moved(self, new_from_agent: Transform) -> CameraImage:
        """Return the same picture in a new frame of the agent."""
        camera = replace(self.camera, agent_from_camera=new_from_agent @ self.camera.agent_from_camera)
        return replace(self, camera=camera)
