# SPDX-License-Identifier: Apache-2.0
"""One forward pass as training sees it: every agent alone, and every ego with its collaborators, in one batch."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from manyeyes.datatypes import Boxes
from manyeyes.models.box_head import RawBoxes
from manyeyes.models.detector import Detector, Seen
from manyeyes.models.fusion.gather import gather
from manyeyes.training.losses import LossTerms, head_terms, prune_focal
from manyeyes.training.samples import Sample
from manyeyes.training.targets import TargetConfig, assign, near_objects


@dataclass(frozen=True)
class Outcome:
    """What one batch of samples gave: every agent's own view (alone), and every ego's with all it hears (together)."""

    seen: Seen
    alone: RawBoxes
    together: RawBoxes


def forward(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> Outcome:
    """Every agent looks as ego, then tells; every sample's ego fuses (CoSTr section III-A).

    The tokens take the very path that they take as bytes: seen in the sender's frame, moved metrically, fused, decoded.
    """
    seen = model.see([cloud for sample in samples for cloud in sample.clouds], prune_threshold)
    alone = model.look(seen.tokens)
    told, sites = model.tell(seen.tokens, alone), seen.tokens.sites
    parts, agent = [], 0
    batch, xy = sites.batch, sites.xy
    for ego, sample in enumerate(samples):
        for i, motion in enumerate(sample.ego_from_agent):
            rows = batch == agent
            parts.append((ego, told.features[rows], xy[rows], motion if i else None))
            agent += 1
    return Outcome(seen, alone, model.fuse(gather(parts, told.grid, len(samples))))


def loss_terms(
    model: Detector, samples: list[Sample], targets: TargetConfig, prune_threshold: float | None = None
) -> LossTerms:
    """Losses of one batch: egos against the union of what their agents list, each agent against its own list; halves each."""
    out = forward(model, samples, prune_threshold)
    listed: list[Boxes] = [boxes for sample in samples for boxes in sample.seen]
    union = [sample.union for sample in samples]
    prune = torch.stack([prune_focal(p, near_objects(p.sites, listed, targets)) for p in out.seen.pruned]).mean()
    alone = head_terms(out.alone, assign(out.alone.sites, listed, targets), prune)
    return alone.mean(head_terms(out.together, assign(out.together.sites, union, targets), prune))
