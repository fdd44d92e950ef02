# SPDX-License-Identifier: Apache-2.0
"""Evidence of one frame on each claim: the ego's detections, its rays, and the claims of third agents.

Source of the idea to check claims against free and occupied space: Zhang et al., "On Data Fabrication in Collaborative Vehicular
Perception: Attacks and Countermeasures" (CAD, USENIX Security 2024); here by single rays instead of polygons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.trust.association import Floats, associate
from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.interface import Evidence
from manyeyes.datatypes import AgentFrame, Boxes
from manyeyes.ops.lidar.box_rays import BoxRays, count_box_rays

Kinds = NDArray[np.uint8]


@dataclass(frozen=True)
class EvidenceConfig:
    """Constants of evidence on one claim.

    min_score: of an assessed claim. min_own_score: of a detection of the ego that supports a claim. gate_m: of a match, beyond two
    standard deviations. max_range_m: of ray tests. margin_m: by which a box is shrunk, beyond the larger of min_sigma_m and its
    standard deviation; max_shrink_m: no test beyond. min_passing: rays that refute, if they are also passing_ratio times the hits.
    min_hits: returns that support. min_corroborating_trust: of a third agent. max_copied: fraction of equal boxes of two senders,
    within copy_m, above which they are one source.
    """

    min_score: float = 0.3
    min_own_score: float = 0.3
    gate_m: float = 2.0
    max_range_m: float = 60.0
    margin_m: float = 0.3
    min_sigma_m: float = 0.3
    max_shrink_m: float = 0.9
    min_passing: int = 10
    passing_ratio: float = 4.0
    min_hits: int = 5
    min_corroborating_trust: float = 0.8
    max_copied: float = 0.6
    copy_m: float = 0.02


@dataclass(frozen=True)
class CheckedClaims:
    """Claims of one sender of min_score (N), with evidence: xy (N, 2) metres, in the ego's frame; kinds (N,) of Evidence.

    corroborated: (N,) bool, a trusted third agent claims it too, whatever the ego's evidence is.
    """

    claims: Claims
    xy: Floats
    score: Floats
    sigma_m: Floats
    kinds: Kinds
    corroborated: NDArray[np.bool_]


def check_claims(
    frame: AgentFrame, own: Boxes, claims: Sequence[Claims], trust: Mapping[int, float], config: EvidenceConfig
) -> tuple[CheckedClaims, ...]:
    """Return the evidence on all claims of one frame. trust: in each sender, before this frame."""
    kept = [_keep(one, config) for one in claims]
    places = [one.boxes.center[:, :2].double().numpy() for one in kept]
    sigma = [one.sigma_m.double().numpy() for one in kept]
    mine = own.center[own.score >= config.min_own_score, :2].double().numpy()
    is_matched = [associate(xy, mine, config.gate_m + 2 * s) >= 0 for xy, s in zip(places, sigma)]
    kinds = [np.where(matched, np.uint8(Evidence.SUPPORTED), np.uint8(Evidence.UNCHECKED)) for matched in is_matched]
    _check_rays(frame, kept, kinds, config)
    checked = list[CheckedClaims]()
    for n, one in enumerate(kept):
        corroborated = np.zeros(len(one), np.bool_)
        for k, third in enumerate(kept):
            is_trusted = trust.get(third.agent_id, 0.0) >= config.min_corroborating_trust
            if k != n and is_trusted and not are_copies(places[n], places[k], config):
                corroborated |= associate(places[n], places[k], config.gate_m + 2 * np.maximum(sigma[n], 0)) >= 0
        kinds[n][corroborated & (kinds[n] == Evidence.UNCHECKED)] = Evidence.CORROBORATED
        score = one.boxes.score.double().numpy()
        checked.append(CheckedClaims(one, places[n], score, sigma[n], kinds[n], corroborated))
    return tuple(checked)


def are_copies(one: Floats, other: Floats, config: EvidenceConfig) -> bool:
    """Return whether two senders state so many equal boxes that they are one source. Positions (N, 2) and (M, 2)."""
    fewest = min(len(one), len(other))
    if fewest < 2:
        return False
    is_equal = associate(one, other, config.copy_m) >= 0
    return bool(is_equal.sum() > config.max_copied * fewest)


def classify_rays(rays: BoxRays, config: EvidenceConfig) -> Kinds:
    """Return (K,) the evidence of rays on boxes."""
    passing, hits = rays.num_passing.numpy(), rays.num_hits.numpy()
    is_refuted = (passing >= config.min_passing) & (passing >= config.passing_ratio * hits)
    is_supported = (hits >= config.min_hits) & ~is_refuted
    return np.where(is_refuted, Evidence.REFUTED, np.where(is_supported, Evidence.SUPPORTED, 0)).astype(np.uint8)


def _keep(claims: Claims, config: EvidenceConfig) -> Claims:
    """Return the claims of min_score whose position is known."""
    is_kept = (claims.boxes.score >= config.min_score) & torch.isfinite(claims.sigma_m)
    is_kept &= torch.isfinite(claims.boxes.center).all(1)
    return Claims(
        claims.agent_id,
        claims.boxes[is_kept],
        claims.sigma_m[is_kept],
        claims.sender_xy,
        claims.age_s,
        claims.is_complete,
    )


def _check_rays(frame: AgentFrame, claims: Sequence[Claims], kinds: Sequence[Kinds], config: EvidenceConfig) -> None:
    """Set the evidence on the unmatched claims of all senders, in place."""
    origin = torch.tensor([0.0, 0.0, frame.sensor_height_m], dtype=torch.float64)
    rows, boxes, shrink = list[torch.Tensor](), list[Boxes](), list[torch.Tensor]()
    for one, kind in zip(claims, kinds):
        margin = config.margin_m + one.sigma_m.double().clamp_min(config.min_sigma_m)
        is_near = one.boxes.center[:, :2].double().norm(dim=1) <= config.max_range_m
        tested = torch.from_numpy(kind == Evidence.UNCHECKED) & is_near & (margin <= config.max_shrink_m)
        rows.append(tested.nonzero()[:, 0])
        boxes.append(one.boxes[rows[-1]])
        shrink.append(margin[rows[-1]])
    if not sum(map(len, rows)):
        return
    rays = count_box_rays(frame.points.xyz, origin, Boxes.cat(boxes), torch.cat(shrink))
    found, at = classify_rays(rays, config), 0
    for tested, kind in zip(rows, kinds):
        kind[tested.numpy()] = found[at : at + len(tested)]
        at += len(tested)
