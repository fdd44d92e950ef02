# SPDX-License-Identifier: Apache-2.0
"""Transform the tokens of several agents to the ego's frame, at continuous metric positions (CoSTr section III-D.1)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Transform
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_velocity, turn_proposal
from manyeyes.models.fusion._transform_kernels import GridCells, MovedTokens, ProposalColumns, move_tokens

POSE_CONTEXT_DIM = 5
MAX_SPEED_MPS = 40.0
"""Maximum proposed speed that is used to compensate motion; faster proposals are not moved."""
PROPOSAL_COLUMNS = ProposalColumns(
    BOX_LAYOUT.heatmap_logit.start,
    BOX_LAYOUT.offset.start,
    BOX_LAYOUT.z.start,
    BOX_LAYOUT.axis.start,
    BOX_LAYOUT.direction.start,
    BOX_LAYOUT.velocity.start,
    SPEED_UNIT,
)
"""Columns of a proposal for the compiled loops."""


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
        is_infrastructure: whether the sender is a roadside unit.
    """

    ego: int
    tokens: Tensor
    xy: Tensor
    ego_from_sender: Transform | None = None
    age_s: float = 0.0
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    selection_mask: Tensor | None = None
    is_infrastructure: bool = False


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
        sender: (N,) int64, 0 for the ego's own current tokens; each message and each earlier instant has a number of its own.
        infrastructure: (N,) bool, whether the sender is a roadside unit.
        sender_xy: (N, 2) positions in the sender's frame at the time of observation, metres.
    """

    features: Tensor
    xy: Tensor
    ego: Tensor
    pose_context: Tensor
    proposal: Tensor
    selection_mask: Tensor
    sender: Tensor
    infrastructure: Tensor
    sender_xy: Tensor
    grid: BevGrid
    batch_size: int

    def to(self, device: torch.device) -> Tokens:
        """Return the same tokens on a device."""
        if self.features.device == device:
            return self
        return replace(self, **{name: getattr(self, name).to(device) for name in TOKEN_COLUMNS})

    def select(self, rows: Tensor) -> Tokens:
        """Return the tokens of rows (n,) int64."""
        return replace(self, **{name: getattr(self, name).index_select(0, rows) for name in TOKEN_COLUMNS})

    @property
    def sigma_m(self) -> Tensor:
        """(N,) position standard deviations, metres."""
        return self.pose_context[:, 3]

    @property
    def age(self) -> Tensor:
        """(N,) token ages in units of 100 ms, the time step of CoSTr Eq. 9."""
        return self.pose_context[:, 4]


TOKEN_COLUMNS = tuple(f.name for f in fields(Tokens) if f.name not in ("grid", "batch_size"))
"""Fields of Tokens with one row a token."""


def rotate_vectors(features: Tensor, yaw: Tensor) -> Tensor:
    """Rotate the vector channels of features (N, C) by a scalar yaw.

    The first half of the channels are (x, y) pairs of vectors in the sender's frame; the second half are scalars and
    stay.
    """
    return _rotate_pairs(features, yaw.cos().to(features.dtype), yaw.sin().to(features.dtype))


def _rotate_pairs(features: Tensor, c: Tensor, s: Tensor) -> Tensor:
    """Rotate the vector channels by the angle of this cosine and sine, scalars or (N, 1)."""
    channels = features.shape[1]
    pairs = features[:, : channels // 2].reshape(features.shape[0], channels // 4, 2)
    turned = torch.stack((pairs[..., 0] * c - pairs[..., 1] * s, pairs[..., 0] * s + pairs[..., 1] * c), -1)
    return torch.cat((turned.flatten(1), features[:, channels // 2 :]), 1)


def to_ego_frame(agent_tokens: Iterable[AgentTokens], grid: BevGrid, batch_size: int) -> Tokens:
    """Transform the tokens of all agents to their egos' frames and drop those outside the ego's range; grid: of all
    tokens.
    """
    parts = list(agent_tokens)
    tokens, sender_xy = torch.cat([part.tokens for part in parts]), torch.cat([part.xy for part in parts])
    if all(part.selection_mask is None for part in parts) and is_plain(tokens, sender_xy):
        return _transform_in_loops(parts, tokens, sender_xy, grid, batch_size)
    sizes, device = [part.tokens.shape[0] for part in parts], parts[0].tokens.device
    masks = [
        part.tokens.new_ones(size) if part.selection_mask is None else part.selection_mask
        for part, size in zip(parts, sizes)
    ]
    number, xy = _part_numbers(parts), sender_xy
    # All numbers of all senders go to the device in one copy, and their tokens are transformed together.
    link = _describe_links(parts).to(device).index_select(0, number.to(device))
    feature, proposal = tokens[:, :-PROPOSAL_DIM], tokens[:, -PROPOSAL_DIM:]
    is_own, age_s = link[:, 0] > 0, link[:, 2:3].to(feature.dtype)
    velocity = proposed_velocity(proposal)
    driven = velocity * age_s * (velocity.norm(dim=1, keepdim=True) <= MAX_SPEED_MPS)
    xy = torch.where(age_s > 0, xy + driven, xy)
    rotation, translation = link[:, 8:17].unflatten(1, (3, 3)), link[:, 17:20]
    x, y = xy.double()[:, :1], xy.double()[:, 1:]
    moved = rotation[:, :, 0] * x + rotation[:, :, 1] * y + translation
    height = moved[:, 2].to(feature.dtype)
    sigma_xy_m, sigma_yaw_rad, sine, cosine, less = link[:, 3:8].to(feature.dtype).split(1, 1)
    sigma_m = (sigma_xy_m**2 + (sigma_yaw_rad * xy.norm(dim=1, keepdim=True)) ** 2).sqrt()
    pose_context = torch.cat((height[:, None], sine, less, sigma_m, (link[:, 2:3] / 0.1).to(feature.dtype)), 1)
    pose_context = pose_context.masked_fill(is_own[:, None], 0.0)
    xy = torch.where(is_own[:, None], xy, moved[:, :2].float())
    columns = (
        _rotate_pairs(feature, cosine, sine),
        xy,
        link[:, 1].long(),
        pose_context,
        turn_proposal(proposal, cosine, sine, height),
        torch.cat(masks),
        link[:, 20].long(),
        link[:, 21] > 0,
        sender_xy,
    )
    moved = Tokens(*columns, grid, batch_size)
    return moved.select((is_own | grid.contains(xy)).nonzero()[:, 0])


def is_plain(*tensors: Tensor) -> bool:
    """Return whether compiled loops can take these tensors: float32 on the CPU, and none needs a gradient."""
    return all(
        t.device.type == "cpu" and t.dtype == torch.float32 and not (t.requires_grad and torch.is_grad_enabled())
        for t in tensors
    )


def grid_cells(grid: BevGrid) -> GridCells:
    """Return a grid for the compiled loops."""
    x_min, y_min, x_max, y_max = (float(v) for v in (grid.x_min, grid.y_min, grid.x_max, grid.y_max))
    return GridCells(x_min, y_min, x_max, y_max, float(grid.pillar), grid.stride, *grid.shape)


def split_last(tokens: Tokens, num_parts: int) -> Tokens:
    """Return the tokens of the parts after the first num_parts, of which the first is the ego's own; one ego.

    As ``to_ego_frame`` of those parts alone.
    """
    first = int((tokens.sender < num_parts).sum())
    columns = {name: getattr(tokens, name)[first:] for name in TOKEN_COLUMNS}
    return Tokens(**columns | {"sender": columns["sender"] - (num_parts - 1)}, grid=tokens.grid, batch_size=1)


def are_last_rows(some: Tokens, tokens: Tokens) -> bool:
    """Return whether tokens are views of the last rows of others, as ``split_last`` makes them: their encodings are equal."""
    first = len(tokens.features) - len(some.features)
    is_on_cpu = some.features.device.type == tokens.features.device.type == "cpu"
    if not is_on_cpu or first < 0 or some.grid != tokens.grid or (some.batch_size, tokens.batch_size) != (1, 1):
        return False
    names = ("features", "xy", "pose_context", "proposal")
    return all(getattr(some, n).data_ptr() == getattr(tokens, n)[first:].data_ptr() for n in names)


def _transform_in_loops(
    parts: Sequence[AgentTokens], tokens: Tensor, xy: Tensor, grid: BevGrid, batch_size: int
) -> Tokens:
    """Transform tokens and places of all parts as by tensors, without masks."""
    widths = (tokens.shape[1] - PROPOSAL_DIM, 2, POSE_CONTEXT_DIM, PROPOSAL_DIM)
    columns = [xy.new_empty(len(xy), width) for width in widths]
    row = xy.new_empty(len(xy), dtype=torch.int64)
    features, places, context, proposal = (column.numpy() for column in columns)
    out = MovedTokens(features, places, context, proposal, row.numpy())
    sizes, links = np.array([len(part.xy) for part in parts]), _describe_links(parts).numpy()
    count = move_tokens(
        tokens.numpy(), xy.numpy(), sizes, links, MAX_SPEED_MPS, PROPOSAL_COLUMNS, grid_cells(grid), out
    )
    features, places, context, proposal = (column[:count] for column in columns)
    part = np.arange(len(parts)).repeat(sizes)[out.row[:count]]
    ego, sender, infrastructure = (torch.from_numpy(links[:, k].astype(np.int64)[part]) for k in (1, 20, 21))
    mask, sender_xy = xy.new_ones(count), xy[row[:count]]
    return Tokens(
        features, places, ego, context, proposal, mask, sender, infrastructure > 0, sender_xy, grid, batch_size
    )


def _part_numbers(parts: Sequence[AgentTokens]) -> Tensor:
    """Return the number of the part (N,) int64 of each token, on the CPU."""
    sizes = torch.tensor([part.tokens.shape[0] for part in parts], device="cpu")
    return torch.arange(len(parts), device="cpu").repeat_interleave(sizes)


def _number_senders(parts: Sequence[AgentTokens]) -> list[int]:
    """Return 0 for each part of an ego's own current tokens, and for the others of each ego 1, 2, ... in their order."""
    counts, numbers = dict[int, int](), list[int]()
    for part in parts:
        is_own = part.ego_from_sender is None
        counts[part.ego] = counts.get(part.ego, 0) + (not is_own)
        numbers.append(0 if is_own else counts[part.ego])
    return numbers


def _describe_links(parts: Sequence[AgentTokens]) -> Tensor:
    """Return (parts, 22) float64 on the CPU.

    Whether the tokens are the ego's current ones, the number of the ego, age, both sigmas, sine, cosine and cosine - 1 of the
    yaw, rotation (9), translation (3), the number of the sender, and whether it is a roadside unit.
    """
    links = np.zeros((len(parts), 22))
    links[:, [8, 12, 16]] = 1.0
    for link, part, number in zip(links, parts, _number_senders(parts)):
        motion = part.ego_from_sender
        link[:5] = motion is None, part.ego, part.age_s, part.sigma_xy_m, part.sigma_yaw_rad
        link[20:] = number, part.is_infrastructure
        if motion is not None:
            link[8:17], link[17:20] = motion.rotation.flatten().cpu().numpy(), motion.translation.cpu().numpy()
    yaw = np.arctan2(links[:, 11], links[:, 8])
    links[:, 5], links[:, 6] = np.sin(yaw), np.cos(yaw)
    links[:, 7] = links[:, 6] - 1
    return torch.from_numpy(links)
