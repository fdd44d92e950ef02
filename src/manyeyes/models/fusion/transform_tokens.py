# SPDX-License-Identifier: Apache-2.0
"""Transform the tokens of several agents to the ego's frame, at continuous metric positions (CoSTr section III-D.1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Transform
from manyeyes.models.detector.proposal import PROPOSAL_DIM, move_proposal, proposed_velocity

POSE_CONTEXT_DIM = 5
MAX_SPEED_MPS = 40.0
"""Maximum proposed speed that is used to compensate motion; faster proposals are not moved."""


@dataclass(frozen=True, eq=False)
class AgentTokens:
    """Tokens that one agent shared of one instant with one ego of a batch.

    Attributes:
        ego: index of the receiving ego in the batch.
        tokens: (n, C + PROPOSAL_DIM).
        xy: (n, 2) positions in the sender's frame, metres.
        ego_from_sender: from the sender's frame at that instant to the ego's current frame; None for the ego's own
            current tokens.
        age_s: time since the observation.
        sigma_xy_m: standard deviation of the reported position.
        sigma_yaw_rad: standard deviation of the reported heading.
        selection_mask: (n,) ones that carry the gradient of the selection; None without selection.
    """

    ego: int
    tokens: Tensor
    xy: Tensor
    ego_from_sender: Transform | None = None
    age_s: float = 0.0
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    selection_mask: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Tokens:
    """N tokens around a batch of egos; cells of different agents may coincide.

    Attributes:
        features: (N, C).
        xy: (N, 2) motion-compensated positions in the ego's frame, metres.
        ego: (N,) int64, index of the ego in the batch.
        pose_context: (N, POSE_CONTEXT_DIM) height [m], sine and cosine - 1 of the relative yaw, position sigma [m],
            age [100 ms]; zero for the ego's own current tokens.
        proposal: (N, PROPOSAL_DIM) in the ego's axes, relative to the token.
        selection_mask: (N,) as in AgentTokens.
    """

    features: Tensor
    xy: Tensor
    ego: Tensor
    pose_context: Tensor
    proposal: Tensor
    selection_mask: Tensor
    grid: BevGrid
    batch_size: int

    @property
    def sigma_m(self) -> Tensor:
        """(N,) position standard deviations, metres."""
        return self.pose_context[:, 3]

    @property
    def age(self) -> Tensor:
        """(N,) token ages in units of 100 ms, the time step of CoSTr Eq. 9."""
        return self.pose_context[:, 4]


def rotate_vectors(features: Tensor, yaw: Tensor) -> Tensor:
    """Rotate the vector channels of features (N, C) by a scalar yaw.

    The first half of the channels are (x, y) pairs of vectors in the sender's frame; the second half are scalars and
    stay.
    """
    channels = features.shape[1]
    pairs = features[:, : channels // 2].reshape(features.shape[0], channels // 4, 2)
    c, s = yaw.cos().to(features.dtype), yaw.sin().to(features.dtype)
    turned = torch.stack((pairs[..., 0] * c - pairs[..., 1] * s, pairs[..., 0] * s + pairs[..., 1] * c), -1)
    return torch.cat((turned.flatten(1), features[:, channels // 2 :]), 1)


def to_ego_frame(agent_tokens: Iterable[AgentTokens], grid: BevGrid, batch_size: int) -> Tokens:
    """Transform the tokens of all agents to their egos' frames and drop those outside the ego's range; grid: of all
    tokens.
    """
    columns = [_transform_part(part, grid) for part in agent_tokens]
    features, places, egos, cues, proposals, kept = (torch.cat(column) for column in zip(*columns))
    return Tokens(features, places, egos, cues, proposals, kept, grid, batch_size)


def _transform_part(part: AgentTokens, grid: BevGrid) -> tuple[Tensor, ...]:
    feature, proposal, xy = part.tokens[:, :-PROPOSAL_DIM], part.tokens[:, -PROPOSAL_DIM:], part.xy
    n = feature.shape[0]
    ego = torch.full((n,), part.ego, dtype=torch.int64, device=feature.device)
    selection_mask = feature.new_ones(n) if part.selection_mask is None else part.selection_mask
    if part.ego_from_sender is None:
        return feature, xy, ego, feature.new_zeros(n, POSE_CONTEXT_DIM), proposal, selection_mask
    if part.age_s:
        velocity = proposed_velocity(proposal)
        xy = xy + velocity * part.age_s * (velocity.norm(dim=1, keepdim=True) <= MAX_SPEED_MPS)
    yaw = part.ego_from_sender.yaw
    moved = part.ego_from_sender.apply(torch.cat((xy, xy.new_zeros(n, 1)), 1).double())
    height = moved[:, 2].to(feature.dtype)
    sigma_m = (part.sigma_xy_m**2 + (part.sigma_yaw_rad * xy.norm(dim=1)) ** 2).sqrt()
    same = torch.stack((yaw.sin(), yaw.cos() - 1)).to(feature.dtype).expand(n, 2)
    age = torch.full_like(sigma_m, part.age_s / 0.1)
    pose_context = torch.cat((height[:, None], same, sigma_m[:, None], age[:, None]), 1)
    xy = moved[:, :2].float()
    near = grid.contains(xy)
    columns = (
        rotate_vectors(feature, yaw),
        xy,
        ego,
        pose_context,
        move_proposal(proposal, yaw, height),
        selection_mask,
    )
    return tuple(column[near] for column in columns)
