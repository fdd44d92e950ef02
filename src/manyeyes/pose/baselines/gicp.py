# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP of whole clouds from the prior pose, by small-gicp (extra 'icp').

Koide, JOSS 9(100), 2024; Segal et al., RSS 2009.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from manyeyes.datatypes import MissingExtraError, PointCloud, Transform
from manyeyes.pose.corrector import mahalanobis_squared
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, no_estimate, project_to_se2


@dataclass(frozen=True)
class GicpConfig:
    """voxel_m: edge of the voxels of downsampling; max_correspondence_m: largest distance of a pair of points;
    min_inlier_fraction: of the other's points. sigma_m, sigma_yaw_rad: standard deviations of an estimate.
    """

    voxel_m: float = 0.5
    max_correspondence_m: float = 2.0
    min_inlier_fraction: float = 0.3
    sigma_m: float = 0.1
    sigma_yaw_rad: float = 0.005


@register_pose_corrector("gicp", "clouds")
def correct(
    ego: PointCloud, other: PointCloud, prior: PosePrior | None, config: GicpConfig | None = None
) -> PoseEstimate:
    """Return the best fit of the clouds near the prior, in six degrees of freedom; NO_MATCH without a prior or without
    overlap.
    """
    config = config or GicpConfig()
    gicp = _small_gicp()
    if prior is None or min(len(ego), len(other)) < 3:
        return no_estimate(prior)
    target, source = (gicp.voxelgrid_sampling(c.xyz.double().numpy(), config.voxel_m) for c in (ego, other))
    found = gicp.align(
        target.points()[:, :3],
        source.points()[:, :3],
        init_T_target_source=prior.ego_from_other.matrix().double().numpy(),
        registration_type="GICP",
        downsampling_resolution=config.voxel_m,
        max_correspondence_distance=config.max_correspondence_m,
        num_threads=1,
    )
    if not found.converged or found.num_inliers < config.min_inlier_fraction * source.size():
        return no_estimate(prior)
    pose = Transform.from_matrix(torch.from_numpy(np.asarray(found.T_target_source)))
    flat, covariance = project_to_se2(pose), np.diag([config.sigma_m**2, config.sigma_m**2, config.sigma_yaw_rad**2])
    distance = mahalanobis_squared(flat, covariance, prior)
    none, status = np.zeros((0, 2), np.int64), PoseStatus.CORRECTED
    return PoseEstimate(pose, covariance, status, int(found.num_inliers), 0, 0.0, none, flat, covariance, distance)


def _small_gicp() -> Any:
    try:
        return importlib.import_module("small_gicp")
    except ImportError as error:
        raise MissingExtraError("icp", "ICP on clouds") from error
