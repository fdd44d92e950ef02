# SPDX-License-Identifier: Apache-2.0
"""V2VNet (Wang et al., ECCV 2020): messages between agents by convolution, their mean, and a convolutional GRU at every agent.

The ego computes the nodes of all agents from what it received, so that one broadcast suffices for any number of iterations. A
collaborator's node lives on the cells where it has features, the ego's on all. A message is linear in its two halves,
conv([F_j ; F_i]) = A F_j + B F_i, so that the mean over senders j takes one convolution a map instead of one a pair of agents.
The paper's image codec and its compensation of delays are not part of it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion._layers import PlainConv
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows, SenderMaps
from manyeyes.models.fusion.cell_fusion import register_rule
from manyeyes.ops.voxelize import segment_sum


class ConvGru(nn.Module):
    """h' = (1 - z) h + z tanh(conv([x ; r h])), with gates z, r = sigmoid(conv([x ; h]))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates, self.candidate = PlainConv(2 * channels, 2 * channels), PlainConv(2 * channels, channels)

    def forward(self, x: Tensor, hidden: SparseBev) -> Tensor:
        """Update hidden features (N, C) by inputs x (N, C) of the same sites."""
        h = hidden.features
        update, reset = torch.sigmoid(self.gates(hidden.with_features(torch.cat((x, h), 1)))).chunk(2, 1)
        candidate = torch.tanh(self.candidate(hidden.with_features(torch.cat((x, reset * h), 1))))
        return (1 - update) * h + update * candidate


@register_rule("v2vnet")
class V2VNet(nn.Module):
    """Iterations of message passing between all agents, then a linear layer of the ego's node.

    The hidden state of the GRU is the node itself, carried from one iteration to the next. absent: a message is masked where its
    sender has no feature; the mean is over all agents ("zero"), or over those present ("masked").
    """

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders, iterations: int = 2) -> None:
        super().__init__()
        self.absent, self.iterations = absent, iterations
        self.from_sender, self.from_receiver = (
            PlainConv(channels, channels, bias=False),
            PlainConv(channels, channels),
        )
        self.gru, self.out = ConvGru(channels), nn.Linear(channels, channels)

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        full = rows.with_own_everywhere()
        count = full.count[full.sites.batch].to(full.features.dtype) if self.absent == "zero" else full.num_rows
        present = full.num_rows / count
        maps, scale = full.to_maps(), torch.stack((1 / count, present), 1)
        nodes, own = maps.features, maps.is_own.nonzero()[:, 0]
        for _ in range(self.iterations - 1):
            mean = self._mean_of_senders(nodes, maps, scale)[maps.cell]
            node = SparseBev(nodes, maps.sites)
            nodes = self.gru(mean + scale[maps.cell, 1:] * self.from_receiver(node), node)
        mean = self._mean_of_senders(nodes, maps, scale)
        node = SparseBev(nodes[own], full.sites)
        return self.out(self.gru(mean + scale[:, 1:] * self.from_receiver(node), node))

    def _mean_of_senders(self, nodes: Tensor, maps: SenderMaps, scale: Tensor) -> Tensor:
        """Return the senders' half of the mean message (U, C)."""
        sent = self.from_sender(SparseBev(nodes, maps.sites))
        return segment_sum(sent, maps.cell, len(scale)) * scale[:, :1]
