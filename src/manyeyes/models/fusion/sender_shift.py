# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose error of each sender from its tokens, and move the tokens back before they are fused; ours.

Peaks of the ego's and of a sender's tokens are proposed centres of objects with a stated error. A sender's peak is an object of the
ego's, moved by the pose error, or clutter. The most probable error is found from the displacements of pairs, and refined by
expectation maximization with a Gaussian prior: few or uncertain pairs move little.

Whether a sender is off at all is decided for all senders of an ego together, by the evidence of each. Either poses are reliable,
and few senders are off, or they are not, as between high buildings or where the ego's own pose is wrong, and most are. A sender's
tokens move by the estimate times the probability that it is off. Headings of proposals and vector channels are not turned; errors
of yaw are a degree or so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import proposed_heat, proposed_offset
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion import _shift_kernels
from manyeyes.models.fusion._shift_kernels import ShiftSettings
from manyeyes.models.fusion.registry import get_fusion, register_fusion
from manyeyes.models.fusion.token_merge import DRIFT_MPS, MAX_OFFSET_CELLS
from manyeyes.models.fusion.transform_tokens import Tokens

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
_MAX_EVIDENCE = 50.0
"""Evidence beyond it, e^50 to one, decides alone."""


@dataclass(frozen=True)
class ShiftConfig:
    """Settings of the estimate.

    Attributes:
        min_score: peaks of lower confidence take no part.
        peak_radius_m: a peak is the most confident token within this distance.
        max_peaks: the most confident peaks of an agent that take part.
        max_shift_m: largest displacement at which an estimate begins.
        max_deviation: largest deviation of a pair, in its standard deviations.
        min_sigma_m: error of the distance of two centres of one object, beside what proposals state.
        clutter_per_m2: density of peaks that no object of the ego explains.
        prior_sigma_m: of the position error of a sender that is off, each axis.
        prior_sigma_yaw_rad: of its yaw error.
        apart_m: displacements farther from each other than this are different ones.
        max_second: share of the log-likelihood of the best displacement that a different one may have.
        iterations: of expectation maximization.
        evidence_scale: factor of the evidence of pairs; stated errors are a little too large.
        off_if_unreliable: share of senders that are off where poses are unreliable, which is as probable as not.
        off_if_reliable: the same where they are reliable.
        min_probability: senders that are off with less probability stay.
    """

    min_score: float = 0.2
    peak_radius_m: float = 2.0
    max_peaks: int = 48
    max_shift_m: float = 2.5
    max_deviation: float = 4.0
    min_sigma_m: float = 0.1
    clutter_per_m2: float = 0.02
    prior_sigma_m: float = 1.0
    prior_sigma_yaw_rad: float = 0.014
    apart_m: float = 1.0
    max_second: float = 0.9
    iterations: int = 8
    evidence_scale: float = 1.25
    off_if_unreliable: float = 0.9
    off_if_reliable: float = 0.05
    min_probability: float = 0.2


DEFAULT_SHIFT = ShiftConfig()


@dataclass(frozen=True, eq=False)
class Peaks:
    """Proposed objects of one agent: centre (n, 2), metres; weight (n,), confidence; sigma (n,) of the centre, metres."""

    center: F64
    weight: F64
    sigma: F64


@dataclass(frozen=True, eq=False)
class SenderShift:
    """Estimated correction of a sender: p becomes p + shift + yaw J (p - origin), J a quarter turn to the left.

    covariance: (3, 3) of x, y, yaw after the correction. num_pairs: sum of the probabilities of the pairs that it rests on.
    evidence: logarithm of how much more probable the pairs are if the sender is off.
    """

    shift: F64
    yaw: float
    origin: F64
    covariance: F64
    num_pairs: float
    evidence: float

    def move(self, xy: F64) -> F64:
        """Return corrected positions (n, 2)."""
        arm = xy - self.origin
        return xy + self.shift + self.yaw * np.stack((-arm[:, 1], arm[:, 0]), 1)

    def sigma_m(self, xy: F64) -> F64:
        """Return the standard deviation (n,) of corrected positions, the mean of both axes."""
        arm = xy - self.origin
        of_xy = (self.covariance[0, 0] + self.covariance[1, 1]) / 2
        return np.sqrt(of_xy + self.covariance[2, 2] * (arm**2).sum(1) / 2)

    def if_off_with(self, probability: float) -> SenderShift:
        """Return the expected correction of a sender that is off with this probability, and exact else."""
        whole = np.array([*self.shift, self.yaw])
        spread = probability * (1 - probability) * np.outer(whole, whole)
        expected, covariance = probability * whole, probability * self.covariance + spread
        return replace(self, shift=expected[:2], yaw=float(expected[2]), covariance=covariance)


