# SPDX-License-Identifier: Apache-2.0
"""Metrics of an estimated relative pose: success, errors, coverage, consistency of the covariance, and risk-coverage.

A frame is *answered* where objects gave the pose (status OK, CORRECTED or CONFLICT). RTE is the length of the
translation's error (m), RRE the size of the yaw's (deg). *Success at l* is the share of ALL frames answered with RTE
< l m and RRE < l deg: no answer is a failure. *Errors* are over answered frames. *Coverage* is answered over all,
*precision* right within 2 m and 2 deg over answered, *wrong-accept rate* answered but not right over all. A frame where
the two agents share no object can only be answered by chance: *null accepts* is the share of those that are. *Object
displacement* (OD) is the mean distance (m) by which the used pose misplaces the objects in common. *NEES* is e' C^-1 e
of right answers, 3 if the covariance C is honest (its mean over a hundred answers is off by 0.25, one standard error);
*inside* is the share of them within the 95 % ellipsoid. The *risk-coverage curve* orders frames by an estimator's own
confidence: risk is the share not right among the most confident; AURC is its mean over all coverages. *Conflicts* is
the share of all frames that contradict the claim.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_normal, keyed_uniform
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3, no_estimate, pose_difference

Floats = NDArray[np.float64]

COMMON_OBJECT_BUCKETS = ((0, 0), (1, 1), (2, 2), (3, 4), (5, 7), (8, 10**9))
"""Ranges of the number of common objects by which results are listed."""
CHI2_3DOF_95 = 7.815


@dataclass(frozen=True)
class PoseEvaluation:
    """One frame evaluated. num_common: objects in common. translation_error_m, rotation_error_deg: error of the pose used, infinite
    where there is none.

    displacement_m: of the objects in common (m), NaN without any. nees: NaN where objects gave no pose. confidence: by
    which an estimator ranks its own answers, minus infinity where it gave none. status: its name.
    """

    status: PoseStatus
    num_common: int
    translation_error_m: float
    rotation_error_deg: float
    displacement_m: float
    nees: float
    confidence: float

    def is_within(self, limit: float) -> bool:
        """Return whether the pose used is within so many metres and degrees."""
        return self.translation_error_m < limit and self.rotation_error_deg < limit


@dataclass(frozen=True)
class PoseScore:
    """Numbers over frames, defined in the module; NaN where there is nothing to take a mean of. nees_standard_error: one standard
    error of nees.
    """

    num_frames: int
    success_rate: tuple[float, float, float]
    coverage: float
    precision: float
    false_accept_rate: float
    no_overlap_accept_rate: float
    mean_translation_error_m: float
    median_translation_error_m: float
    p95_translation_error_m: float
    median_rotation_error_deg: float
    mean_displacement_m: float
    nees: float
    nees_standard_error: float
    within_95_fraction: float
    aurc: float
    conflict_rate: float


def evaluate_pose(estimate: PoseEstimate, truth: Floats, common_xy: Floats) -> PoseEvaluation:
    """Return one answer against the true ego_from_other (3,), with the true places (K, 2) of common objects in the ego's
    frame.
    """
    if truth.shape != (3,) or common_xy.ndim != 2 or common_xy.shape[1] != 2:
        raise ConfigError(f"evaluated needs a pose (3,) and places (K, 2); got {truth.shape} and {common_xy.shape}.")
    pose = estimate.pose
    if pose is None:
        return PoseEvaluation(estimate.status, len(common_xy), math.inf, math.inf, math.nan, math.nan, -math.inf)
    error = pose_difference(pose, truth)
    has_estimate = estimate.status.has_estimate
    # A claim that states no error at all leaves nothing to measure its error by.
    has_covariance = has_estimate and estimate.inliers > 0 and np.linalg.eigvalsh(estimate.covariance).min() > 1e-14
    nees = float(error @ np.linalg.solve(estimate.covariance, error)) if has_covariance else math.nan
    return PoseEvaluation(
        estimate.status,
        len(common_xy),
        float(np.hypot(error[0], error[1])),
        math.degrees(abs(float(error[2]))),
        compute_displacement(pose, truth, common_xy),
        nees,
        estimate.margin if has_estimate else -math.inf,
    )


def compute_displacement(pose: Floats, truth: Floats, points_xy: Floats) -> float:
    """Return the mean distance (m) by which a pose misplaces objects at true places (K, 2) in the ego's frame; NaN without any."""
    if not len(points_xy):
        return math.nan
    yaw_error = pose[2] - truth[2]
    c, s = math.cos(yaw_error), math.sin(yaw_error)
    arm = points_xy - truth[:2]
    moved = np.stack((c * arm[:, 0] - s * arm[:, 1], s * arm[:, 0] + c * arm[:, 1]), 1) + pose[:2]
    return float(np.hypot(*(moved - points_xy).T).mean())


