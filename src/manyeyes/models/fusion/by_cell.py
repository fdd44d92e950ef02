# SPDX-License-Identifier: Apache-2.0
"""One feature a sender and cell: the sparse counterpart of the dense maps, moved to the ego's frame, that published fusions take.

A dense map is zero where its agent has no feature; a sparse one has no row there. ``AbsentSenders`` names the one that a fusion
computes with: "zero" is the letter of the papers, "masked" leaves absent senders out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from manyeyes.datatypes import Sites
from manyeyes.models.detector.proposal import proposed_heat
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.sparse_index import distinct
from manyeyes.ops.voxelize import segment_max, segment_sum

AbsentSenders = Literal["zero", "masked"]


@dataclass(frozen=True, eq=False)
class SenderMaps:
    """The rows of CellRows in the order of maps of their senders, which convolutions take.

    Attributes:
        features: (M, C).
        sites: of the maps of all senders of all egos, a batch of grids.
        cell: (M,) int64, as in CellRows.
        is_own: (M,) bool, whether the map is that of the ego; its rows are in the order of the cells.
        row: (M,) int64, the row of CellRows.
    """

    features: Tensor
    sites: Sites
    cell: Tensor
    is_own: Tensor
    row: Tensor

    def to_rows(self, values: Tensor) -> Tensor:
        """Return values (M, D) of the sites in the order of the rows."""
        return torch.zeros_like(values).index_copy(0, self.row, values)


@dataclass(frozen=True, eq=False)
class CellRows:
    """M rows, at most one a sender and cell, on U cells around a batch of egos.

    Attributes:
        features: (M, C), the maximum of the tokens of a sender on a cell; ordered by cell, then by sender.
        cell: (M,) int64, number of the cell in sites.
        agent: (M,) int64, number of the sender in the batch, ``ego * num_senders + sender``; a sender of 0 is the ego itself.
        confidence: (M,) in [0, 1], the largest of the tokens.
        infrastructure: (M,) bool, whether the sender is a roadside unit.
        sender_xy: (M, 2) mean position in the sender's own frame, metres.
        xy: (M, 2) mean position in the ego's frame, metres.
        age: (M,) of the oldest token, in units of 100 ms.
        sites: the cells that any sender occupies.
        num_senders: of the ego that has most, itself included.
        count: (batch,) number of senders of each ego with at least one token, itself included.
    """

    features: Tensor
    cell: Tensor
    agent: Tensor
    confidence: Tensor
    infrastructure: Tensor
    sender_xy: Tensor
    xy: Tensor
    age: Tensor
    sites: Sites
    num_senders: int
    count: Tensor

    @property
    def is_own(self) -> Tensor:
        """(M,) bool, whether the sender is the ego."""
        return self.agent.remainder(self.num_senders) == 0

    @property
    def num_rows(self) -> Tensor:
        """(U,) float, number of rows of each cell."""
        return segment_sum(self.features.new_ones(len(self.cell), 1), self.cell, len(self.sites))[:, 0]

    @property
    def num_absent(self) -> Tensor:
        """(U,) float, number of senders of the ego without a row on each cell."""
        return self.count[self.sites.batch].to(self.features.dtype) - self.num_rows

    def with_features(self, features: Tensor) -> CellRows:
        """Return the same rows with other features (M, C)."""
        return replace(self, features=features)

    def own_features(self, rows: Tensor | None = None) -> Tensor:
        """Return the ego's features (U, C), of rows (M, C) or of the features; zero on cells where it has none."""
        rows = self.features if rows is None else rows
        own = self.is_own.nonzero()[:, 0]
        return rows.new_zeros(len(self.sites), rows.shape[1]).index_copy(0, self.cell[own], rows[own])

    def sum(self, rows: Tensor) -> Tensor:
        """Return the sums (U, D) of rows (M, D) over the senders of each cell."""
        return segment_sum(rows, self.cell, len(self.sites))

    def max(self, absent: AbsentSenders) -> Tensor:
        """Return the maximum (U, C) of the features over the senders of each cell."""
        found = segment_max(self.features, self.cell, len(self.sites))
        return found if absent == "masked" else torch.where(self.num_absent[:, None] > 0, found.clamp_min(0), found)

    def softmax(self, logit: Tensor, absent_logit: Tensor | None = None) -> Tensor:
        """Return weights (M, H) of logits (M, H) over the senders of each cell; absent_logit: (U, H) of each absent one, if any."""
        n = len(self.sites)
        index = self.cell[:, None].expand_as(logit)
        peak = logit.detach().new_full((n, logit.shape[1]), -torch.inf)
        peak = peak.scatter_reduce(0, index, logit.detach(), "amax")
        if absent_logit is None:
            weight = (logit - peak[self.cell]).exp()
            return weight / self.sum(weight)[self.cell]
        peak = torch.maximum(peak, absent_logit.detach())
        weight = (logit - peak[self.cell]).exp()
        total = self.sum(weight) + self.num_absent[:, None] * (absent_logit - peak).exp()
        return weight / total[self.cell]

    def to_maps(self) -> SenderMaps:
        """Return the rows as one sparse map a sender."""
        rows, columns = self.sites.grid.shape
        key = self.agent * (rows * columns) + self.sites.key.remainder(rows * columns)[self.cell]
        key, order = key.sort()
        sites = Sites(key, self.sites.grid, self.sites.batch_size * self.num_senders)
        return SenderMaps(self.features.index_select(0, order), sites, self.cell[order], self.is_own[order], order)

    def with_own_everywhere(self) -> CellRows:
        """Return the rows and, on cells where the ego has none, a row of zeros of the ego: its dense map."""
        has_own = torch.zeros(len(self.sites), dtype=torch.bool, device=self.cell.device)
        has_own[self.cell[self.is_own]] = True
        cells = (~has_own).nonzero()[:, 0]
        if not len(cells):
            return self
        own = self.is_own
        roadside = torch.zeros(self.sites.batch_size, dtype=torch.bool, device=own.device)
        roadside[(self.agent[own & self.infrastructure]).div(self.num_senders, rounding_mode="floor")] = True
        batch, xy = self.sites.batch[cells], self.sites.xy[cells]
        zeros, agent = self.features.new_zeros(len(cells), self.features.shape[1]), batch * self.num_senders
        order = (torch.cat((self.cell, cells)) * (int(self.agent.max()) + 1) + torch.cat((self.agent, agent))).argsort()

        def join(column: Tensor, added: Tensor) -> Tensor:
            return torch.cat((column, added)).index_select(0, order)

        return replace(
            self,
            features=join(self.features, zeros),
            cell=join(self.cell, cells),
            agent=join(self.agent, agent),
            confidence=join(self.confidence, zeros[:, 0]),
            infrastructure=join(self.infrastructure, roadside[batch]),
            sender_xy=join(self.sender_xy, xy),
            xy=join(self.xy, xy),
            age=join(self.age, zeros[:, 0]),
        )


