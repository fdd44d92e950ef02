# SPDX-License-Identifier: Apache-2.0
"""Forward pass and losses of one training step of the map model: features of each frame, fusion on tiles, decoding.

Tiles receive tokens only.
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
    """Extract features of every frame of all samples with the model's sensors."""
    frames = [frame for sample in samples for frame in sample.frames]
    sensors = model.config.bev.sensors
    clouds = [frame.points for frame in frames] if "lidar" in sensors else []
    return model.extract_features(clouds, [frame.images for frame in frames] if "camera" in sensors else [])


def warp_tokens(model: MapModel, tokens: SparseBev, samples: Sequence[MapSample]) -> tuple[Tensor, Tensor]:
    """Warp the tokens of all frames to the tiles of all samples; returns the arguments of ``MapModel.fuse_features``."""
    poses = [sample.tile_from_agent for sample in samples]
    motion = Transform(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))
    tiles = [tile for tile, sample in enumerate(samples) for _ in sample.frames]
    tile = torch.tensor(tiles, dtype=torch.int64, device=tokens.features.device)
    return model.warp_tokens(tokens, motion, tile, len(samples))


def subsample_tokens(tokens: SparseBev, score: Tensor, drop_fraction: Tensor) -> SparseBev:
    """Drop the fraction (frames,) of tokens with the lowest score (N,) of each frame."""
    batch = tokens.sites.batch
    order = score.argsort(stable=True)
    order = order[batch[order].argsort(stable=True)]
    count = torch.bincount(batch, minlength=tokens.sites.batch_size)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - (count.cumsum(0) - count)[batch[order]]
    return tokens.keep(rank >= (drop_fraction * count).floor()[batch])


def loss_terms(
    model: MapModel,
    samples: Sequence[MapSample],
    config: MapLossConfig,
    drop_fraction: Tensor | None = None,
    train_decoder: bool = True,
) -> MapLossTerms:
    """Compute the losses of one batch of tiles.

    drop_fraction: (frames,) fraction of each frame's tokens that is dropped. train_decoder: whether to compute
    decoder losses.
    """
    extracted, device = extract_features(model, samples), model.device
    line_mask = torch.cat([sample.line_mask for sample in samples]).to(device)
    occupied = line_mask.permute(0, 2, 3, 1).flatten(0, 2)[extracted.tokens.sites.key]
    segmentation = segmentation_loss(extracted.line_logits, occupied.float())
    tokens = (
        extracted.tokens
        if drop_fraction is None
        else subsample_tokens(extracted.tokens, extracted.cell_score, drop_fraction.to(device))
    )
    features, seen = warp_tokens(model, tokens, samples)
    ground = model.fuse_features(features, seen)
    head, tile = model.config.head, model.config.tile
    around = dilate_observed(seen.any(1), tile)
    line_field = model.predict_line_field(ground)
    line_targets = [
        make_line_field_target(one.truth, tile, head.kinds).to(device).mask_unobserved(part)
        for one, part in zip(samples, around)
    ]
    line_loss = line_field_loss(line_field, line_targets)
    if not train_decoder:
        return MapLossTerms.without_elements(segmentation, line_loss)
    truths = [select_observed(one.truth, part, tile) for one, part in zip(samples, around.cpu())]
    targets = [make_map_target(truth, tile, head.kinds, head.num_points).to(device) for truth in truths]
    many = model.predict_elements(ground, "many", line_field) if head.num_one_to_many_queries else ()
    return map_terms(model.predict_elements(ground, "one", line_field), many, segmentation, line_loss, targets, config)