def estimate_shift(ego: Peaks, sender: Peaks, origin: F64, config: ShiftConfig = DEFAULT_SHIFT) -> SenderShift | None:
    """Return the correction of a sender at origin (2,) in the ego's frame, if it is off; None where the peaks do not give one."""
    settings = ShiftSettings(**{name: getattr(config, name) for name in ShiftSettings._fields})
    pairs = _shift_kernels.list_pairs(
        ego.center, ego.sigma, ego.weight, sender.center, sender.sigma, sender.weight, origin, settings
    )
    estimate, covariance = np.zeros(3), np.empty((3, 3))
    if not (len(pairs.away) and _shift_kernels.find_start(pairs, settings, estimate)):
        return None
    num_pairs = _shift_kernels.solve_pairs(pairs, settings, estimate, covariance)
    if not np.isfinite(estimate).all():
        return None
    x, y, yaw = estimate.tolist()
    evidence = config.evidence_scale * (
        _shift_kernels.find_log_likelihood(pairs, x, y, yaw, 0.0, settings)
        - _shift_kernels.find_log_likelihood(pairs, 0.0, 0.0, 0.0, 0.0, settings)
    )
    # Laplace's approximation of the integral over all errors of the prior.
    prior = np.array([config.prior_sigma_m, config.prior_sigma_m, config.prior_sigma_yaw_rad])
    evidence += (math.log(np.linalg.det(covariance)) - ((estimate / prior) ** 2).sum()) / 2 - np.log(prior).sum()
    return SenderShift(estimate[:2], yaw, origin, covariance, num_pairs, float(evidence))


def find_probabilities_off(evidence: Sequence[float], config: ShiftConfig = DEFAULT_SHIFT) -> list[float]:
    """Return the probability that each sender of one ego is off, from the evidence of all that have an estimate."""
    shares = np.array([[config.off_if_unreliable], [config.off_if_reliable]])
    ratio = np.exp(np.clip(np.array(evidence, np.float64), -_MAX_EVIDENCE, _MAX_EVIDENCE))
    # (2, n) probability of the pairs where poses are unreliable and where they are reliable, over that of exact poses.
    pairs = 1 - shares + shares * ratio
    log_odds = np.log(pairs[0] / pairs[1]).sum()
    unreliable = 1 / (1 + math.exp(-np.clip(log_odds, -_MAX_EVIDENCE, _MAX_EVIDENCE)))
    return (np.array([unreliable, 1 - unreliable]) @ (shares * ratio / pairs)).tolist()


def find_peaks(xy: F64, heat: F64, sigma: F64, config: ShiftConfig = DEFAULT_SHIFT) -> Peaks:
    """Return the peaks of proposed centres (n, 2), heat logits (n,), sigmas (n,), metres; the most confident first."""
    score = 1 / (1 + np.exp(-np.clip(heat, -30, 30)))
    order = np.argsort(-score, kind="stable")
    order = order[(score[order] >= config.min_score) & np.isfinite(xy[order]).all(1)][: 8 * config.max_peaks]
    row = np.empty(config.max_peaks, np.int64)
    kept = row[: _shift_kernels.pick_peaks(xy, order, config.peak_radius_m, row)]
    return Peaks(xy[kept], score[kept], np.clip(sigma[kept], 0.0, 2.0))


def align_senders(tokens: Tokens, past: Tokens | None = None, config: ShiftConfig = DEFAULT_SHIFT) -> Tokens:
    """Return the tokens with those of each sender moved by its estimated correction, and the position sigma that is left.

    Tokens of senders without an estimate, and the ego's own ones, stay as they are. There is no gradient to positions; that of
    features stays. past: the ego's own earlier tokens, where they are the last rows of tokens.
    """
    with torch.no_grad():
        places, pose_context = _find_places(tokens, _count_own(tokens, past), config)
        inside = (tokens.sender == 0) | tokens.grid.contains(places)
        rows = None if bool(inside.all()) else inside.nonzero()[:, 0]
    aligned = replace(tokens, xy=places, pose_context=pose_context)
    return aligned if rows is None else aligned.select(rows)


def _count_own(tokens: Tokens, past: Tokens | None) -> int:
    """Return how many of the last senders are the ego itself at earlier instants; one ego."""
    if past is None or not len(past.sender) or tokens.batch_size > 1:
        return 0
    first = len(tokens.sender) - len(past.sender)
    return int(past.sender.max()) if first >= 0 and torch.equal(past.xy, tokens.xy[first:]) else 0


def _find_places(tokens: Tokens, num_own: int, config: ShiftConfig) -> tuple[Tensor, Tensor]:
    """Return the corrected positions and pose contexts. num_own: of the last senders, which are the ego itself."""
    cell_m = tokens.grid.cell_size_m
    offset = proposed_offset(tokens.proposal)
    follows = (offset.abs().amax(1) <= MAX_OFFSET_CELLS)[:, None]
    center = (tokens.xy + torch.where(follows, offset, 0.0) * cell_m).double().cpu().numpy()
    log_sigma = tokens.proposal[:, BOX_LAYOUT.log_sigma_xy][:, 0].clamp(-5, 3)
    drift = DRIFT_MPS * 0.1 * tokens.age
    sigma = (log_sigma.exp() ** 2 + drift**2).sqrt().double().cpu().numpy()
    heat = proposed_heat(tokens.proposal).double().cpu().numpy()
    xy, sender_xy = tokens.xy.double().cpu().numpy(), tokens.sender_xy.double().cpu().numpy()
    context = tokens.pose_context.double().cpu().numpy()
    group = (tokens.ego * (int(tokens.sender.max()) + 1 if len(tokens.sender) else 1) + tokens.sender).cpu().numpy()
    egos, senders = tokens.ego.cpu().numpy(), tokens.sender.cpu().numpy()
    own = {ego: (egos == ego) & (senders == 0) for ego in range(tokens.batch_size)}
    own_peaks = {ego: find_peaks(center[m], heat[m], sigma[m], config) for ego, m in own.items()}
    moved, left = xy.copy(), context[:, 3].copy()
    estimates: dict[int, list[tuple[Flags, SenderShift]]] = {ego: [] for ego in own}
    is_other = (senders > 0) & (senders <= senders.max(initial=0) - num_own)
    for number in np.unique(group[is_other]):
        mine = group == number
        peaks, ego = find_peaks(center[mine], heat[mine], sigma[mine], config), int(egos[mine][0])
        origin = _origin(xy[mine], sender_xy[mine], context[mine])
        found = estimate_shift(own_peaks[ego], peaks, origin, config)
        if found is not None:
            estimates[ego].append((mine, found))
    for of_ego in estimates.values():
        chances = find_probabilities_off([found.evidence for _, found in of_ego], config)
        for (mine, found), chance in zip(of_ego, chances, strict=True):
            if chance >= config.min_probability:
                expected = found.if_off_with(chance)
                moved[mine], left[mine] = expected.move(xy[mine]), expected.sigma_m(xy[mine])
    pose_context = tokens.pose_context.clone()
    pose_context[:, 3] = torch.from_numpy(left).to(pose_context)
    changed = torch.from_numpy((moved != xy).any(1)).to(tokens.xy.device)
    places = torch.where(changed[:, None], torch.from_numpy(moved).to(tokens.xy), tokens.xy)
    return places, torch.where(changed[:, None], pose_context, tokens.pose_context)


def _origin(xy: F64, sender_xy: F64, context: F64) -> F64:
    """Return the place (2,) of a sender in the ego's frame, of its tokens in both frames; motion is averaged out."""
    sine, cosine = context[:, 1], context[:, 2] + 1
    x = cosine * sender_xy[:, 0] - sine * sender_xy[:, 1]
    y = sine * sender_xy[:, 0] + cosine * sender_xy[:, 1]
    return np.median(xy - np.stack((x, y), 1), axis=0)


def _build_aligned_fast(channels: int, attention: AttentionConfig) -> nn.Module:
    module = get_fusion("fast")(channels, attention)
    module.register_forward_pre_hook(lambda _, given: (align_senders(*given[:2]), *given[1:]))
    return module


register_fusion("shift/fast")(_build_aligned_fast)
