# SPDX-License-Identifier: Apache-2.0
"""Request maps: a receiver's confidence on a coarse grid, and the weights of a sender's tokens that follow from it.

A receiver broadcasts one byte a window (``RequestMap``). A sender transforms its tokens to each receiver's frame, by the prior
poses of the messages, and lowers the scores of tokens in confident windows. The maximum weight counts: one message serves all.
Compare Where2comm's request map (Hu et al., NeurIPS 2022, section 3.3), which is dense and as fine as the features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError, Transform
from manyeyes.datatypes.message import Message, RequestMap


def build_request_map(xy: Tensor, confidence: Tensor, windows: BevGrid) -> RequestMap:
    """Return one agent's request map over a coarse grid: the minimum confidence (N,) in [0, 1] of each window, 0 without objects.

    xy: (N, 2) metres in the agent's frame, positions of its objects; confidence: their scores. The minimum requests tokens where
    one of two vehicles is uncertain.
    """
    if confidence.shape != (len(xy),) or not bool(((confidence >= 0) & (confidence <= 1)).all()):
        raise ConfigError(f"confidence needs ({len(xy)},) in [0, 1]; got {tuple(confidence.shape)}.")
    rows, columns = windows.shape
    near = windows.contains(xy)
    yx = windows.cells(xy[near])
    cell = yx[:, 0] * columns + yx[:, 1]
    min_confidence = torch.full((rows * columns,), torch.inf).scatter_reduce(0, cell, confidence[near].float(), "amin")
    return RequestMap(windows, torch.where(min_confidence.isinf(), 0.0, min_confidence).view(rows, columns))


def compute_request_weights(
    xy: Tensor, world_from_sender: Transform, requests: Sequence[Message], min_weight: float = 0.1
) -> Tensor:
    """Return weights (N,) in [min_weight, 1] of the positive scores of tokens at xy (N, 2), metres in the sender's frame.

    requests: messages with a request map; without any, all weights are 1. For one receiver the weight is 1 - confidence of the
    token's window, and 0 outside the map; the maximum over receivers counts. ``min_weight`` keeps the order of tokens that no
    receiver requests, for receivers without a request map.
    """
    requesting = [m for m in requests if m.request is not None]
    if not requesting:
        return torch.ones(len(xy))
    weights = torch.stack(
        [_request_weight(xy, world_from_sender, m.world_from_agent, m.request) for m in requesting if m.request]
    )
    return weights.amax(0).clamp_min(min_weight)


def read_request_map(
    xy: Tensor, world_from_sender: Transform, world_from_receiver: Transform, request: RequestMap
) -> tuple[Tensor, Tensor]:
    """Return the receiver's confidence (N,) at positions (N, 2), metres in the sender's frame, and whether they are on its map."""
    flat = torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double()
    there = (world_from_receiver.inverse() @ world_from_sender).apply(flat)[:, :2]
    yx = request.grid.cells(there)
    return request.confidence[yx[:, 0], yx[:, 1]], request.grid.contains(there)


def _request_weight(
    xy: Tensor, world_from_sender: Transform, world_from_receiver: Transform, request: RequestMap
) -> Tensor:
    confidence, is_inside = read_request_map(xy, world_from_sender, world_from_receiver, request)
    return torch.where(is_inside, 1 - confidence, 0.0).float()
