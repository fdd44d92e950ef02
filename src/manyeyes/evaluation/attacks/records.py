# SPDX-License-Identifier: Apache-2.0
"""What is kept of one drive under an attack: matched frames, and frame by frame each sender's assessment and each false claim."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from manyeyes.evaluation.detection.frame_match import FrameMatch

NO_EVIDENCE = -1


@dataclass(frozen=True)
class SenderRecord:
    """One sender as one ego assesses it, in each of F frames since the attack began.

    is_received: (F,) bool, a message took part or was assessed. trust: (F,) in [0, 1]; 1 where it was not assessed. is_named: (F,)
    bool, the defence names it malicious.
    """

    ego: int
    sender: int
    is_malicious: bool
    is_received: Tensor
    trust: Tensor
    is_named: Tensor


@dataclass(frozen=True)
class ClaimRecord:
    """One invented object, in each of F frames since the attack began.

    is_sent: (F,) bool. num_rays: (F,) int64, rays that cross it, of the honest agent with most of them; num_ego_rays: of the ego.
    is_near_real: a real object
    was within 1 m of it at any time. score: (F,) of the ego's best box within 2 m of it, without a real object as near; 0 without.
    evidence: (F,) int64 on that box, NO_EVIDENCE without; trust: (F,) in its sender, after the frame.
    """

    ego: int
    sender: int
    claim: int
    is_near_real: bool
    is_sent: Tensor
    num_rays: Tensor
    num_ego_rays: Tensor
    score: Tensor
    evidence: Tensor
    trust: Tensor


@dataclass(frozen=True)
class DriveRecord:
    """One scenario under one condition.

    egos: the roles that were played. matches: evaluated frames at each of IOU_THRESHOLDS. frame_s: period of the recording.
    mean_bytes: of a message; perceive_ms: mean.
    """

    scenario: str
    egos: tuple[int, ...]
    matches: tuple[tuple[FrameMatch, ...], ...]
    senders: tuple[SenderRecord, ...]
    claims: tuple[ClaimRecord, ...]
    frame_s: float
    mean_bytes: float
    perceive_ms: float
