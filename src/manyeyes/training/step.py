# SPDX-License-Identifier: Apache-2.0
"""One forward pass as training sees it: every agent alone, and every ego with its collaborators, in one batch."""

from __future__ import annotations

import torch

from manyeyes.datatypes import Boxes
from manyeyes.models.box_head import RawBoxes
from manyeyes.models.detector import Detector, Seen
from manyeyes.models.fusion.gather import gather, join, own_tokens
from manyeyes.training.losses import LossTerms, head_terms, prune_focal
from manyeyes.training.samples import Sample
from manyeyes.training.targets import TargetConfig, assign, near_objects


def forward(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> tuple[Seen, RawBoxes]:
    """Raw boxes of the samples' egos with all they hear, then of every agent that hears nobody.

    The tokens take the very path that they take as bytes: seen in the sender's frame, moved metrically, fused, decoded.
    """
    seen = model.see([cloud for sample in samples for cloud in sample.clouds], prune_threshold)
    sites = seen.tokens.sites
    parts, agent = [], 0
    batch, xy = sites.batch, sites.xy
    for ego, sample in enumerate(samples):
        for i, motion in enumerate(sample.ego_from_agent):
            rows = batch == agent
            parts.append((ego, seen.tokens.features[rows], xy[rows], motion if i else None))
            agent += 1
    together = gather(parts, seen.tokens.grid, len(samples))
    return seen, model.fuse(join(together, own_tokens(seen.tokens)))


def loss_terms(
    model: Detector, samples: list[Sample], targets: TargetConfig, prune_threshold: float | None = None
) -> LossTerms:
    """Losses of one batch: fused egos against the union of what their agents list, each agent against its own list."""
    seen, raw = forward(model, samples, prune_threshold)
    alone: list[Boxes] = [boxes for sample in samples for boxes in sample.seen]
    prune = torch.stack([prune_focal(p, near_objects(p.sites, alone, targets)) for p in seen.pruned]).mean()
    truth = [sample.union for sample in samples] + alone
    return head_terms(raw, assign(raw.sites, truth, targets), prune)