def summarize_evaluations(evaluations: Sequence[PoseEvaluation]) -> PoseScore:
    """Return all numbers over some frames."""
    n = len(evaluations)
    estimates = [f for f in evaluations if f.status.has_estimate]
    translation_errors_m, rotation_errors_deg = (
        np.array([f.translation_error_m for f in estimates]),
        np.array([f.rotation_error_deg for f in estimates]),
    )
    nees = np.array([f.nees for f in estimates if f.is_within(2.0) and not math.isnan(f.nees)])
    displacements_m = np.array([f.displacement_m for f in evaluations if not math.isnan(f.displacement_m)])
    without_overlap = [f for f in evaluations if f.num_common == 0]
    return PoseScore(
        n,
        (_success(evaluations, 1.0), _success(evaluations, 2.0), _success(evaluations, 3.0)),
        _fraction(len(estimates), n),
        _fraction(sum(f.is_within(2.0) for f in estimates), len(estimates)),
        _fraction(sum(not f.is_within(2.0) for f in estimates), n),
        _fraction(sum(f.status.has_estimate for f in without_overlap), len(without_overlap)),
        _mean(translation_errors_m),
        float(np.median(translation_errors_m)) if len(translation_errors_m) else math.nan,
        float(np.percentile(translation_errors_m, 95)) if len(translation_errors_m) else math.nan,
        float(np.median(rotation_errors_deg)) if len(rotation_errors_deg) else math.nan,
        _mean(displacements_m),
        _mean(nees),
        float(nees.std(ddof=1) / math.sqrt(len(nees))) if len(nees) > 1 else math.nan,
        _mean((nees <= CHI2_3DOF_95).astype(np.float64)),
        _mean(compute_risk_coverage(evaluations)[1]),
        _fraction(sum(f.status is PoseStatus.CONFLICT for f in evaluations), n),
    )


def summarize_by_common_objects(evaluations: Sequence[PoseEvaluation]) -> list[tuple[tuple[int, int], PoseScore]]:
    """Return the numbers for each bucket of common objects that has a frame."""
    evaluations_by_bucket = [
        (b, [f for f in evaluations if b[0] <= f.num_common <= b[1]]) for b in COMMON_OBJECT_BUCKETS
    ]
    return [(b, summarize_evaluations(part)) for b, part in evaluations_by_bucket if part]


def compute_risk_coverage(evaluations: Sequence[PoseEvaluation], limit: float = 2.0) -> tuple[Floats, Floats]:
    """Coverages 1/n, 2/n, ..., and the share not right among the so many most confident frames.

    Frames of equal confidence come in as one: their risk is shared, so that no order of the list can improve the
    curve.
    """
    n = len(evaluations)
    wrong = np.array([not (f.status.has_estimate and f.is_within(limit)) for f in evaluations], np.float64)
    _, group = np.unique(-np.array([f.confidence for f in evaluations]), return_inverse=True)
    shared = (np.bincount(group, wrong) / np.maximum(np.bincount(group), 1))[group] if n else wrong
    order = np.argsort(group, kind="stable")
    ranks = np.arange(1, n + 1)
    return ranks / max(n, 1), np.cumsum(shared[order]) / ranks


def count_confusion(pairs: Sequence[tuple[PoseStatus, PoseStatus]]) -> NDArray[np.int64]:
    """Return (5, 5) counts of (injected, reported) statuses, in the order of PoseStatus."""
    order = list(PoseStatus)
    table = np.zeros((len(order), len(order)), np.int64)
    for injected, reported in pairs:
        table[order.index(injected), order.index(reported)] += 1
    return table


def make_oracle_estimate(truth: Floats, prior: PosePrior | None) -> PoseEstimate:
    """Return the oracle row: the true pose as estimate. It is here because lower layers have no ground truth."""
    template = no_estimate(prior, PoseStatus.OK)
    return PoseEstimate(
        lift_to_se3(truth, prior),
        np.eye(3) * 1e-6,
        template.status,
        0,
        0,
        0.0,
        template.pairs,
        None,
        None,
        template.mahalanobis_squared,
    )


