# SPDX-License-Identifier: Apache-2.0
"""How good an estimated relative pose is, and how well an estimator knows when not to answer (specs/pose.md 3.3).

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
from manyeyes.pose.types import PoseClaim, PoseEstimate, PoseStatus, difference, unanswered, upright

Floats = NDArray[np.float64]

BUCKETS = ((0, 0), (1, 1), (2, 2), (3, 4), (5, 7), (8, 10**9))
"""Numbers of common objects by which results are listed (specs/pose.md 3.2)."""
WITHIN_95 = 7.815


@dataclass(frozen=True)
class PoseFrame:
    """One frame judged. common: objects in common. metres, degrees: error of the pose used, infinite where there is
    none.

    displacement: of the objects in common (m), NaN without any. nees: NaN where objects gave no pose. confidence: by
    which an estimator ranks its own answers, minus infinity where it gave none. status: its name.
    """

    status: PoseStatus
    common: int
    metres: float
    degrees: float
    displacement: float
    nees: float
    confidence: float

    def right(self, limit: float) -> bool:
        """Whether the pose used is within so many metres and degrees."""
        return self.metres < limit and self.degrees < limit


@dataclass(frozen=True)
class PoseScore:
    """Numbers over frames, defined in the module; NaN where there is nothing to take a mean of. nees_error: one standard
    error of nees.
    """

    frames: int
    success: tuple[float, float, float]
    coverage: float
    precision: float
    wrong_accepts: float
    null_accepts: float
    mean_metres: float
    median_metres: float
    p95_metres: float
    median_degrees: float
    displacement: float
    nees: float
    nees_error: float
    inside: float
    aurc: float
    conflicts: float


def judged(estimate: PoseEstimate, truth: Floats, common_xy: Floats) -> PoseFrame:
    """One answer against the true ego_from_other (3,), with the true places (K, 2) of common objects in the ego's
    frame.
    """
    if truth.shape != (3,) or common_xy.ndim != 2 or common_xy.shape[1] != 2:
        raise ConfigError(f"judged needs a pose (3,) and places (K, 2); got {truth.shape} and {common_xy.shape}.")
    pose = estimate.pose
    if pose is None:
        return PoseFrame(estimate.status, len(common_xy), math.inf, math.inf, math.nan, math.nan, -math.inf)
    error = difference(pose, truth)
    answered = estimate.status.answered
    # A claim that states no error at all leaves nothing to measure its error by.
    stated = answered and estimate.inliers > 0 and np.linalg.eigvalsh(estimate.covariance).min() > 1e-14
    nees = float(error @ np.linalg.solve(estimate.covariance, error)) if stated else math.nan
    return PoseFrame(
        estimate.status,
        len(common_xy),
        float(np.hypot(error[0], error[1])),
        math.degrees(abs(float(error[2]))),
        displacement(pose, truth, common_xy),
        nees,
        estimate.margin if answered else -math.inf,
    )


def displacement(pose: Floats, truth: Floats, places: Floats) -> float:
    """Mean distance (m) by which a pose misplaces objects at true places (K, 2) in the ego's frame; NaN without any."""
    if not len(places):
        return math.nan
    turn = pose[2] - truth[2]
    c, s = math.cos(turn), math.sin(turn)
    arm = places - truth[:2]
    moved = np.stack((c * arm[:, 0] - s * arm[:, 1], s * arm[:, 0] + c * arm[:, 1]), 1) + pose[:2]
    return float(np.hypot(*(moved - places).T).mean())


def score(frames: Sequence[PoseFrame]) -> PoseScore:
    """All numbers over some frames."""
    n = len(frames)
    answers = [f for f in frames if f.status.answered]
    metres, degrees = np.array([f.metres for f in answers]), np.array([f.degrees for f in answers])
    nees = np.array([f.nees for f in answers if f.right(2.0) and not math.isnan(f.nees)])
    shift = np.array([f.displacement for f in frames if not math.isnan(f.displacement)])
    nulls = [f for f in frames if f.common == 0]
    return PoseScore(
        n,
        (_success(frames, 1.0), _success(frames, 2.0), _success(frames, 3.0)),
        _share(len(answers), n),
        _share(sum(f.right(2.0) for f in answers), len(answers)),
        _share(sum(not f.right(2.0) for f in answers), n),
        _share(sum(f.status.answered for f in nulls), len(nulls)),
        _mean(metres),
        float(np.median(metres)) if len(metres) else math.nan,
        float(np.percentile(metres, 95)) if len(metres) else math.nan,
        float(np.median(degrees)) if len(degrees) else math.nan,
        _mean(shift),
        _mean(nees),
        float(nees.std(ddof=1) / math.sqrt(len(nees))) if len(nees) > 1 else math.nan,
        _mean((nees <= WITHIN_95).astype(np.float64)),
        _mean(risk_coverage(frames)[1]),
        _share(sum(f.status is PoseStatus.CONFLICT for f in frames), n),
    )


def by_common(frames: Sequence[PoseFrame]) -> list[tuple[tuple[int, int], PoseScore]]:
    """The numbers for each bucket of common objects that has a frame."""
    split = [(b, [f for f in frames if b[0] <= f.common <= b[1]]) for b in BUCKETS]
    return [(b, score(part)) for b, part in split if part]


