# SPDX-License-Identifier: Apache-2.0
"""A step of the map model's training, forward: each look by itself, its tokens, the tiles they fall on, what is drawn, losses.

Nothing reaches a tile but tokens.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from manyeyes.datatypes import SparseBev, Transform
from manyeyes.models.maps.map_model import Look, Mapper
from manyeyes.training.maps.line_field_targets import around_seen, sketch_loss, sketch_of
from manyeyes.training.maps.losses import MapLossConfig, MapTerms, ink_loss, map_terms
from manyeyes.training.maps.samples import MapSample
from manyeyes.training.maps.targets import met, target_of


def see(model: Mapper, samples: Sequence[MapSample]) -> Look:
    """Every look of all samples by itself, with the sensors that the model has."""
    looks = [look for sample in samples for look in sample.looks]
    sensors = model.config.bev.sensors
    clouds = [look.points for look in looks] if "lidar" in sensors else []
    return model.see(clouds, [look.images for look in looks] if "camera" in sensors else [])


def placed(model: Mapper, tokens: SparseBev, samples: Sequence[MapSample]) -> tuple[Tensor, Tensor]:
    """Tokens of all looks in order on the cells of all samples' tiles, and what each look sees there, as ``Mapper.merge`` wants."""
    poses = [sample.tile_from_look for sample in samples]
    motion = Transform(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))
    tile = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor([len(s.looks) for s in samples]))
    return model.place(tokens, motion, tile, len(samples))


def thinned(tokens: SparseBev, worth: Tensor, share: Tensor) -> SparseBev:
    """The tokens without the share (looks,) of least worth (N,) of each look."""
    batch = tokens.sites.batch
    order = worth.argsort(stable=True)
    order = order[batch[order].argsort(stable=True)]
    count = torch.bincount(batch, minlength=tokens.sites.batch_size)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order)) - (count.cumsum(0) - count)[batch[order]]
    return tokens.keep(rank >= (share * count).floor()[batch])


def loss_terms(
    model: Mapper,
    samples: Sequence[MapSample],
    config: MapLossConfig,
    share: Tensor | None = None,
    draws: bool = True,
) -> MapTerms:
    """Losses of one batch of tiles; share (looks,): how much of each look's tokens is left out; draws: is the decoder taught?"""
    look = see(model, samples)
    drawn = torch.cat([sample.ink for sample in samples]).permute(0, 2, 3, 1).flatten(0, 2)[look.tokens.sites.key]
    ink = ink_loss(look.ink, drawn.float())
    tokens = look.tokens if share is None else thinned(look.tokens, look.worth, share)
    features, seen = placed(model, tokens, samples)
    ground = model.merge(features, seen)
    head, tile = model.config.head, model.config.tile
    around = around_seen(seen.any(1), tile)
    sketch = model.sketch(ground)
    wanted = [sketch_of(one.truth, tile, head.kinds).within(part) for one, part in zip(samples, around)]
    sketched = sketch_loss(sketch, wanted)
    if not draws:
        return MapTerms.undrawn(ink, sketched)
    truths = [met(one.truth, part, tile) for one, part in zip(samples, around)]
    targets = [target_of(truth, tile, head.kinds, head.points) for truth in truths]
    many = model.draw(ground, "many", sketch) if head.many else ()
    return map_terms(model.draw(ground, "one", sketch), many, ink, sketched, targets, config)
