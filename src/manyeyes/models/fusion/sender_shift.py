# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose error of each sender from its tokens, and move the tokens back before they are fused; ours.

Peaks of the ego's and of a sender's tokens are proposed centres of objects. Pairs of them vote for a displacement; the pairs of its
mode give position and yaw in closed form: least squares with a Gaussian prior, so that few pairs move little. Nothing is moved
without enough pairs, with a second mode of almost as many votes, or where chi2 is below a low limit, so that estimates near their
own error do move tokens. Headings of proposals and vector channels are not turned; errors of yaw are a degree or so.
"""

from __future__ import annotations

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


@dataclass(frozen=True)
class ShiftConfig:
    """Settings of the estimate.

    Attributes:
        min_score: peaks of lower confidence take no part.
        peak_radius_m: a peak is the most confident token within this distance.
        max_peaks: the most confident peaks of an agent that take part.
        max_shift_m: largest displacement of a pair.
        min_pairs: fewer pairs move nothing.
        vote_m: width of the votes, for the error of centres and the turn by an error of yaw.
        match_m: largest distance of a pair after the shift of the mode.
        max_second: share of the best vote that a displacement apart from it may have.
        object_sigma_m: error of the distance of two centres of one object, beside what proposals state.
        prior_sigma_m: prior of the position error, each axis.
        prior_sigma_yaw_rad: prior of the yaw error.
        min_chi2: least squared length of the estimate in units of its own covariance.
    """

    min_score: float = 0.2
    peak_radius_m: float = 2.0
    max_peaks: int = 48
    max_shift_m: float = 2.5
    min_pairs: int = 3
    vote_m: float = 0.5
    match_m: float = 1.25
    max_second: float = 0.8
    object_sigma_m: float = 0.3
    prior_sigma_m: float = 1.0
    prior_sigma_yaw_rad: float = 0.014
    min_chi2: float = 2.0


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

    covariance: (3, 3) of x, y, yaw after the correction. num_pairs: that it rests on.
    """

    shift: F64
    yaw: float
    origin: F64
    covariance: F64
    num_pairs: int

    def move(self, xy: F64) -> F64:
        """Return corrected positions (n, 2)."""
        arm = xy - self.origin
        return xy + self.shift + self.yaw * np.stack((-arm[:, 1], arm[:, 0]), 1)

    def sigma_m(self, xy: F64) -> F64:
        """Return the standard deviation (n,) of corrected positions, the mean of both axes."""
        arm = xy - self.origin
        of_xy = (self.covariance[0, 0] + self.covariance[1, 1]) / 2
        return np.sqrt(of_xy + self.covariance[2, 2] * (arm**2).sum(1) / 2)


def estimate_shift(ego: Peaks, sender: Peaks, origin: F64, config: ShiftConfig = DEFAULT_SHIFT) -> SenderShift | None:
    """Return the correction of a sender at origin (2,) in the ego's frame; None where the peaks do not give one."""
    settings = ShiftSettings(**{name: getattr(config, name) for name in ShiftSettings._fields})
    partner, mode = np.empty(len(sender.center), np.int64), np.empty(2)
    if not _shift_kernels.find_mode(ego.center, ego.weight, sender.center, sender.weight, settings, mode):
        return None
    num_pairs = _shift_kernels.match_peaks(ego.center, sender.center, mode, settings, partner)
    if num_pairs < config.min_pairs:
        return None
    rows = (partner >= 0).nonzero()[0]
    columns = partner[rows]
    variance = config.object_sigma_m**2 + sender.sigma[rows] ** 2 + ego.sigma[columns] ** 2
    precision = np.sqrt(ego.weight[columns] * sender.weight[rows]) / variance
    measured, arm = ego.center[columns] - sender.center[rows], sender.center[rows] - origin
    estimate, covariance = np.empty(3), np.empty((3, 3))
    chi2 = _shift_kernels.solve_pairs(arm, measured, precision, settings, estimate, covariance)
    if not (chi2 >= config.min_chi2 and np.isfinite(estimate).all()):
        return None
    return SenderShift(estimate[:2], float(estimate[2]), origin, covariance, num_pairs)


def find_peaks(xy: F64, heat: F64, sigma: F64, config: ShiftConfig = DEFAULT_SHIFT) -> Peaks:
    """Return the peaks of proposed centres (n, 2), heat logits (n,), sigmas (n,), metres; the most confident first."""
    score = 1 / (1 + np.exp(-np.clip(heat, -30, 30)))
    order = np.argsort(-score, kind="stable")
    order = order[(score[order] >= config.min_score) & np.isfinite(xy[order]).all(1)][: 8 * config.max_peaks]
    row = np.empty(config.max_peaks, np.int64)
    kept = row[: _shift_kernels.pick_peaks(xy, order, config.peak_radius_m, row)]
    return Peaks(xy[kept], score[kept], np.clip(sigma[kept], 0.0, 2.0))


def align_senders(tokens: Tokens, config: ShiftConfig = DEFAULT_SHIFT) -> Tokens:
    """Return the tokens with those of each sender moved by its estimated correction, and the position sigma that is left.

    Tokens of senders without an estimate, and the ego's own current ones, stay as they are. There is no gradient to positions;
    that of features stays.
    """
    with torch.no_grad():
        places, pose_context = _find_places(tokens, config)
        inside = (tokens.sender == 0) | tokens.grid.contains(places)
        rows = None if bool(inside.all()) else inside.nonzero()[:, 0]
    aligned = replace(tokens, xy=places, pose_context=pose_context)
    return aligned if rows is None else aligned.select(rows)


def _find_places(tokens: Tokens, config: ShiftConfig) -> tuple[Tensor, Tensor]:
    """Return the corrected positions and pose contexts."""
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
    for number in np.unique(group[senders > 0]):
        mine = group == number
        peaks = find_peaks(center[mine], heat[mine], sigma[mine], config)
        found = estimate_shift(
            own_peaks[int(egos[mine][0])], peaks, _origin(xy[mine], sender_xy[mine], context[mine]), config
        )
        if found is not None:
            moved[mine] = found.move(xy[mine])
            left[mine] = found.sigma_m(xy[mine])
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
    module.register_forward_pre_hook(lambda _, given: (align_senders(given[0]), *given[1:]))
    return module


register_fusion("shift/fast")(_build_aligned_fast)
