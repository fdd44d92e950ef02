# SPDX-License-Identifier: Apache-2.0
"""Forward pass and losses of one training step: single-agent and fused detection in one batch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import Boxes, SparseBev
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector, ExtractedFeatures
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.window_attention import window_ids
from manyeyes.training.detector.losses import LossTerms, head_terms, prune_focal
from manyeyes.training.detector.mutual_information import (
    STUDY_TARGETS,
    WINDOW_CELLS,
    AgentPairTokens,
    InformationTarget,
    mutual_information_loss,
)
from manyeyes.training.detector.samples import AgentView, Sample
from manyeyes.training.detector.targets import TargetConfig, assign_targets, find_nearby_objects

TOKENS_PER_PACKET = 8
"""Number of tokens lost together: a packet of 1,398 bytes holds about as many float16 features."""

_HISTORY_KEYS = {"ego_history": "past", "sender_history": "said"}
"""Parts of random keys; other values would change every training run."""


@dataclass(frozen=True)
class ForwardOutput:
    """Outputs for one batch of samples: single-agent boxes of every view and fused boxes of every ego.

    shared_tokens: of each view, on a batch of grids. mask: (N,) in (0, 1), the selector's mask.
    """

    features: ExtractedFeatures
    single_agent_boxes: RawBoxes
    fused_boxes: RawBoxes
    shared_tokens: SparseBev
    mask: Tensor


def forward(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> ForwardOutput:
    """Encode every view as ego and fuse the shared tokens of every sample (CoSTr section III-A).

    Tokens are processed as in deployment: computed in the sender's frame, transformed metrically, fused, decoded.
    """
    views = [view for sample in samples for view in sample.views]
    seen = model.extract_features([v.cloud for v in views], [v.previous_cloud for v in views], prune_threshold)
    alone = model.predict(seen.tokens)
    shared = model.make_tokens(seen.tokens, alone)
    score = model.score_tokens(shared)
    mask = torch.sigmoid(score)
    parts, number = [], 0
    batch, xy = shared.sites.batch, shared.sites.xy
    for ego, sample in enumerate(samples):
        for i, view in enumerate(sample.views):
            rows = (batch == number).nonzero()[:, 0]
            part = _agent_tokens(ego, view, shared.features, xy)
            if not i:
                part = replace(part, ego_from_sender=None, tokens=shared.features[rows], xy=xy[rows])
            else:
                rows = _select_delivered(rows, score.detach(), view, (*sample.key, i))
                kept = None if view.max_tokens is None else 1 + mask[rows] - mask[rows].detach()
                part = replace(part, tokens=shared.features[rows], xy=xy[rows], selection_mask=kept)
            parts.append(part)
            number += 1
    ego_history, sender_history = (
        _history_tokens(model, samples, which, prune_threshold) for which in ("ego_history", "sender_history")
    )
    tokens = to_ego_frame([*parts, *ego_history, *sender_history], shared.grid, len(samples))
    ego_past = to_ego_frame(ego_history, shared.grid, len(samples)) if ego_history else None
    return ForwardOutput(seen, alone, model.fuse(tokens, ego_past)[1], shared, mask)


def _agent_tokens(ego: int, view: AgentView, features: Tensor, xy: Tensor) -> AgentTokens:
    return AgentTokens(ego, features, xy, view.ego_from_view, view.age_s, view.sigma_xy_m, view.sigma_yaw_rad)


def _select_delivered(rows: Tensor, score: Tensor, view: AgentView, key: tuple[int | str, ...]) -> Tensor:
    """Select the rows of a view's tokens that fit its budget and are not lost, packet by packet."""
    if view.max_tokens is None and not view.loss_fraction:
        return rows
    rng = keyed_generator("arriving", *key)
    if view.max_tokens is not None:
        # Noise exchanges tokens of similar score, so that those just below the budget are explored.
        noise = torch.from_numpy(rng.gumbel(size=len(rows))).float()
        order = (score[rows] + 0.5 * noise).sort(descending=True, stable=True).indices
        rows = rows[order[: view.max_tokens]]
    packet = torch.arange(len(rows)) // TOKENS_PER_PACKET
    luck = torch.from_numpy(rng.random(int(packet[-1]) + 1 if len(rows) else 0))
    return rows[luck[packet] >= view.loss_fraction].sort().values