def risk_coverage(frames: Sequence[PoseFrame], limit: float = 2.0) -> tuple[Floats, Floats]:
    """Coverages 1/n, 2/n, ..., and the share not right among the so many most confident frames.

    Frames of equal confidence come in as one: their risk is shared, so that no order of the list can improve the
    curve.
    """
    n = len(frames)
    wrong = np.array([not (f.status.answered and f.right(limit)) for f in frames], np.float64)
    _, group = np.unique(-np.array([f.confidence for f in frames]), return_inverse=True)
    shared = (np.bincount(group, wrong) / np.maximum(np.bincount(group), 1))[group] if n else wrong
    order = np.argsort(group, kind="stable")
    places = np.arange(1, n + 1)
    return places / max(n, 1), np.cumsum(shared[order]) / places


def confusion(pairs: Sequence[tuple[PoseStatus, PoseStatus]]) -> NDArray[np.int64]:
    """(5, 5) counts of (injected, reported) statuses, in the order of PoseStatus."""
    order = list(PoseStatus)
    table = np.zeros((len(order), len(order)), np.int64)
    for injected, reported in pairs:
        table[order.index(injected), order.index(reported)] += 1
    return table


def oracle(truth: Floats, claimed: PoseClaim | None) -> PoseEstimate:
    """The row that knows: the true pose as an answer. It lives here because nothing below may see truth."""
    said = unanswered(claimed, PoseStatus.OK)
    return PoseEstimate(
        upright(truth, claimed),
        np.eye(3) * 1e-6,
        said.status,
        0,
        0,
        0.0,
        said.pairs,
        None,
        None,
        said.distance,
    )


@dataclass(frozen=True)
class ClaimNoise:
    """Errors of a claimed relative pose (specs/pose.md 3.2). sigma_m, sigma_deg: their size; drawn by (seed, scene,
    frame), the same unit draw at every size.

    kind: ``gaussian`` (of the other agent); ``gaussian_all`` (of both, in the world, so that the ego's yaw moves the
    other by its distance); ``laplace`` (scale sigma, so sqrt 2 as wide); ``bias`` (one offset a scene); ``walk``
    (each frame adds a tenth); ``latency`` (along the other's heading, sigma_m at most); ``heavy`` (one claim in ten
    is ten times as far off); ``offset`` (five sigma_m off in any direction); ``unknown`` (anywhere within 100 m, any
    yaw, and says so); ``none`` (no claim).
    """

    kind: str = "gaussian"
    sigma_m: float = 0.0
    sigma_deg: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in NOISE_KINDS:
            raise ConfigError(f"No noise of claims is called {self.kind!r}; known: {', '.join(NOISE_KINDS)}.")

    def claim(self, truth: Floats, scene: int | str, frame: int = 0) -> PoseClaim | None:
        """ego_from_other as claimed in a frame of a scene, from the true one (3,); None where nothing is claimed."""
        if self.kind == "none":
            return None
        sigma = np.array([self.sigma_m, self.sigma_m, math.radians(self.sigma_deg)])
        if self.kind == "unknown":
            drawn = keyed_uniform((3,), self.seed, "claim", self.kind, scene, frame).numpy()
            radius, angle = 100.0 * math.sqrt(drawn[0]), 2 * math.pi * drawn[1]
            pose = np.array([radius * math.cos(angle), radius * math.sin(angle), 2 * math.pi * drawn[2] - math.pi])
            return PoseClaim(upright(pose, None), np.diag([5e3, 5e3, math.pi**2 / 3]))
        offset, variance = self._offset(truth, sigma, scene, frame)
        moved = truth + offset
        return PoseClaim(upright(moved, None), np.diag(variance))

    def _offset(self, truth: Floats, sigma: Floats, scene: int | str, frame: int) -> tuple[Floats, Floats]:
        """What the claim is off by (3,), and the variances (3,) that it states."""
        unit = keyed_normal((6,), self.seed, "claim", scene, 0 if self.kind == "bias" else frame).numpy()
        if self.kind == "gaussian_all":
            lever = np.array([-truth[1], truth[0], 0.0])
            return sigma * (unit[:3] - unit[3:]) - lever * sigma[2] * unit[5], 2 * sigma**2 + (lever * sigma[2]) ** 2
        if self.kind == "laplace":
            drawn = keyed_uniform((3,), self.seed, "claim", self.kind, scene, frame).numpy() - 0.5
            return -sigma * np.sign(drawn) * np.log1p(-2 * np.abs(drawn)), 2 * sigma**2
        if self.kind == "walk":
            steps = [keyed_normal((6,), self.seed, "claim", scene, n).numpy()[:3] for n in range(frame + 1)]
            return sigma * (steps[0] + 0.1 * np.sum(steps[1:], 0)), sigma**2 * (1 + 0.01 * frame)
        if self.kind == "latency":
            late = keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item() * self.sigma_m
            along = np.array([math.cos(truth[2]), math.sin(truth[2]), 0.0])
            return -late * along, np.array([sigma[0], sigma[1], max(sigma[2], 1e-3)]) ** 2
        if self.kind == "offset":
            angle = 2 * math.pi * keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item()
            return 5 * self.sigma_m * np.array([math.cos(angle), math.sin(angle), 0.0]), sigma**2
        if self.kind == "heavy":
            far = keyed_uniform((1,), self.seed, "claim", self.kind, scene, frame).item() < 0.1
            return sigma * unit[:3] * (10.0 if far else 1.0), sigma**2
        return sigma * unit[:3], sigma**2


NOISE_KINDS = ("gaussian", "gaussian_all", "laplace", "bias", "walk", "latency", "heavy", "offset", "unknown", "none")


def _success(frames: Sequence[PoseFrame], limit: float) -> float:
    return _share(sum(f.status.answered and f.right(limit) for f in frames), len(frames))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan
