# SPDX-License-Identifier: Apache-2.0
"""FeaKM's corrector: a pose from matched keypoints, and a rule that compares it with the prior.

FeaKM section 4.2.2 and Eq. 6, whose pseudo-inverse notation means the rigid fit of ops/rigid.py. Two solvers share one
interface. `solve_with_ransac` is what the paper's public code does: RANSAC, and the computed pose replaces the prior wherever
enough pairs are inliers; the comparison of the paper's text is a setting. `solve_with_consensus` tries every two pairs, weights
positions and headings by their stated errors, requires a margin over the best distinct other pose, and compares with the prior
by a chi^2 test, as the default corrector does (corrector.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.models import pretrained
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig
from manyeyes.models.pose.matcher import KeypointBatch
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.rigid import fit_se2
from manyeyes.pose.baselines._common import fit_pose, make_estimate, pose_information
from manyeyes.pose.corrector import AcceptanceTest, decide
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import FEAKM, register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, no_estimate, pose_difference
from manyeyes.pose.voting import Candidate, transform_point

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Solver = Callable[[Landmarks, Landmarks, Ints, "PosePrior | None"], PoseEstimate]
"""Landmarks of ego and other, rows (P, 2) that the net matches, and the prior, to an estimate."""


@dataclass(frozen=True)
class RansacConfig:
    """min_pairs: inliers that are required, the paper's 4 or 8. sample_size, num_trials, max_residual_m: of RANSAC; seed: of its
    samples. significant_m, significant_deg: a prior that differs by less is kept; 0 in the public code.
    """

    min_pairs: int = 4
    sample_size: int = 3
    num_trials: int = 200
    max_residual_m: float = 0.8
    seed: int = 0
    significant_m: float = 0.0
    significant_deg: float = 0.0

    def __post_init__(self) -> None:
        if self.sample_size < 2 or self.min_pairs < self.sample_size or self.num_trials < 1:
            raise ConfigError("RansacConfig needs num_trials >= 1 and min_pairs >= sample_size >= 2.")


def solve_with_ransac(
    ego: Landmarks, other: Landmarks, pairs: Ints, prior: PosePrior | None, config: RansacConfig | None = None
) -> PoseEstimate:
    """Return the pose with the most inlier pairs; the prior where these are too few, or where it does not differ
    significantly.
    """
    config = config or RansacConfig()
    if len(pairs) < config.min_pairs:
        return no_estimate(prior)
    target, source = ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]]
    agree = _ransac(target, source, config)
    if agree.sum() < config.min_pairs:
        return no_estimate(prior)
    pose = fit_pose(target[agree], source[agree])
    estimate = make_estimate(ego, other, pose, pairs[agree], prior)
    if prior is None or max(config.significant_m, config.significant_deg) == 0:
        return estimate
    off = pose_difference(pose, prior.pose)
    is_insignificant = np.hypot(off[0], off[1]) < config.significant_m and abs(off[2]) < math.radians(
        config.significant_deg
    )
    if is_insignificant:
        return replace(estimate, ego_from_other=prior.ego_from_other, covariance=prior.covariance, status=PoseStatus.OK)
    return replace(estimate, status=PoseStatus.CONFLICT)


def _ransac(target: Floats, source: Floats, config: RansacConfig) -> NDArray[np.bool_]:
    """Return (P,) bool: inlier pairs of the best pose among random samples."""
    rng = keyed_generator(config.seed, "feakm ransac", len(target))
    drawn = rng.random((config.num_trials, len(target))).argsort(1)[:, : config.sample_size]
    poses = fit_se2(torch.from_numpy(source[drawn]), torch.from_numpy(target[drawn])).numpy()
    away = _residuals_m(poses, target, source)
    agree = away < config.max_residual_m
    # Most inliers first, ties by the residuals.
    fit_score = agree.sum(1) - np.where(agree, away, 0.0).sum(1) / (config.max_residual_m * (len(target) + 1))
    return agree[fit_score.argmax()]


def _residuals_m(poses: Floats, target: Floats, source: Floats) -> Floats:
    """Return (H, P) residuals in metres of pairs of positions (P, 2) under poses (H, 3)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = c * source[:, 0] - s * source[:, 1] + poses[:, :1] - target[:, 0]
    y = s * source[:, 0] + c * source[:, 1] + poses[:, 1:2] - target[:, 1]
    return np.hypot(x, y)


@dataclass(frozen=True)
class ConsensusConfig:
    """min_pairs: inliers that are required. min_pair_distance_m: two pairs nearer than this give no hypothesis. pair_gate: largest
    squared residual of a pair (3 degrees of freedom). chance_area_m2: see voting.py. max_refined: at most so many of the best
    distinct hypotheses are refined. min_separation_m, min_separation_rad: poses that differ by less are one. accept: limits of
    score and margin; with the shipped net, 0.5 % of 600 pairs of views of different scenes of the validation town score more.
    """

    min_pairs: int = 4
    min_pair_distance_m: float = 3.0
    pair_gate: float = 14.16
    chance_area_m2: float = 330.0
    max_refined: int = 16
    min_separation_m: float = 2.0
    min_separation_rad: float = 0.105
    accept: AcceptanceTest = field(default_factory=lambda: AcceptanceTest(min_score=15.0))

    def __post_init__(self) -> None:
        limits = (
            self.min_pair_distance_m,
            self.pair_gate,
            self.chance_area_m2,
            self.max_refined,
            self.min_separation_m,
            self.min_separation_rad,
        )
        if self.min_pairs < 2 or min(limits) <= 0:
            raise ConfigError("ConsensusConfig needs pairs >= 2 and limits above 0.")


def solve_with_consensus(
    ego: Landmarks, other: Landmarks, pairs: Ints, prior: PosePrior | None, config: ConsensusConfig | None = None
) -> PoseEstimate:
    """Return the pose of largest likelihood over all hypotheses of two pairs, compared with the prior as in corrector.py."""
    config = config or ConsensusConfig()
    if len(pairs) < config.min_pairs:
        return no_estimate(prior)
    found = _candidates(ego, other, pairs, config)
    if not found or len(found[0].pairs) < config.min_pairs:
        return replace(no_estimate(prior), inliers=len(found[0].pairs) if found else 0)
    return decide(found, prior, config.accept)


def _candidates(ego: Landmarks, other: Landmarks, pairs: Ints, config: ConsensusConfig) -> list[Candidate]:
    """Return the best pose and the best distinct other one, refined; every two pairs are a hypothesis."""
    a, b = ego[pairs[:, 0]], other[pairs[:, 1]]
    i, k = np.triu_indices(len(pairs), 1)
    long = np.minimum(*(np.hypot(*(x.xy[i] - x.xy[k]).T) for x in (a, b))) >= config.min_pair_distance_m
    i, k = i[long], k[long]
    if not len(i):
        return []
    ends = np.stack((i, k), 1)
    poses = fit_se2(torch.from_numpy(b.xy[ends]), torch.from_numpy(a.xy[ends])).numpy()
    scores = _gains(poses, a, b, config).sum(1)
    middle, found = b.xy.mean(0), list[Candidate]()
    for _ in range(config.max_refined):
        best = int(scores.argmax())
        if len(found) == 2 or not scores[best] > 0:
            break
        candidate = _refine(poses[best], a, b, pairs, config)
        # A hypothesis that is refined to a pose already found is not distinct.
        if candidate is not None and not any(_alike(candidate.pose[None], f.pose, middle, config)[0] for f in found):
            found.append(candidate)
        scores = np.where(_alike(poses, poses[best], middle, config), -np.inf, scores)
    return sorted(found, key=lambda c: -c.score)


def _alike(poses: Floats, pose: Floats, middle: Floats, config: ConsensusConfig) -> NDArray[np.bool_]:
    """Return (H,) bool: poses (H, 3) within the separation limits of one pose, measured at the objects' centroid."""
    apart = np.hypot(*(transform_point(poses, middle) - transform_point(pose[None], middle)).T)
    turn = np.abs(np.remainder(poses[:, 2] - pose[2] + np.pi, 2 * np.pi) - np.pi)
    return (apart < config.min_separation_m) & (turn < config.min_separation_rad)


def _misfits(poses: Floats, a: Landmarks, b: Landmarks) -> Floats:
    """Return (H, P) squared residuals of each pair's position and heading (modulo pi), 3 degrees of freedom."""
    place = np.square(_residuals_m(poses, a.xy, b.xy)) / (a.sigma_xy**2 + b.sigma_xy**2)
    turn = np.remainder(a.yaw - b.yaw - poses[:, 2:] + np.pi / 2, np.pi) - np.pi / 2
    return place + np.square(turn) / (a.sigma_yaw**2 + b.sigma_yaw**2)


def _gains(poses: Floats, a: Landmarks, b: Landmarks, config: ConsensusConfig) -> Floats:
    """Return (H, P) log-likelihood ratios against chance, never negative."""
    max_gain = np.log(config.chance_area_m2 / (2 * np.pi * (a.sigma_xy**2 + b.sigma_xy**2)))
    return np.maximum(max_gain - _misfits(poses, a, b) / 2, 0.0)


def _refine(pose: Floats, a: Landmarks, b: Landmarks, pairs: Ints, config: ConsensusConfig) -> Candidate | None:
    """Return the weighted fit on all inlier pairs, iterated until these no longer change; None for fewer than two."""
    weight = 1 / (a.sigma_xy**2 + b.sigma_xy**2)
    agree = np.zeros(len(pairs), bool)
    for _ in range(10):
        now = _misfits(pose[None], a, b)[0] < config.pair_gate
        if now.sum() < 2:
            return None
        if (now == agree).all():
            break
        agree = now
        pose = fit_pose(a.xy[agree], b.xy[agree], weight[agree])
    misfit = _misfits(pose[None], a, b)[0, agree]
    dof = 3 * int(agree.sum()) - 3
    rows = np.flatnonzero(agree)
    spread = np.linalg.inv(pose_information(a, b, pose, np.stack((rows, rows), 1)))
    covariance = np.asarray(spread * max(1.0, misfit.sum() / dof), np.float64)
    score = float(_gains(pose[None], a, b, config)[0, agree].sum())
    return Candidate(pose, (covariance + covariance.T) / 2, pairs[agree], score, float(misfit.sum()), dof)


@dataclass(frozen=True)
class FeakmCorrector:
    """A corrector on landmarks with descriptors: the net matches them, the solver computes the pose.

    Landmarks without descriptors are not matched.
    """

    net: FeakmNet
    solver: Solver

    @classmethod
    def of(cls, net: FeakmNet, min_pairs: int = 4) -> FeakmCorrector:
        """With the solver of the net's kind and the paper's minimum number of pairs, 4 or 8."""
        if isinstance(net.config.keypoints, DenseKeypointConfig):
            return cls(net, partial(solve_with_ransac, config=RansacConfig(min_pairs)))
        return cls(net, partial(solve_with_consensus, config=ConsensusConfig(min_pairs)))

    def __call__(self, ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
        """Estimate ego_from_other from matched descriptors."""
        if ego.descriptor is None or other.descriptor is None:
            return no_estimate(prior)
        pairs = self.net.match(_points(ego, ego.descriptor), _points(other, other.descriptor)).pairs.numpy()
        return self.solver(ego, other, pairs, prior)


def _points(landmarks: Landmarks, descriptors: Floats) -> KeypointBatch:
    """Return one view's landmarks as a batch of the matcher."""
    columns = (descriptors, landmarks.xy, landmarks.yaw, landmarks.size, np.ones(len(landmarks)))
    descriptor, xy, yaw, size, mask = (torch.from_numpy(c).float()[None] for c in columns)
    return KeypointBatch(descriptor, xy, yaw, size, mask.bool())


@register_pose_corrector(FEAKM, "weights")
@cache
def load_feakm_corrector(weights: str, min_pairs: int = 4) -> FeakmCorrector:
    """Return the corrector with the weights of a shipped name or a file, the shipped ones by the corrector's own name; loaded once
    per process.
    """
    return FeakmCorrector.of(
        pretrained.load_feakm(pretrained.DEFAULT_FEAKM if weights == FEAKM else weights), min_pairs
    )