@torch.no_grad()
def _history_tokens(
    model: Detector,
    samples: list[Sample],
    which: Literal["ego_history", "sender_history"],
    prune_threshold: float | None,
) -> list[AgentTokens]:
    """Compute the tokens of earlier instants, of egos or of collaborators, without gradient."""
    views = [(ego, view) for ego, sample in enumerate(samples) for view in getattr(sample, which)]
    if not views:
        return []
    seen = model.extract_features([v.cloud for _, v in views], [v.previous_cloud for _, v in views], prune_threshold)
    shared = model.make_tokens(seen.tokens, model.predict(seen.tokens))
    score, batch, xy = model.score_tokens(shared), shared.sites.batch, shared.sites.xy
    parts = []
    for number, (ego, view) in enumerate(views):
        key = (*samples[ego].key, _HISTORY_KEYS[which], number)
        rows = _select_delivered((batch == number).nonzero()[:, 0], score, view, key)
        parts.append(_agent_tokens(ego, view, shared.features[rows], xy[rows]))
    return parts


def loss_terms(
    model: Detector,
    samples: list[Sample],
    targets: TargetConfig,
    prune_threshold: float | None = None,
    fusion_weight: float = 0.5,
    target: InformationTarget = "own_task",
) -> LossTerms:
    """Compute the losses of one batch: fused boxes against the merged ground truth, single-agent boxes against each
    agent's own.

    fusion_weight: fraction of the former. target: reference of the selector's mutual information.
    """
    out = forward(model, samples, prune_threshold)
    listed: list[Boxes] = [view.visible_boxes for sample in samples for view in sample.views]
    union = [sample.merged_gt_boxes for sample in samples]
    prune = torch.stack(
        [prune_focal(p, find_nearby_objects(p.sites, listed, targets)) for p in out.features.pruned]
    ).mean()
    own = assign_targets(out.single_agent_boxes.sites, listed, targets)
    kept, information = mutual_information_loss(out.shared_tokens, out.mask, own.heat)
    if target != "own_task":
        information = STUDY_TARGETS[target](pair_agent_tokens(out, samples))
    alone = head_terms(out.single_agent_boxes, own, prune, kept, information)
    fused = head_terms(out.fused_boxes, assign_targets(out.fused_boxes.sites, union, targets), prune, kept, information)
    return alone.mix(fused, fusion_weight)


def pair_agent_tokens(out: ForwardOutput, samples: list[Sample]) -> AgentPairTokens:
    """Pair the collaborators' tokens with the egos' own in windows of the egos' frames; only the mask carries a
    gradient.
    """
    shared, batch, xy = out.shared_tokens, out.shared_tokens.sites.batch, out.shared_tokens.sites.xy
    views = [(ego, i, view) for ego, sample in enumerate(samples) for i, view in enumerate(sample.views)]
    sides: tuple[list[AgentTokens], list[AgentTokens]] = ([], [])
    for number, (ego, i, view) in enumerate(views):
        rows = batch == number
        part = _agent_tokens(ego, view, shared.features[rows].detach(), xy[rows])
        sides[i > 0].append(replace(part, selection_mask=out.mask[rows]))
    none = AgentTokens(0, shared.features[:0].detach(), xy[:0], selection_mask=out.mask[:0])
    own, sent = (to_ego_frame([none, *parts], shared.grid, len(samples)) for parts in sides)
    origin, edge = (shared.grid.x_min, shared.grid.y_min), WINDOW_CELLS * shared.grid.cell_size_m
    ids = torch.cat([window_ids(t.xy, t.ego, origin, edge) for t in (sent, own)])
    row = ids.unique(return_inverse=True)[1]
    unit = [functional.normalize(t.features, dim=1) for t in (sent, own)]
    return AgentPairTokens(unit[0], sent.selection_mask, row[: len(sent.xy)], unit[1], row[len(sent.xy) :])
