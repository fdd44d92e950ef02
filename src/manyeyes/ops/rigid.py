# SPDX-License-Identifier: Apache-2.0
"""The rigid motion that best carries one set of points onto another: weighted least squares in the plane and in space.

min over R, t of sum_n w_n |R p_n + t - q_n|^2, without scale, and with R a rotation even where a reflection would fit
better. Source: FeaKM, Eq. 6 (which writes it as a pseudo-inverse); Kabsch, Acta Cryst. A34, 1978; Umeyama, IEEE TPAMI
13(4), 1991, whose determinant rule refuses the reflection. In the plane the optimum is one arc tangent.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.datatypes import ShapeError, Transform


def fit_se2(source: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """target_from_source as x, y, yaw (..., 3), from points (..., N, 2) and optional weights (..., N) >= 0.

    Differentiable wherever the answer is determined. Where all points (of positive weight) coincide the yaw is 0; where
    there is none, the motion is the identity.
    """
    weight = _weights(source, target, weight, 2)
    p_mean, q_mean = _mean(source, weight), _mean(target, weight)
    p, q = source - p_mean, target - q_mean
    sine = (weight * (p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])).sum(-1)
    cosine = (weight * (p * q).sum(-1)).sum(-1)
    yaw = torch.atan2(sine, cosine)
    c, s = yaw.cos(), yaw.sin()
    x, y = p_mean[..., 0, 0], p_mean[..., 0, 1]
    turned = torch.stack((c * x - s * y, s * x + c * y), -1)
    return torch.cat((q_mean[..., 0, :] - turned, yaw[..., None]), -1)


def fit_rigid(source: Tensor, target: Tensor, weight: Tensor | None = None) -> Transform:
    """target_from_source from points (..., N, 3) and optional weights (..., N) >= 0.

    Needs three points that are not on one line: with fewer, one of the equally good motions is returned. Differentiable
    where the singular values of the covariance differ and at most one is zero.
    """
    weight = _weights(source, target, weight, 3)
    p_mean, q_mean = _mean(source, weight), _mean(target, weight)
    covariance = (target - q_mean).mT @ (weight[..., None] * (source - p_mean))
    u, _, vt = torch.linalg.svd(covariance)
    sign = torch.det(u @ vt).detach().sign()
    flip = torch.stack((torch.ones_like(sign), torch.ones_like(sign), sign), -1)
    rotation = (u * flip[..., None, :]) @ vt
    return Transform(rotation, q_mean[..., 0, :] - (rotation @ p_mean.mT)[..., 0])


def _weights(source: Tensor, target: Tensor, weight: Tensor | None, axes: int) -> Tensor:
    if source.shape != target.shape or source.ndim < 2 or source.shape[-1] != axes:
        raise ShapeError(
            f"A fit needs two sets of points (..., N, {axes}); got {tuple(source.shape)}, {tuple(target.shape)}."
        )
    if weight is None:
        return torch.ones(source.shape[:-1], dtype=source.dtype, device=source.device)
    if weight.shape != source.shape[:-1]:
        raise ShapeError(f"A fit's weights are {tuple(source.shape[:-1])}, one a point; got {tuple(weight.shape)}.")
    return weight


def _mean(points: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean (..., 1, D) of points (..., N, D); zero where no weight is."""
    total = weight.sum(-1)[..., None, None]
    return (weight[..., None] * points).sum(-2, keepdim=True) / torch.where(total > 0, total, 1.0)