def standing_cells(tokens: Tokens) -> Tensor:
    """Return the key (N,) int64 of the cell on which each token lies, whatever it proposes."""
    rows, columns = tokens.grid.shape
    yx = tokens.grid.cells(tokens.xy)
    return (tokens.ego * rows + yx[:, 0]) * columns + yx[:, 1]


def gather_by_cell(features: Tensor, tokens: Tokens, key: Tensor) -> tuple[CellRows, Tensor]:
    """Reduce features (N, C) of tokens on cells key (N,) to one row a sender and cell; returns them and the row (N,) of each token.

    The mask of the selection scales the features, as in ``token_merge``.
    """
    rows, columns = tokens.grid.shape
    size = tokens.batch_size * rows * columns
    num_senders = int(tokens.sender.max()) + 1 if len(key) else 1
    found, row_of_token = distinct(key * num_senders + tokens.sender, size * num_senders)
    cell_key, sender = found.div(num_senders, rounding_mode="floor"), found.remainder(num_senders)
    keys, cell = distinct(cell_key, size)
    m = len(found)
    agent = cell_key.div(rows * columns, rounding_mode="floor") * num_senders + sender
    confidence = torch.sigmoid(proposed_heat(tokens.proposal))
    of_tokens = torch.cat((tokens.sender_xy, tokens.xy, torch.ones_like(confidence)[:, None]), 1)
    places = segment_sum(of_tokens, row_of_token, m)
    places = places[:, :4] / places[:, 4:]
    extremes = torch.stack((confidence, tokens.infrastructure.to(confidence.dtype), tokens.age), 1)
    flags = segment_max(extremes, row_of_token, m)
    masked = segment_max(features * tokens.selection_mask[:, None], row_of_token, m)
    present = distinct(
        torch.cat((tokens.ego * num_senders + tokens.sender, _egos(tokens, num_senders))),
        tokens.batch_size * num_senders,
    )[0]
    count = torch.bincount(present.div(num_senders, rounding_mode="floor"), minlength=tokens.batch_size)
    sites = Sites(keys, tokens.grid, tokens.batch_size)
    columns_of_rows = (masked, cell, agent, flags[:, 0], flags[:, 1] > 0, places[:, :2], places[:, 2:], flags[:, 2])
    return CellRows(*columns_of_rows, sites, num_senders, count), row_of_token


def _egos(tokens: Tokens, num_senders: int) -> Tensor:
    """Return the numbers (batch,) of the egos among agents."""
    return torch.arange(tokens.batch_size, device=tokens.ego.device) * num_senders
