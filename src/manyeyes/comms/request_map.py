# SPDX-License-Identifier: Apache-2.0
"""What a receiver would hear: a coarse map of how sure it is, and what it makes of the worth of others' tokens.

A receiver broadcasts one byte a window (``RequestMap``). A sender moves its tokens into each receiver's frame, by the poses that
the messages claim, and lowers the score of what all of them see well: the largest need counts, since one message serves all.
Compare Where2comm's request map (Hu et al., NeurIPS 2022, section 3.3), which is dense and as fine as the features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError, Transform
from manyeyes.datatypes.message import Message, RequestMap


def build_request_map(xy: Tensor, confidence: Tensor, windows: BevGrid) -> RequestMap:
    """One agent's map over a coarse grid: in each window the least of sure (N,) in [0, 1], 0 where there is none.

    xy: (N, 2) metres in the agent's frame, where it believes an object; confidence: its score. The least: where one of two vehicles
    is in doubt, help is wanted.
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
    """(N,) in [least, 1]: what to multiply the positive scores of tokens at xy (N, 2), metres in the sender's frame, with.

    requests: messages that have a request; without any, all is needed. To one receiver a token is worth 1 - sure of the window
    where it falls, and nothing beyond its map; of several receivers the largest counts. ``min_weight`` keeps an order among
    tokens that nobody asks for: whoever does not broadcast a request may still hear them.
    """
    requesting = [m for m in requests if m.request is not None]
    if not requesting:
        return torch.ones(len(xy))
    weights = torch.stack(
        [_request_weight(xy, world_from_sender, m.world_from_agent, m.request) for m in requesting if m.request]
    )
    return weights.amax(0).clamp_min(min_weight)


def _request_weight(
    xy: Tensor, world_from_sender: Transform, world_from_receiver: Transform, request: RequestMap
) -> Tensor:
    flat = torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double()
    there = (world_from_receiver.inverse() @ world_from_sender).apply(flat)[:, :2]
    yx = request.grid.cells(there)
    weight = 1 - request.confidence[yx[:, 0], yx[:, 1]]
    return torch.where(request.grid.contains(there), weight, 0.0).float()
