# SPDX-License-Identifier: Apache-2.0
"""Point cloud of one LiDAR sweep."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes._point_kernels import keep_points, scale_points
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.numbers import Numbers, as_tensor
from manyeyes.datatypes.transform import Transform, is_plain


@dataclass(frozen=True)
class PointCloud:
    """N returns of one sweep.

    xyz: (N, 3) float32, metres, in the frame of the object that holds the cloud (right-handed, z up).
    intensity: (N,) float32 in [0, 1]. time_s: (N,) float32, seconds relative to the frame's time stamp.
    """

    xyz: Tensor
    intensity: Tensor
    time_s: Tensor

    def __post_init__(self) -> None:
        n = self.xyz.shape[0]
        if self.xyz.shape != (n, 3) or self.intensity.shape != (n,) or self.time_s.shape != (n,):
            raise ShapeError(
                "PointCloud needs xyz (N, 3), intensity (N,), time_s (N,); got "
                f"{tuple(self.xyz.shape)}, {tuple(self.intensity.shape)}, {tuple(self.time_s.shape)}."
            )

    @classmethod
    def of(cls, xyz: Numbers, intensity: Numbers | None = None, time_s: Numbers | None = None) -> PointCloud:
        """Build a cloud from tensors or numpy arrays of any number type; intensity and time default to zero.

        Args:
            xyz: (N, 3), metres. intensity: (N,) in [0, 1]. time_s: (N,), seconds.

        Raises:
            ShapeError: another shape, or points that are NaN or infinite as float32.
        """
        points = as_tensor(xyz, "PointCloud.xyz", torch.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ShapeError(f"PointCloud.of needs xyz (N, 3); got {tuple(points.shape)}: pass x, y, z columns alone.")
        # The sum is a cheap first check: where it is finite, every point is.
        if not math.isfinite(float(points.sum())) and not bool(torch.isfinite(points).all()):
            bad = int((~torch.isfinite(points).all(-1)).sum())
            raise ShapeError(
                f"{bad} of {points.shape[0]} points are NaN or infinite; drop them before building a PointCloud."
            )
        zeros = torch.zeros(points.shape[0])
        return cls(
            points,
            zeros if intensity is None else as_tensor(intensity, "PointCloud.intensity", torch.float32),
            zeros if time_s is None else as_tensor(time_s, "PointCloud.time_s", torch.float32),
        )

    def __len__(self) -> int:
        return self.xyz.shape[0]

    def __getitem__(self, index: Tensor | slice) -> PointCloud:
        if isinstance(index, Tensor) and index.dtype == torch.bool:
            if index.shape == self.intensity.shape and all(map(is_plain, (self.xyz, self.intensity, self.time_s))):
                xyz, intensity, time_s = (t.contiguous().numpy() for t in (self.xyz, self.intensity, self.time_s))
                kept = keep_points(xyz, intensity, time_s, index.contiguous().numpy())
                return PointCloud(*map(torch.from_numpy, kept))
            index = index.nonzero()[:, 0]  # once instead of for each field
            return PointCloud(*(field.index_select(0, index) for field in (self.xyz, self.intensity, self.time_s)))
        return PointCloud(self.xyz[index], self.intensity[index], self.time_s[index])

    def transform(self, target_from_source: Transform) -> PointCloud:
        """Return the same returns in another frame."""
        return PointCloud(target_from_source.apply(self.xyz), self.intensity, self.time_s)

    def scale(self, factors: tuple[float, float, float]) -> PointCloud:
        """Return the same returns with x, y and z multiplied by factors."""
        if is_plain(self.xyz):
            scaled = torch.from_numpy(scale_points(self.xyz.contiguous().numpy(), *factors))
        else:
            scaled = self.xyz * self.xyz.new_tensor(factors)
        return PointCloud(scaled, self.intensity, self.time_s)

    @classmethod
    def cat(cls, clouds: list[PointCloud]) -> PointCloud:
        """Return several clouds of one frame as one."""
        return cls(
            torch.cat([c.xyz for c in clouds]),
            torch.cat([c.intensity for c in clouds]),
            torch.cat([c.time_s for c in clouds]),
        )
