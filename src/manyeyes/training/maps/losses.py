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
    """Weights of the terms. repeat: how often each element is wanted of the one-to-many queries; many: their share of the loss.

    far: mean over an element's points of the L1 distance, in shares of the tile, beyond which no query answers for it: where no
    line of the sketch comes near, only the sketch has something to learn, and a query that was drawn there would unlearn. Queries
    that begin as lines of their own have to be drawn from anywhere.
    """

    kind: float = 2.0
    point: float = 5.0
    direction: float = 0.005
    ink: float = 10.0
    sketch: float = 2.0
    repeat: int = 2
    far: float = 0.2
    many: float = 1.0


@dataclass(frozen=True)
class MapTerms:
    """Scalars, each a sum over the head's layers where it has any; sketch: of what queries begin from
    (training/maps/line_field_targets.py);
    many: all terms of the one-to-many queries, weighed already.
    """

    kind: Tensor
    point: Tensor
    direction: Tensor
    ink: Tensor
    sketch: Tensor
    many: Tensor

    @classmethod
    def undrawn(cls, ink: Tensor, sketch: Tensor) -> MapTerms:
        """Where nothing was drawn."""
        nothing = sketch.new_zeros(())
        return cls(nothing, nothing, nothing, ink, sketch, nothing)

    def shared(self, share: float) -> MapTerms:
        """What they count where they are of this share of a batch, without their gradients."""
        return MapTerms(**{name: share * value.detach() for name, value in vars(self).items()})

    @classmethod
    def summed(cls, parts: Sequence[MapTerms]) -> MapTerms:
        """The terms of a batch from those of its parts."""
        return cls(**{f.name: torch.stack([getattr(part, f.name) for part in parts]).sum() for f in fields(cls)})

    def total(self, config: MapLossConfig) -> Tensor:
        """The loss."""
        own = config.kind * self.kind + config.point * self.point + config.direction * self.direction
        return own + config.ink * self.ink + config.sketch * self.sketch + config.many * self.many


@dataclass(frozen=True, eq=False)
class Match:
    """In one tile: query (M,) and element (M,) int64 of each pair, and the points (M, P, 2) in the order that fits the query."""

    query: Tensor
    element: Tensor
    points: Tensor


def match(logit: Tensor, point: Tensor, target: MapTarget, config: MapLossConfig) -> Match:
    """One query an element, at the least cost over all pairs: focal cost of the kind plus the L1 distance in the best order.

    logit (I, kinds), point (I, P, 2). Distances are of shares of the tile, summed over points.
    """
    elements, orders = target.orders.shape[:2]
    if elements == 0:
        nobody = torch.zeros(0, dtype=torch.int64)
        return Match(nobody, nobody, target.orders.new_zeros(0, *point.shape[1:]))
    with torch.no_grad():
        away = torch.cdist(point.flatten(1), target.orders.flatten(0, 1).flatten(1), p=1).view(-1, elements, orders)
        least, best = away.min(2)
        cost = config.kind * _focal_cost(logit)[:, target.kind] + config.point * least
        pairs = torch.from_numpy(assign(cost.double().numpy()).copy())
        query, element = pairs[least[pairs[:, 0], pairs[:, 1]] <= config.far * point.shape[1]].unbind(1)
    return Match(query, element, target.orders[element, best[query, element]])


def head_terms(
    layers: Sequence[RawMap], targets: Sequence[MapTarget], config: MapLossConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """(kind, point, direction) of one group of queries, each layer matched anew, summed over layers."""
    queries = layers[0].logit.shape[1]
    answers = max(1, sum(min(len(target), queries) for target in targets))
    kind = point = direction = layers[0].logit.new_zeros(())
    for raw in layers:
        hot = torch.zeros_like(raw.logit)
        for tile, target in enumerate(targets):
            found = match(raw.logit[tile], raw.point[tile], target, config)
            hot[tile, found.query, target.kind[found.element]] = 1
            mine, ring = raw.point[tile, found.query], target.ring[found.element]
            point = point + (mine - found.points).abs().sum() / answers
            direction = direction + turned_away(mine, found.points, ring).sum() / answers
        kind = kind + focal(raw.logit, hot).sum() / answers
    return kind, point, direction


def turned_away(mine: Tensor, theirs: Tensor, ring: Tensor) -> Tensor:
    """(M,) sums of 1 - cosine between the edges of two figures (M, P, 2); a ring (M,) has its closing edge too."""
    gap = 1 - F.cosine_similarity(mine.roll(-1, 1) - mine, theirs.roll(-1, 1) - theirs, dim=2, eps=1e-6)
    return gap[:, :-1].sum(1) + gap[:, -1] * ring


def focal(logit: Tensor, hot: Tensor) -> Tensor:
    """Focal loss of each logit against 0 or 1."""
    likely = torch.sigmoid(logit)
    miss = torch.where(hot > 0, 1 - likely, likely)
    weight = torch.where(hot > 0, ALPHA, 1 - ALPHA) * miss**GAMMA
    return weight * F.binary_cross_entropy_with_logits(logit, hot, reduction="none")


def _focal_cost(logit: Tensor) -> Tensor:
    """What it costs a query to say a kind rather than not: the focal loss as it would be less the loss as it is without."""
    return focal(logit, torch.ones_like(logit)) - focal(logit, torch.zeros_like(logit))


def ink_loss(logit: Tensor, drawn: Tensor) -> Tensor:
    """Of tokens (N, kinds), whether an element of each kind runs through their cells (MapTRv2's segmentation, weight 4)."""
    return F.binary_cross_entropy_with_logits(logit, drawn, pos_weight=logit.new_full((), 4.0))


def map_terms(
    one: Sequence[RawMap],
    many: Sequence[RawMap],
    ink: Tensor,
    sketch: Tensor,
    targets: Sequence[MapTarget],
    config: MapLossConfig,
) -> MapTerms:
    """All terms of one batch of tiles; many is empty where the head has no such queries."""
    kind, point, direction = head_terms(one, targets, config)
    extra = kind.new_zeros(())
    if many:
        repeated = [target.repeated(config.repeat) for target in targets]
        more = head_terms(many, repeated, config)
        extra = config.kind * more[0] + config.point * more[1] + config.direction * more[2]
    return MapTerms(kind, point, direction, ink, sketch, extra)
