# SPDX-License-Identifier: Apache-2.0
"""The default corrector's candidates: poses by hypothesis and verification, best first, independent of the prior.

Pairs of objects vote (_voting_kernels), the best supported poses are refined on one-to-one pairs, and each is scored by a
log-likelihood ratio: pairs are the same objects, against pairs that met by chance. A pair gains log(area / 2 pi s^2) less
half its squared residual, ``area`` being the mean ground per chance neighbour, and log 2p for a heading that agrees with
probability p, and the evidence of their sizes (size_evidence.py). The result does not depend on the order of landmarks nor on which
agent is called ego.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose import _voting_kernels as loops
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.sensor_clutter import IdentityFilter, find_sensor_fixed
from manyeyes.pose.size_evidence import compute_size_evidence
from manyeyes.pose.types import PosePrior

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class VoteConfig:
    """Search settings.

    max_range_m: landmarks farther than this from the median of all are left out; max_landmarks: at most so many, those of
    highest score. min_edge_m, max_edge_m: lengths of edges; max_edges: at most so many per agent, the shortest. max_hypotheses:
    at most so many, of the smallest residual. Together these limits bound the time. edge_gate: standard deviations by which
    edges may differ. size_gate_m: difference of widths (twice that and a tenth of it for lengths). support_radius_m,
    support_yaw_rad: reach of the coarse support. max_refined: how many of the best are refined. pair_gate: largest squared
    residual of a pair (3 degrees of freedom; 14.16 is p = 0.003). chance_area_m2: see the module, fitted on simulated
    crossings. min_separation_m, min_separation_rad: poses that differ by less are one. static_radius_m: objects that move less
    between instants count once. prior_dof: degrees of freedom of the stated errors against those of the residuals.
    common_variance_fraction: fraction of a box's variance that all boxes of one view have in common, which does not average
    out. lateral_sigma_ratio: lateral error of a box over its longitudinal error, which is the one that landmarks state.
    few_pairs_inflation: the covariance of P pairs is larger by 1 + few_pairs_inflation / P, since errors have heavy tails.
    floor_xy_m, floor_yaw_rad: errors that all boxes have in common, added at the centre of the pairs. identity_filter: removes
    landmarks that are fixed to the sensors.
    """

    max_range_m: float = 300.0
    max_landmarks: int = 200
    min_edge_m: float = 3.0
    max_edge_m: float = 150.0
    max_edges: int = 6000
    max_hypotheses: int = 8000
    edge_gate: float = 3.5
    size_gate_m: float = 0.5
    support_radius_m: float = 1.5
    support_yaw_rad: float = 0.26
    max_refined: int = 32
    pair_gate: float = 14.16
    chance_area_m2: float = 330.0
    min_separation_m: float = 2.0
    min_separation_rad: float = 0.105
    static_radius_m: float = 1.5
    prior_dof: float = 10.0
    common_variance_fraction: float = 0.0
    lateral_sigma_ratio: float = 1.0
    few_pairs_inflation: float = 0.0
    floor_xy_m: float = 0.0
    floor_yaw_rad: float = 0.0
    identity_filter: IdentityFilter = field(default_factory=IdentityFilter)

    def __post_init__(self) -> None:
        if (
            min(self.max_landmarks, self.max_edges, self.max_hypotheses, self.max_refined) < 1
            or not self.min_edge_m < self.max_edge_m
        ):
            raise ConfigError("VoteConfig needs caps of at least 1 and min_edge_m < max_edge_m.")
        if not (self.prior_dof > 0 and 0 <= self.common_variance_fraction < 1 and 0 < self.lateral_sigma_ratio <= 1):
            raise ConfigError(
                "VoteConfig needs prior_dof > 0, common_variance_fraction in [0, 1) and lateral_sigma_ratio in (0, 1]."
            )
        if min(self.few_pairs_inflation, self.floor_xy_m, self.floor_yaw_rad) < 0:
            raise ConfigError("VoteConfig needs few_pairs_inflation, floor_xy_m and floor_yaw_rad of at least 0.")


@dataclass(frozen=True)
class Candidate:
    """A candidate ego_from_other (3,): its covariance (3, 3) in the ego's axes, pairs (P, 2) of rows, the log-likelihood ratio,
    and the squared residual of all pairs with its degrees of freedom. num_compared: number of pairs of landmarks of one instant,
    with which the score that chance reaches grows.
    """

    pose: Floats
    covariance: Floats
    pairs: Ints
    score: float
    chi2: float
    dof: int
    num_compared: int = 1


def find_candidates(
    ego: Landmarks, other: Landmarks, config: VoteConfig, prior: PosePrior | None = None
) -> list[Candidate]:
    """Find distinct poses ego_from_other, most likely first. The prior is one more hypothesis; it does not change scores."""
    rows_e, rows_o = (x.select_indices(config.max_range_m, config.max_landmarks) for x in (ego, other))
    clutter = config.identity_filter
    fixed = None if clutter.is_plausible(prior) else find_sensor_fixed(ego[rows_e], other[rows_o], clutter)
    if fixed is not None:
        rows_e, rows_o = rows_e[~fixed[0]], rows_o[~fixed[1]]
    if not len(rows_e) or not len(rows_o):
        return []
    a, b = ego[rows_e], other[rows_o]
    start = None if prior is None else prior.pose
    # From the smaller set to the larger, so that exchanging the agents gives the inverse to the last digit but rounding.
    swapped = _rank(a) < _rank(b)
    if swapped:
        a, b, start = b, a, None if start is None else _inverse(start)
    found = _search(a, b, config, start)
    if fixed is not None:
        found = [one for one in found if not clutter.is_identity(one[0][None])[0]]
    if not found:
        return []
    out, num_compared = [], _count_comparable(a, b)
    for (pose, _, pairs, misfit, score), covariance in zip(found, _covariances(found, a, config)):
        if swapped:
            pose, covariance, pairs = *_invert(pose, covariance), pairs[:, ::-1]
        rows = np.stack((rows_e[pairs[:, 0]], rows_o[pairs[:, 1]]), 1)
        total, dof = float(misfit.sum()), 3 * len(pairs) - 3
        covariance, rows = (covariance + covariance.T) / 2, rows[np.lexsort(rows.T)]
        out.append(Candidate(pose, covariance, rows, score, total, dof, num_compared))
    return out


def _count_comparable(a: Landmarks, b: Landmarks) -> int:
    """Return the number of pairs of landmarks of one instant, at least 1."""
    counts = [np.bincount(x.instant - min(a.instant.min(), b.instant.min())) for x in (a, b)]
    shared = min(map(len, counts))
    return max(int(counts[0][:shared] @ counts[1][:shared]), 1)


_Found = tuple[Floats, Floats, Ints, Floats, float]


def _search(a: Landmarks, b: Landmarks, config: VoteConfig, start: Floats | None) -> list[_Found]:
    """Return distinct refined poses a_from_b, best first."""
    numbers_a, numbers_b = _numbers(a), _numbers(b)
    exact_a, exact_b = (
        _with_place_covariance(a, config.lateral_sigma_ratio),
        _with_place_covariance(b, config.lateral_sigma_ratio),
    )
    is_compatible = loops.find_compatible(a.size, b.size, a.instant, b.instant, config.size_gate_m)
    poses = _hypotheses(a, b, is_compatible, config)
    grid = loops.build_grid(numbers_a.xy, config.support_radius_m)
    support = loops.compute_support(
        poses, numbers_a, numbers_b, is_compatible, grid, config.support_radius_m, config.support_yaw_rad
    )
    best = poses[_select_supported(poses, support, b.xy.mean(0), config)]
    if start is not None:
        best = np.concatenate((best, start[None]))
    refined = loops.refine_poses(best, exact_a, exact_b, is_compatible, 1.0, config.pair_gate, 14)
    return _merge_alike(_rank_refined(a, b, refined, config), b, config)


def _select_supported(poses: Floats, support: Floats, middle: Floats, config: VoteConfig) -> Ints:
    """Return rows of at most max_refined distinct poses, of the largest support first. Ties of the support are ordered by the pose
    itself, never by its place in a list.

    Only as many of the best are sorted as that takes.
    """
    support, count = np.round(support, 9), 16 * config.max_refined
    while True:
        rows = np.arange(len(poses))
        if count < len(poses):
            rows = np.flatnonzero(support >= np.partition(support, -count)[-count])
        order = rows[np.lexsort((*poses[rows].T, -support[rows]))]
        chosen = loops.select_distinct(
            poses, order, middle, config.max_refined, config.min_separation_m / 2, config.min_separation_rad / 2
        )
        if len(chosen) == config.max_refined or len(rows) == len(poses):
            return chosen
        count *= 4


def _rank_refined(a: Landmarks, b: Landmarks, refined: loops.RefinedPoses, config: VoteConfig) -> list[_Found]:
    """Return the refined poses that have pairs, by falling score."""
    gain = _pair_gains(a, b, refined, config)
    found = []
    for k, (first, last) in enumerate(itertools.pairwise(refined.start.tolist())):
        if first < last:
            pairs, part = refined.pairs[first:last], gain[first:last]
            i = pairs[:, 0]
            score = float(part[_keep_static_once(a.xy[i], a.instant[i], part, config.static_radius_m)].sum())
            found.append((refined.poses[k], refined.information[k], pairs, refined.misfit[first:last], score))
    found.sort(key=lambda f: (-f[4], *f[0]))
    return found


def _numbers(x: Landmarks) -> loops.LandmarkArrays:
    return loops.LandmarkArrays(*(np.ascontiguousarray(v) for v in (x.xy, x.yaw, x.sigma_xy, x.sigma_yaw)))


def _with_place_covariance(x: Landmarks, lateral_sigma_ratio: float) -> loops.OrientedLandmarks:
    """As ``_numbers``, with the positions' covariances (N, 3): xx, xy and yy, smaller laterally than longitudinally."""
    xy, yaw, sigma_xy, sigma_yaw = _numbers(x)
    c, s = np.cos(yaw), np.sin(yaw)
    variance_ratio = lateral_sigma_ratio * lateral_sigma_ratio
    shape = np.stack((c * c + variance_ratio * s * s, (1 - variance_ratio) * c * s, s * s + variance_ratio * c * c), 1)
    return loops.OrientedLandmarks(xy, yaw, shape * sigma_xy[:, None] ** 2, sigma_yaw)