@dataclass(frozen=True)
class PriorNoise:
    """Errors of a prior relative pose. sigma_m, sigma_deg: their size; drawn by (seed, scene,
    frame), the same unit draw at every size.

    kind: ``gaussian`` (of the other agent); ``gaussian_all`` (of both, in the world, so that the ego's yaw moves the
    other by its distance); ``laplace`` (scale sigma, so sqrt 2 as wide); ``bias`` (one offset a scene); ``walk``
    (each frame adds a tenth); ``latency`` (along the other's heading, sigma_m at most); ``heavy`` (one claim in ten
    is ten times as far off); ``offset`` (five sigma_m off in any direction); ``no_prior`` (anywhere within 100 m, any
    yaw, with the covariance of that); ``none`` (no prior).
    """

    kind: str = "gaussian"
    sigma_m: float = 0.0
    sigma_deg: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in NOISE_KINDS:
            raise ConfigError(f"No noise of claims is called {self.kind!r}; known: {', '.join(NOISE_KINDS)}.")

    def make_prior(self, truth: Floats, scene: int | str, frame: int = 0) -> PosePrior | None:
        """ego_from_other of the prior in a frame of a scene, from the true one (3,); None without a prior."""
        if self.kind == "none":
            return None
        sigma = np.array([self.sigma_m, self.sigma_m, math.radians(self.sigma_deg)])
        if self.kind == "unknown":
            uniform = keyed_uniform((3,), self.seed, "claim", self.kind, scene, frame).numpy()
            radius, angle = 100.0 * math.sqrt(uniform[0]), 2 * math.pi * uniform[1]
            pose = np.array([radius * math.cos(angle), radius * math.sin(angle), 2 * math.pi * uniform[2] - math.pi])
            return PosePrior(lift_to_se3(pose, None), np.diag([5e3, 5e3, math.pi**2 / 3]))
        offset, variance = self._sample_offset(truth, sigma, scene, frame)
        moved = truth + offset
        return PosePrior(lift_to_se3(moved, None), np.diag(variance))

    def _sample_offset(self, truth: Floats, sigma: Floats, scene: int | str, frame: int) -> tuple[Floats, Floats]:
        """What the claim is off by (3,), and the variances (3,) that it states."""
        unit = keyed_normal((6,), self.seed, "claim", scene, 0 if self.kind == "bias" else frame).numpy()
        if self.kind == "gaussian_all":
            lever = np.array([-truth[1], truth[0], 0.0])
            return sigma * (unit[:3] - unit[3:]) - lever * sigma[2] * unit[5], 2 * sigma**2 + (lever * sigma[2]) ** 2
        if self.kind == "laplace":
            uniform = keyed_uniform((3,), self.seed, "claim", self.kind, scene, frame).numpy() - 0.5
            return -sigma * np.sign(uniform) * np.log1p(-2 * np.abs(uniform)), 2 * sigma**2
        if self.kind == "walk":
            steps = [keyed_normal((6,), self.seed, "claim", scene, n).numpy()[:3] for n in range(frame + 1)]
            return sigma * (steps[0] + 0.1 * np.sum(steps[1:], 0)), sigma**2 * (1 + 0.01 * frame)
        if self.kind == "latency":
            lag_m = keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item() * self.sigma_m
            heading = np.array([math.cos(truth[2]), math.sin(truth[2]), 0.0])
            return -lag_m * heading, np.array([sigma[0], sigma[1], max(sigma[2], 1e-3)]) ** 2
        if self.kind == "offset":
            angle = 2 * math.pi * keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item()
            return 5 * self.sigma_m * np.array([math.cos(angle), math.sin(angle), 0.0]), sigma**2
        if self.kind == "heavy":
            is_outlier = keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item() < 0.1
            return sigma * unit[:3] * (10.0 if is_outlier else 1.0), sigma**2
        return sigma * unit[:3], sigma**2


NOISE_KINDS = ("gaussian", "gaussian_all", "laplace", "bias", "walk", "latency", "heavy", "offset", "unknown", "none")


def _success(evaluations: Sequence[PoseEvaluation], limit: float) -> float:
    return _fraction(sum(f.status.has_estimate and f.is_within(limit) for f in evaluations), len(evaluations))


def _fraction(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan
