# SPDX-License-Identifier: Apache-2.0
"""Losses of the map head: matching of queries to elements, and point errors modulo equivalent point orders.

Sources: MapTR (ICLR 2023) and MapTRv2 (IJCV 2024), with their published weights but for segmentation, which weighs
ten times as much
(docs/concepts/map-model.md); focal loss, Lin et al., ICCV 2017. The loss of edges is ours. Point terms are sums over an element's
points and means over elements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from manyeyes.models.maps.head import RawMap
from manyeyes.training.maps.targets import MapTarget

ALPHA, GAMMA = 0.25, 2.0


@dataclass(frozen=True)
class MapLossConfig:
    """Weights of the loss terms.

    Attributes:
        one_to_many_repeats: number of one-to-many queries per element.
        one_to_many: weight of the one-to-many queries.
        max_match_distance: maximum mean L1 distance of an element's points, in fractions of the tile, at which a
            query is matched. Without a nearby line in the line field, only the line field has something to learn.
            Learned queries need an infinite distance.
        edge: weight of the error of the vectors between neighbouring points, so of their direction and spacing; a
            displaced line has none.
    """

    classification: float = 2.0
    point: float = 5.0
    direction: float = 0.005
    edge: float = 0.0
    segmentation: float = 10.0
    line_field: float = 2.0
    one_to_many_repeats: int = 2
    max_match_distance: float = 0.2
    one_to_many: float = 1.0


class HeadTerms(NamedTuple):
    """Loss terms of one group of queries, as scalars, summed over the head's layers."""

    classification: Tensor
    point: Tensor
    direction: Tensor
    edge: Tensor

    def total(self, config: MapLossConfig) -> Tensor:
        """Return the weighted sum."""
        return (
            config.classification * self.classification
            + config.point * self.point
            + config.direction * self.direction
            + config.edge * self.edge
        )


@dataclass(frozen=True)
class MapLossTerms:
    """Loss terms of one batch, as scalars, summed over the head's layers.

    line_field: see training/maps/line_field_targets.py. one_to_many: all terms of the one-to-many queries, already
    weighted.
    """

    classification: Tensor
    point: Tensor
    direction: Tensor
    edge: Tensor
    segmentation: Tensor
    line_field: Tensor
    one_to_many: Tensor

    @classmethod
    def without_elements(cls, segmentation: Tensor, line_field: Tensor) -> MapLossTerms:
        """Make the terms of a step without decoder."""
        nothing = line_field.new_zeros(())
        return cls(nothing, nothing, nothing, nothing, segmentation, line_field, nothing)

    def total(self, config: MapLossConfig) -> Tensor:
        """Return the weighted sum of all terms."""
        own = HeadTerms(self.classification, self.point, self.direction, self.edge)
        return (
            own.total(config)
            + config.segmentation * self.segmentation
            + config.line_field * self.line_field
            + config.one_to_many * self.one_to_many
        )


@dataclass(frozen=True, eq=False)
class QueryMatch:
    """Matches of one tile: query (M,) and element (M,) int64, and the points (M, P, 2) in the order that fits the
    query.
    """

    query: Tensor
    element: Tensor
    points: Tensor


def match_queries(logit: Tensor, point: Tensor, target: MapTarget, config: MapLossConfig) -> QueryMatch:
    """Match one query per element with minimum total cost: focal class cost plus L1 distance in the best point order.

    logit (I, kinds), point (I, P, 2). Distances are in fractions of the tile, summed over points.
    """
    elements, orders = target.orders.shape[:2]
    if elements == 0:
        empty = torch.zeros(0, dtype=torch.int64, device=point.device)
        return QueryMatch(empty, empty, target.orders.new_zeros(0, *point.shape[1:]))
    with torch.no_grad():
        distance = torch.cdist(point.flatten(1), target.orders.flatten(0, 1).flatten(1), p=1).view(-1, elements, orders)
        min_distance, best = distance.min(2)
        cost = config.classification * _focal_cost(logit)[:, target.kind] + config.point * min_distance
        pairs = torch.from_numpy(np.stack(linear_sum_assignment(cost.double().cpu().numpy()), 1)).to(point.device)
        query, element = pairs[
            min_distance[pairs[:, 0], pairs[:, 1]] <= config.max_match_distance * point.shape[1]
        ].unbind(1)
    return QueryMatch(query, element, target.orders[element, best[query, element]])


