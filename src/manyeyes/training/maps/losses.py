# SPDX-License-Identifier: Apache-2.0
"""Losses of the map head: who answers for which element, and how far off it is, whatever order either is drawn in.

Sources: MapTR (ICLR 2023) and MapTRv2 (IJCV 2024), weights as published there but for ink, ten times
as much (docs/mapper.md); focal loss, Lin et al., ICCV 2017. Terms of points are sums over an element's points, means over elements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from manyeyes.models.maps.head import RawMap
from manyeyes.ops.assignment import assign
from manyeyes.training.maps.targets import MapTarget

ALPHA, GAMMA = 0.25, 2.0


@dataclass(frozen=True)
class MapLossConfig:
    """Weights of the terms. one_to_many_repeats: how often each element is wanted of the one-to-many queries; one_to_many: their
    share of the loss.

    max_match_distance: mean over an element's points of the L1 distance, in shares of the tile, beyond which no query answers for
    it: where no line of the sketch comes near, only the sketch has something to learn, and a query that was drawn there would
    unlearn. Queries that begin as lines of their own have to be drawn from anywhere.
    """

    classification: float = 2.0
    point: float = 5.0
    direction: float = 0.005
    segmentation: float = 10.0
    line_field: float = 2.0
    one_to_many_repeats: int = 2
    max_match_distance: float = 0.2
    one_to_many: float = 1.0


@dataclass(frozen=True)
class MapLossTerms:
    """Scalars, each a sum over the head's layers where it has any; line_field: of what queries begin from
    (training/maps/line_field_targets.py);
    one_to_many: all terms of the one-to-many queries, weighed already.
    """

    classification: Tensor
    point: Tensor
    direction: Tensor
    segmentation: Tensor
    line_field: Tensor
    one_to_many: Tensor

    @classmethod
    def without_elements(cls, segmentation: Tensor, line_field: Tensor) -> MapLossTerms:
        """Where nothing was drawn."""
        nothing = line_field.new_zeros(())
        return cls(nothing, nothing, nothing, segmentation, line_field, nothing)

    def scale(self, fraction: float) -> MapLossTerms:
        """What they count where they are of this share of a batch, without their gradients."""
        return MapLossTerms(**{name: fraction * value.detach() for name, value in vars(self).items()})

    @classmethod
    def add_up(cls, parts: Sequence[MapLossTerms]) -> MapLossTerms:
        """The terms of a batch from those of its parts."""
        return cls(**{f.name: torch.stack([getattr(part, f.name) for part in parts]).sum() for f in fields(cls)})

    def total(self, config: MapLossConfig) -> Tensor:
        """The loss."""
        own = (
            config.classification * self.classification + config.point * self.point + config.direction * self.direction
        )
        return (
            own
            + config.segmentation * self.segmentation
            + config.line_field * self.line_field
            + config.one_to_many * self.one_to_many
        )


@dataclass(frozen=True, eq=False)
class QueryMatch:
    """In one tile: query (M,) and element (M,) int64 of each pair, and the points (M, P, 2) in the order that fits the query."""

    query: Tensor
    element: Tensor
    points: Tensor


def match_queries(logit: Tensor, point: Tensor, target: MapTarget, config: MapLossConfig) -> QueryMatch:
    """One query an element, at the least cost over all pairs: focal cost of the kind plus the L1 distance in the best order.

    logit (I, kinds), point (I, P, 2). Distances are of shares of the tile, summed over points.
    """
    elements, orders = target.orders.shape[:2]
    if elements == 0:
        empty = torch.zeros(0, dtype=torch.int64)
        return QueryMatch(empty, empty, target.orders.new_zeros(0, *point.shape[1:]))
    with torch.no_grad():
        distance = torch.cdist(point.flatten(1), target.orders.flatten(0, 1).flatten(1), p=1).view(-1, elements, orders)
        min_distance, best = distance.min(2)
        cost = config.classification * _focal_cost(logit)[:, target.kind] + config.point * min_distance
        pairs = torch.from_numpy(assign(cost.double().numpy()).copy())
        query, element = pairs[
            min_distance[pairs[:, 0], pairs[:, 1]] <= config.max_match_distance * point.shape[1]
        ].unbind(1)
    return QueryMatch(query, element, target.orders[element, best[query, element]])


def head_terms(
    layers: Sequence[RawMap], targets: Sequence[MapTarget], config: MapLossConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """(kind, point, direction) of one group of queries, each layer matched anew, summed over layers."""
    queries = layers[0].logit.shape[1]
    num_matches = max(1, sum(min(len(target), queries) for target in targets))
    kind = point = direction = layers[0].logit.new_zeros(())
    for raw in layers:
        hot = torch.zeros_like(raw.logit)
        for tile, target in enumerate(targets):
            found = match_queries(raw.logit[tile], raw.point[tile], target, config)
            hot[tile, found.query, target.kind[found.element]] = 1
            matched, ring = raw.point[tile, found.query], target.ring[found.element]
            point = point + (matched - found.points).abs().sum() / num_matches
            direction = direction + direction_loss(matched, found.points, ring).sum() / num_matches
        kind = kind + focal_loss(raw.logit, hot).sum() / num_matches
    return kind, point, direction


def direction_loss(predicted: Tensor, target: Tensor, ring: Tensor) -> Tensor:
    """(M,) sums of 1 - cosine between the edges of two figures (M, P, 2); a ring (M,) has its closing edge too."""
    gap = 1 - F.cosine_similarity(predicted.roll(-1, 1) - predicted, target.roll(-1, 1) - target, dim=2, eps=1e-6)
    return gap[:, :-1].sum(1) + gap[:, -1] * ring


def focal_loss(logit: Tensor, hot: Tensor) -> Tensor:
    """Focal loss of each logit against 0 or 1."""
    likely = torch.sigmoid(logit)
    miss = torch.where(hot > 0, 1 - likely, likely)
    weight = torch.where(hot > 0, ALPHA, 1 - ALPHA) * miss**GAMMA
    return weight * F.binary_cross_entropy_with_logits(logit, hot, reduction="none")


def _focal_cost(logit: Tensor) -> Tensor:
    """What it costs a query to say a kind rather than not: the focal loss as it would be less the loss as it is without."""
    return focal_loss(logit, torch.ones_like(logit)) - focal_loss(logit, torch.zeros_like(logit))


def segmentation_loss(logit: Tensor, occupied: Tensor) -> Tensor:
    """Of tokens (N, kinds), whether an element of each kind runs through their cells (MapTRv2's segmentation, weight 4)."""
    return F.binary_cross_entropy_with_logits(logit, occupied, pos_weight=logit.new_full((), 4.0))


def map_terms(
    one: Sequence[RawMap],
    many: Sequence[RawMap],
    segmentation: Tensor,
    line_field: Tensor,
    targets: Sequence[MapTarget],
    config: MapLossConfig,
) -> MapLossTerms:
    """All terms of one batch of tiles; many is empty where the head has no such queries."""
    kind, point, direction = head_terms(one, targets, config)
    extra = kind.new_zeros(())
    if many:
        repeated = [target.repeat(config.one_to_many_repeats) for target in targets]
        more = head_terms(many, repeated, config)
        extra = config.classification * more[0] + config.point * more[1] + config.direction * more[2]
    return MapLossTerms(kind, point, direction, segmentation, line_field, extra)
