# SPDX-License-Identifier: Apache-2.0
"""What a LiDAR returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.transform import Transform


@dataclass(frozen=True)
class PointCloud:
    """N returns of one sweep.

    xyz: (N, 3) float32, metres, in the frame of whoever holds the cloud (right-handed, z up).
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
    def of(cls, xyz: Tensor, intensity: Tensor | None = None, time_s: Tensor | None = None) -> PointCloud:
        """A cloud from points alone: intensity and time default to zero. NaN or infinite points are refused."""
        xyz = xyz.to(torch.float32)
        if not bool(torch.isfinite(xyz).all()):
            bad = int((~torch.isfinite(xyz).all(-1)).sum())
            raise ShapeError(
                f"{bad} of {xyz.shape[0]} points are NaN or infinite; drop them before building a PointCloud."
            )
        zeros = torch.zeros(xyz.shape[0])
        return cls(xyz, zeros if intensity is None else intensity.float(), zeros if time_s is None else time_s.float())

    def __len__(self) -> int:
        return self.xyz.shape[0]

    def __getitem__(self, index: Tensor | slice) -> PointCloud:
        return PointCloud(self.xyz[index], self.intensity[index], self.time_s[index])

    def transform(self, target_from_source: Transform) -> PointCloud:
        """The same returns in another frame."""
        return PointCloud(target_from_source.apply(self.xyz), self.intensity, self.time_s)

    @classmethod
    def cat(cls, clouds: list[PointCloud]) -> PointCloud:
        """Several clouds of one frame as one."""
        return cls(
            torch.cat([c.xyz for c in clouds]),
            torch.cat([c.intensity for c in clouds]),
            torch.cat([c.time_s for c in clouds]),
        )