def head_terms(layers: Sequence[RawMap], targets: Sequence[MapTarget], config: MapLossConfig) -> HeadTerms:
    """Compute the loss terms of one group of queries, each layer matched separately."""
    queries = layers[0].logit.shape[1]
    num_matches = max(1, sum(min(len(target), queries) for target in targets))
    kind = point = direction = edge = layers[0].logit.new_zeros(())
    for raw in layers:
        hot = torch.zeros_like(raw.logit)
        for tile, target in enumerate(targets):
            found = match_queries(raw.logit[tile], raw.point[tile], target, config)
            hot[tile, found.query, target.kind[found.element]] = 1
            matched, ring = raw.point[tile, found.query], target.ring[found.element]
            point = point + (matched - found.points).abs().sum() / num_matches
            direction = direction + direction_loss(matched, found.points, ring).sum() / num_matches
            edge = edge + edge_loss(matched, found.points, ring).sum() / num_matches
        kind = kind + focal_loss(raw.logit, hot).sum() / num_matches
    return HeadTerms(kind, point, direction, edge)


def direction_loss(predicted: Tensor, target: Tensor, ring: Tensor) -> Tensor:
    """Return (M,) sums of 1 - cosine between the edges of two polylines (M, P, 2); rings (M,) include the closing
    edge.
    """
    gap = 1 - F.cosine_similarity(predicted.roll(-1, 1) - predicted, target.roll(-1, 1) - target, dim=2, eps=1e-6)
    return gap[:, :-1].sum(1) + gap[:, -1] * ring


def edge_loss(predicted: Tensor, target: Tensor, ring: Tensor) -> Tensor:
    """Return (M,) sums of L1 distances between the edges of two polylines (M, P, 2); rings (M,) include the closing edge."""
    gap = ((predicted.roll(-1, 1) - predicted) - (target.roll(-1, 1) - target)).abs().sum(2)
    return gap[:, :-1].sum(1) + gap[:, -1] * ring


def focal_loss(logit: Tensor, hot: Tensor) -> Tensor:
    """Compute the focal loss of each logit against 0 or 1."""
    likely = torch.sigmoid(logit)
    miss = torch.where(hot > 0, 1 - likely, likely)
    weight = torch.where(hot > 0, ALPHA, 1 - ALPHA) * miss**GAMMA
    return weight * F.binary_cross_entropy_with_logits(logit, hot, reduction="none")


def _focal_cost(logit: Tensor) -> Tensor:
    """Return the class cost of a match: the focal loss as a positive minus that as a negative."""
    return focal_loss(logit, torch.ones_like(logit)) - focal_loss(logit, torch.zeros_like(logit))


def segmentation_loss(logit: Tensor, occupied: Tensor) -> Tensor:
    """Loss of the line logits of tokens (N, kinds) against occupied cells (MapTRv2's segmentation, weight 4)."""
    return F.binary_cross_entropy_with_logits(logit, occupied, pos_weight=logit.new_full((), 4.0))


def map_terms(
    one: Sequence[RawMap],
    many: Sequence[RawMap],
    segmentation: Tensor,
    line_field: Tensor,
    targets: Sequence[MapTarget],
    config: MapLossConfig,
) -> MapLossTerms:
    """Compute all terms of one batch of tiles; many is empty without one-to-many queries."""
    own = head_terms(one, targets, config)
    extra = own.point.new_zeros(())
    if many:
        repeated = [target.repeat(config.one_to_many_repeats) for target in targets]
        extra = head_terms(many, repeated, config).total(config)
    return MapLossTerms(*own, segmentation, line_field, extra)
