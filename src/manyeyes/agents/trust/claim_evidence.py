# SPDX-License-Identifier: Apache-2.0
"""Evidence of one frame on each claim: the ego's detections, its rays, and the claims of third agents.

Source of the idea to check claims against free and occupied space: Zhang et al., "On Data Fabrication in Collaborative Vehicular
Perception: Attacks and Countermeasures" (CAD, USENIX Security 2024); here by single rays instead of polygons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import I64x2
from manyeyes.agents.trust._association_kernels import match_claims
from manyeyes.agents.trust.association import Floats
from manyeyes.agents.trust.claims import Claims
from manyeyes.agents.trust.interface import Evidence
from manyeyes.datatypes import AgentFrame
from manyeyes.ops.lidar.box_rays import count_rays_of_columns, place_on_ground

Kinds = NDArray[np.uint8]
# Members of an enumeration are slow to read.
_UNCHECKED, _SUPPORTED = int(Evidence.UNCHECKED), int(Evidence.SUPPORTED)
_CORROBORATED, _REFUTED = int(Evidence.CORROBORATED), int(Evidence.REFUTED)


@dataclass(frozen=True)
class ClaimCheckConfig:
    """Constants of evidence on one claim.

    min_own_score: of a detection of the ego that supports a claim. gate_m: of a match, beyond two
    standard deviations. max_range_m: of ray tests. margin_m: of a box in a ray test, beyond the larger of min_sigma_m and its
    standard deviation; max_margin_m: no test beyond. min_passing: rays that refute, if they are also passing_ratio times the
    hits, or if no hit is an inner one: those are of a wall or another object beside the box.
    min_hits: returns that support. min_corroborating_trust, min_corroborating_score: of a third agent, and of its claim; weaker
    claims are often errors, beside which a false claim would seem to be true. max_copied: fraction of equal boxes of two
    senders, within copy_m, above which they are one source; min_apart_m: of two senders, below which they are one: identities
    of one attacker, as two vehicles cannot be at one place.
    """

    min_own_score: float = 0.3
    gate_m: float = 2.0
    max_range_m: float = 60.0
    margin_m: float = 0.3
    min_sigma_m: float = 0.3
    max_margin_m: float = 0.9
    min_passing: int = 10
    passing_ratio: float = 4.0
    min_hits: int = 5
    min_corroborating_trust: float = 0.8
    min_corroborating_score: float = 0.5
    max_copied: float = 0.6
    copy_m: float = 0.02
    min_apart_m: float = 2.0

    @property
    def sources(self) -> tuple[float, float, float]:
        """Limits by which two senders are one source: copy_m, max_copied, min_apart_m."""
        return self.copy_m, self.max_copied, self.min_apart_m


@dataclass(frozen=True)
class CheckedClaims:
    """Claims of one sender (N), with evidence: kinds (N,) of Evidence.

    is_detected: (N,) bool, the ego detects it. corroborated: (N,) bool, a trusted third agent claims it too, whatever the ego's
    evidence is. is_uncounted: (N,) bool, refuted, hence removed, but no trust changes: only a minority of senders refutes it, or it
    may be the ego itself, displaced by an error of pose.
    """

    claims: Claims
    kinds: Kinds
    is_detected: NDArray[np.bool_]
    corroborated: NDArray[np.bool_]
    is_uncounted: NDArray[np.bool_]

    def refute(self, is_denied: NDArray[np.bool_], is_minority: NDArray[np.bool_]) -> CheckedClaims:
        """Return the claims where the denied ones (N,) that the ego itself cannot check are refuted."""
        is_denied = is_denied & ((self.kinds == _UNCHECKED) | (self.kinds == _CORROBORATED))
        kinds = np.where(is_denied, np.uint8(_REFUTED), self.kinds)
        return replace(self, kinds=kinds, is_uncounted=self.is_uncounted | (is_denied & is_minority))


def check_claims(
    frame: AgentFrame,
    own: Floats,
    claims: Sequence[Claims],
    trust: Mapping[int, float],
    config: ClaimCheckConfig,
    probes: Floats,
) -> tuple[tuple[CheckedClaims, ...], I64x2]:
    """Return the evidence on all claims of one frame, and passing rays, hits and inner hits (P, 3) of probes.

    Args:
        own: (K, 2) metres, the ego's detections of min_own_score. trust: in each sender, before this frame.
        probes: (P, 7) further boxes, centre, size and yaw, whose rays are counted, without margin.
    """
    sizes = np.cumsum([0, *map(len, claims)])
    columns = np.concatenate([np.zeros((0, 7)), *(one.columns for one in claims)])
    sigma_m, xy = np.concatenate([np.zeros(0), *(one.sigma_m for one in claims)]), columns[:, :2].copy()
    is_trusted = np.array([trust.get(one.agent_id, 0.0) >= config.min_corroborating_trust for one in claims], np.bool_)
    is_likely = np.concatenate([np.zeros(0), *(one.score for one in claims)]) >= config.min_corroborating_score
    gates, places = config.gate_m + 2 * sigma_m, np.ascontiguousarray(own)
    senders = np.array([one.sender_xy for one in claims], np.float64).reshape(-1, 2)
    is_own, is_third = match_claims(xy, gates, is_likely, sizes, places, is_trusted, senders, config.sources)
    kinds = is_own * np.uint8(_SUPPORTED)
    rays = _check_rays(frame, columns, sigma_m, kinds, config, probes)
    kinds[is_third & (kinds == _UNCHECKED)] = _CORROBORATED
    # The ego does not detect itself, and its rays pass through every other place around it.
    is_ego = (kinds == _REFUTED) & _is_near_ego(frame, xy, gates)
    checked = (
        CheckedClaims(one, kinds[a:b], is_own[a:b], is_third[a:b], is_ego[a:b])
        for one, a, b in zip(claims, sizes, sizes[1:])
    )
    return tuple(checked), rays


def _is_near_ego(frame: AgentFrame, xy: Floats, gate_m: Floats) -> NDArray[np.bool_]:
    """Return (N,) which of the positions (N, 2) are within a gate (N,) of the ego's own vehicle; roadside units have none."""
    if frame.is_infrastructure:
        return np.zeros(len(xy), np.bool_)
    x, y = (0.0, 0.0) if frame.body is None else frame.body.center[:2]
    return np.hypot(xy[:, 0] - x, xy[:, 1] - y) < gate_m