def _hypotheses(a: Landmarks, b: Landmarks, is_compatible: NDArray[np.bool_], config: VoteConfig) -> Floats:
    """Return poses (H, 3) a_from_b of matching edges, at most max_hypotheses, those of the smallest residual."""
    edges_a, edges_b = _edges(a, config), _edges(b, config)
    matches = loops.match_edges(
        _numbers(a), _numbers(b), edges_a, edges_b, is_compatible, config.edge_gate, 100 * config.max_hypotheses
    )
    misfit, max_kept = matches.misfit, config.max_hypotheses
    rows = np.arange(len(misfit))
    if len(misfit) > max_kept:
        # Sorting all of them, of which most are not kept, would cost as much as finding them.
        rows = np.flatnonzero(misfit <= np.partition(misfit, max_kept - 1)[max_kept - 1])
    poses = loops.compute_edge_poses(a.xy, b.xy, edges_a, edges_b, matches, rows)
    # The order of hypotheses does not matter, apart from ties of the last one that is kept.
    return poses if len(poses) <= max_kept else poses[np.lexsort((*poses.T, misfit[rows]))[:max_kept]]


def _edges(x: Landmarks, config: VoteConfig) -> loops.Edges:
    """Return the edges, by length."""
    edges = loops.build_edge_table(np.ascontiguousarray(x.xy), x.yaw, config.min_edge_m, config.max_edge_m)
    order = np.argsort(edges.length, kind="stable")[: config.max_edges]
    return loops.Edges(edges.ends[order], edges.length[order], edges.direction[order], edges.heading[order])


