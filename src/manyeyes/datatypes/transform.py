# SPDX-License-Identifier: Apache-2.0
"""Batched rigid motions, named target_from_source so that inner names cancel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes._point_kernels import move_points
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.numbers import Numbers, as_tensor


@dataclass(frozen=True)
class Transform:
    """A rigid motion: ``p_target = rotation @ p_source + translation``.

    rotation: (..., 3, 3), orthonormal; translation: (..., 3), metres. Poses are kept in float64, because world
    coordinates reach kilometres; :meth:`apply` works in the dtype of the points it is given.
    """

    rotation: Tensor
    translation: Tensor

    def __post_init__(self) -> None:
        if self.rotation.shape[-2:] != (3, 3) or self.translation.shape != self.rotation.shape[:-1]:
            raise ShapeError(
                "Transform needs rotation (..., 3, 3) and translation (..., 3); "
                f"got {tuple(self.rotation.shape)} and {tuple(self.translation.shape)}."
            )

    @classmethod
    def identity(cls, *batch: int, dtype: torch.dtype = torch.float64) -> Transform:
        """Return the identity motion of a batch shape."""
        return cls(torch.eye(3, dtype=dtype).expand(*batch, 3, 3), torch.zeros(*batch, 3, dtype=dtype))

    @classmethod
    def from_matrix(cls, matrix: Numbers) -> Transform:
        """Build poses from homogeneous matrices (..., 4, 4), tensors or numpy arrays of any number type; kept in float64.

        Raises:
            ShapeError: another shape, NaN or infinite entries, or an upper left block that is not a rotation.
        """
        pose = as_tensor(matrix, "Transform.from_matrix", torch.float64)
        if pose.shape[-2:] != (4, 4):
            raise ShapeError(f"A rigid motion is a (..., 4, 4) matrix; got {tuple(pose.shape)}.")
        if not bool(torch.isfinite(pose).all()):
            raise ShapeError("A rigid motion has finite entries; this matrix has NaN or infinite ones.")
        rotation = pose[..., :3, :3]
        eye = torch.eye(3, dtype=torch.float64)
        if not bool(((rotation @ rotation.mT - eye).abs() < 1e-3).all()) or not bool((torch.det(rotation) > 0).all()):
            raise ShapeError("The upper left 3x3 block is not a rotation (orthonormal, determinant +1).")
        return cls(rotation, pose[..., :3, 3])

    def double(self) -> Transform:
        """Return the same motion in float64."""
        if self.rotation.dtype == self.translation.dtype == torch.float64:
            return self
        return Transform(self.rotation.double(), self.translation.double())

    @classmethod
    def from_rpy(cls, translation: Tensor, roll: Tensor, pitch: Tensor, yaw: Tensor) -> Transform:
        """From intrinsic z-y-x angles in radians, right-handed: R = Rz(yaw) Ry(pitch) Rx(roll). Angles are (...)."""
        if all(a.dim() == 0 and a.dtype == torch.float64 and not a.requires_grad for a in (roll, pitch, yaw)):
            return cls(_rotate(torch.stack((roll, pitch, yaw))).to(translation.device), translation)
        cr, sr, cp, sp, cy, sy = roll.cos(), roll.sin(), pitch.cos(), pitch.sin(), yaw.cos(), yaw.sin()
        rows = (
            torch.stack((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr), -1),
            torch.stack((sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr), -1),
            torch.stack((-sp, cp * sr, cp * cr), -1),
        )
        return cls(torch.stack(rows, -2), translation)

    @classmethod
    def from_xyz_yaw(cls, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Transform:
        """Return one upright pose, float64."""
        return cls.from_angles((x, y, z), (0.0, 0.0, yaw))

    @classmethod
    def from_angles(cls, xyz: Sequence[float], rpy: Sequence[float] | Tensor) -> Transform:
        """Return one pose, float64, from numbers: place x, y, z, and roll, pitch, yaw as in :meth:`from_rpy`."""
        angles = torch.as_tensor(rpy, dtype=torch.float64)
        return cls(_rotate(angles), torch.tensor(xyz, dtype=torch.float64))

    @property
    def yaw(self) -> Tensor:
        """Heading of the source's x axis in the target frame, (...), radians in (-pi, pi]."""
        return torch.atan2(self.rotation[..., 1, 0], self.rotation[..., 0, 0])

    def matrix(self) -> Tensor:
        """Homogeneous form (..., 4, 4)."""
        bottom = self.rotation.new_zeros(*self.translation.shape[:-1], 1, 4)
        bottom[..., 0, 3] = 1
        return torch.cat((torch.cat((self.rotation, self.translation[..., None]), -1), bottom), -2)

    def inverse(self) -> Transform:
        """Return the inverse motion, source_from_target."""
        back = self.rotation.mT
        if back.dim() == 2:
            return Transform(back, back.mv(self.translation).neg())
        return Transform(back, -(back @ self.translation[..., None])[..., 0])

    def __matmul__(self, other: Transform) -> Transform:
        """a_from_b @ b_from_c = a_from_c, batches broadcast."""
        if self.rotation.dim() == other.rotation.dim() == 2:
            return Transform(self.rotation.mm(other.rotation), self.rotation.mv(other.translation) + self.translation)
        moved = (self.rotation @ other.translation[..., None])[..., 0] + self.translation
        rotation = self.rotation @ other.rotation
        return Transform(rotation.expand(*moved.shape[:-1], 3, 3), moved)

    def apply(self, points: Numbers) -> Tensor:
        """Transform points (..., N, 3) of the source frame to the target frame, dtype of the points; float64 of lists."""
        points = as_tensor(points, "Transform.apply", None)
        if points.shape[-1:] != (3,):
            raise ShapeError(f"Transform.apply needs points (..., N, 3); got {tuple(points.shape)}.")
        rotation, translation = self.rotation.to(points), self.translation.to(points)
        if points.dim() == rotation.dim() == 2 and is_plain(points) and is_plain(rotation) and is_plain(translation):
            # One sum on every processor, at any number of points; products of matrices round as their kernel does.
            rows = (points.contiguous(), rotation.contiguous(), translation.contiguous())
            return torch.from_numpy(move_points(*(row.numpy() for row in rows)))
        return points @ rotation.mT + translation[..., None, :]

    def __getitem__(self, index: int | slice | Tensor) -> Transform:
        return Transform(self.rotation[index], self.translation[index])

    @classmethod
    def stack(cls, transforms: list[Transform] | tuple[Transform, ...]) -> Transform:
        """Return several motions of equal batch shape as one, new leading axis."""
        return cls(torch.stack([t.rotation for t in transforms]), torch.stack([t.translation for t in transforms]))


def _rotate(rpy: Tensor) -> Tensor:
    """Return the rotation (3, 3) of roll, pitch and yaw (3,), float64 on the CPU.

    Products and sums are those of ``Transform.from_rpy``, on Python's numbers: same bits, a tenth of the time.
    """
    (cr, cp, cy), (sr, sp, sy) = rpy.cos().tolist(), rpy.sin().tolist()
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return torch.tensor(rows, dtype=torch.float64)


def is_plain(values: Tensor) -> bool:
    """Return whether compiled code may read the values: float32 on the CPU, no gradient, no subclass."""
    return type(values) is Tensor and values.dtype == torch.float32 and values.is_cpu and not values.requires_grad