def classify_rays(rays: I64x2, config: ClaimCheckConfig) -> Kinds:
    """Return (K,) the evidence of passing rays, hits and inner hits (K, 3) of boxes."""
    passing, hits, inner = rays.T
    is_refuted = (passing >= config.min_passing) & ((passing >= config.passing_ratio * hits) | (inner == 0))
    is_supported = (hits >= config.min_hits) & ~is_refuted
    return (is_refuted * _REFUTED + is_supported * _SUPPORTED).astype(np.uint8)


def _check_rays(
    frame: AgentFrame, columns: Floats, sigma_m: Floats, kinds: Kinds, config: ClaimCheckConfig, probes: Floats
) -> I64x2:
    """Set the evidence on the unmatched claims of all senders, in place; return the rays of the probes.

    columns (N, 7), sigma_m (N,), kinds (N,): of all claims.
    """
    margin = config.margin_m + np.maximum(sigma_m, config.min_sigma_m)
    is_near = np.hypot(columns[:, 0], columns[:, 1]) <= config.max_range_m
    tested = np.flatnonzero((kinds == _UNCHECKED) & is_near & (margin <= config.max_margin_m))
    # Heights of claims are those that the sender states, in the plane of its own ground.
    xyz, margins = frame.points.xyz.numpy(), margin[tested]
    boxes = place_on_ground(xyz, columns[tested])
    if len(probes):
        boxes, margins = np.concatenate((boxes, probes)), np.concatenate((margins, np.zeros(len(probes))))
    rays = count_rays_of_columns(xyz, frame.sensor_height_m, boxes, margins)
    kinds[tested] = classify_rays(rays[: len(tested)], config)
    return rays[len(tested) :]