def _pair_gains(a: Landmarks, b: Landmarks, refined: loops.RefinedPoses, config: VoteConfig) -> Floats:
    """Return (P,) the log-likelihood ratio of each pair; a pair more likely by chance contributes its heading only."""
    i, k = refined.pairs.T
    variance = a.sigma_xy[i] ** 2 + b.sigma_xy[k] ** 2
    gain = np.log(config.chance_area_m2 / (2 * np.pi * variance)) - refined.misfit / 2
    flip_a, flip_b = np.clip(a.p_flip, 0.01, 0.5)[i], np.clip(b.p_flip, 0.01, 0.5)[k]
    agree = (1 - flip_a) * (1 - flip_b) + flip_a * flip_b
    yaw = np.repeat(refined.poses[:, 2], np.diff(refined.start))
    same = np.cos(a.yaw[i] - b.yaw[k] - yaw) > 0
    gain += compute_size_evidence(a, b)[i, k]
    return np.maximum(gain, 0.0) + np.log(2 * np.where(same, agree, 1 - agree))


def _keep_static_once(xy: Floats, instant: Ints, gain: Floats, static_radius_m: float) -> NDArray[np.bool_]:
    """Return (P,) bool: pairs that count; of those at one place in several instants only the best, since static objects are no
    new evidence.
    """
    if not instant.any():
        return np.ones(len(gain), bool)
    order = np.lexsort((instant, xy[:, 1], xy[:, 0], -gain))
    near = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) < static_radius_m
    near &= instant[:, None] != instant[None]
    counts = np.zeros(len(gain), bool)
    for p in order:
        counts[p] = not (near[p] & counts).any()
    return counts


