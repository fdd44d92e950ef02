# SPDX-License-Identifier: Apache-2.0
"""A step of the map model's training, forward: each look by itself, its tokens, the tiles they fall on, what is drawn, losses.

Nothing reaches a tile but tokens.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from manyeyes.datatypes import SparseBev, Transform
from manyeyes.models.maps.map_model import MapFeatures, MapModel
from manyeyes.training.maps.line_field_targets import dilate_observed, line_field_loss, make_line_field_target
from manyeyes.training.maps.losses import MapLossConfig, MapLossTerms, map_terms, segmentation_loss
from manyeyes.training.maps.samples import MapSample
from manyeyes.training.maps.targets import make_map_target, select_observed


def extract_features(model: MapModel, samples: Sequence[MapSample]) -> MapFeatures:
    """Every look of all samples by itself, with the sensors that the model has."""
    frames = [frame for sample in samples for frame in sample.frames]
    sensors = model.config.bev.sensors
    clouds = [frame.points for frame in frames] if "lidar" in sensors else []
    return model.extract_features(clouds, [frame.images for frame in frames] if "camera" in sensors else [])


def warp_tokens(model: MapModel, tokens: SparseBev, samples: Sequence[MapSample]) -> tuple[Tensor, Tensor]:
    """Tokens of all looks in order on the cells of all samples' tiles, and what each look sees there, as
    ``MapModel.fuse_features`` wants.
    """
    poses = [sample.tile_from_agent for sample in samples]
    motion = Transform(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))
    tile = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor([len(s.frames) for s in samples]))
    return model.warp_tokens(tokens, motion, tile, len(samples))


def subsample_tokens(tokens: SparseBev, score: Tensor, drop_fraction: Tensor) -> SparseBev:
    """The tokens without the share (looks,) of least worth (N,) of each look."""
    batch = tokens.sites.batch
    order = score.argsort(stable=True)
    order = order[batch[order].argsort(stable=True)]
    count = torch.bincount(batch, minlength=tokens.sites.batch_size)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order)) - (count.cumsum(0) - count)[batch[order]]
    return tokens.keep(rank >= (drop_fraction * count).floor()[batch])


def loss_terms(
    model: MapModel,
    samples: Sequence[MapSample],
    config: MapLossConfig,
    drop_fraction: Tensor | None = None,
    train_decoder: bool = True,
) -> MapLossTerms:
    """Losses of one batch of tiles; drop_fraction (looks,): how much of each look's tokens is left out; train_decoder: is the
    decoder taught?
    """
    extracted = extract_features(model, samples)
    occupied = (
        torch.cat([sample.line_mask for sample in samples])
        .permute(0, 2, 3, 1)
        .flatten(0, 2)[extracted.tokens.sites.key]
    )
    segmentation = segmentation_loss(extracted.line_logits, occupied.float())
    tokens = (
        extracted.tokens
        if drop_fraction is None
        else subsample_tokens(extracted.tokens, extracted.cell_score, drop_fraction)
    )
    features, seen = warp_tokens(model, tokens, samples)
    ground = model.fuse_features(features, seen)
    head, tile = model.config.head, model.config.tile
    around = dilate_observed(seen.any(1), tile)
    line_field = model.predict_line_field(ground)
    line_targets = [
        make_line_field_target(one.truth, tile, head.kinds).mask_unobserved(part) for one, part in zip(samples, around)
    ]
    line_loss = line_field_loss(line_field, line_targets)
    if not train_decoder:
        return MapLossTerms.without_elements(segmentation, line_loss)
    truths = [select_observed(one.truth, part, tile) for one, part in zip(samples, around)]
    targets = [make_map_target(truth, tile, head.kinds, head.num_points) for truth in truths]
    many = model.predict_elements(ground, "many", line_field) if head.num_one_to_many_queries else ()
    return map_terms(model.predict_elements(ground, "one", line_field), many, segmentation, line_loss, targets, config)