def _merge_alike(found: list[_Found], b: Landmarks, config: VoteConfig) -> list[_Found]:
    """Return the found poses, best first, without those within the separation limits of a better one."""
    if not found:
        return []
    middles = np.array([b.xy[pairs[:, 1]].mean(0) for _, _, pairs, _, _ in found])
    rows = loops.select_separate(
        np.array([pose for pose, *_ in found]), middles, config.min_separation_m, config.min_separation_rad
    )
    return [found[n] for n in rows]


def transform_point(poses: Floats, point: Floats) -> Floats:
    """Return (N, 2) a point (2,) transformed by poses (N, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack((c * point[0] - s * point[1], s * point[0] + c * point[1]), 1)


def _covariances(found: list[_Found], a: Landmarks, config: VoteConfig) -> Floats:
    """Return (K, 3, 3): inverse information, scaled by the residuals (the mean of an inverse gamma prior on the scale), plus the
    variance that all boxes of a view have in common, and the floor.
    """
    information = np.array([f[1] for f in found])
    misfit, pairs = np.array([(f[3].sum(), len(f[2])) for f in found]).T
    scale = (config.prior_dof + misfit) / (config.prior_dof + 3 * pairs - 3) * (1 + config.few_pairs_inflation / pairs)
    covariance = np.asarray(np.linalg.inv(information) * scale[:, None, None], np.float64)
    # The first two of the diagonal sum the pairs' inverse variances along an axis.
    common = config.common_variance_fraction * pairs * 2 / (information[:, 0, 0] + information[:, 1, 1])
    covariance[:, [0, 1], [0, 1]] += common[:, None]
    if config.floor_xy_m or config.floor_yaw_rad:
        covariance += np.array([_covariance_floor(f[0], a.xy[f[2][:, 0]].mean(0), config) for f in found])
    return covariance


def _covariance_floor(pose: Floats, centre: Floats, config: VoteConfig) -> Floats:
    """Return (3, 3): common errors of all boxes, a shift and a turn about the centre (2,) of the pairs in a's frame."""
    lever = np.array([centre[1] - pose[1], pose[0] - centre[0], 1.0])
    floor = np.outer(lever, lever) * config.floor_yaw_rad**2
    floor[[0, 1], [0, 1]] += config.floor_xy_m**2
    return floor


def _rank(x: Landmarks) -> tuple[float, ...]:
    """Return a sort key of a set that does not depend on its frame or order."""
    return (len(x), *np.round(np.sort(x.size, 0).sum(0), 9), round(float(x.score.sum()), 9))


def _inverse(pose: Floats) -> Floats:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


def _invert(pose: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the inverse pose and its covariance."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    back = _inverse(pose)
    by = np.array([[-c, -s, back[1]], [s, -c, -back[0]], [0.0, 0.0, -1.0]])
    return back, by @ covariance @ by.T
