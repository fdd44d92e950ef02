# SPDX-License-Identifier: Apache-2.0
"""Forward pass and losses of one training step: single-agent and fused detection in one batch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import Sites, SparseBev
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector, ExtractedFeatures
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.window_attention import window_ids
from manyeyes.training.detector.distillation import distillation_loss, teacher_features
from manyeyes.training.detector.losses import LossTerms, heads_terms, prune_focal
from manyeyes.training.detector.mutual_information import (
    STUDY_TARGETS,
    WINDOW_CELLS,
    AgentPairTokens,
    InformationTarget,
    mutual_information_loss,
)
from manyeyes.training.detector.samples import AgentView, Sample
from manyeyes.training.detector.targets import (
    BoxBatch,
    TargetConfig,
    Targets,
    add_class_heat,
    assign_targets,
    find_nearby_objects,
)

TOKENS_PER_PACKET = 8
"""Number of tokens lost together: a packet of 1,398 bytes holds about as many float16 features."""

_HISTORY_KEYS = {"ego_history": "past", "sender_history": "said"}
"""Parts of random keys; other values would change every training run."""


@dataclass(frozen=True)
class SingleAgentOutput:
    """What each view gives by itself.

    features: of all views. boxes: of all views. shared_tokens: of each view, on a batch of grids. score: (N,) of the selector.
    """

    features: ExtractedFeatures
    boxes: RawBoxes
    shared_tokens: SparseBev
    score: Tensor


@dataclass(frozen=True)
class ForwardOutput:
    """Outputs for one batch of samples: single-agent boxes of every view, fused boxes and features of every ego.

    shared_tokens: of each view, on a batch of grids. mask: (N,) in (0, 1), the selector's mask.
    """

    features: ExtractedFeatures
    single_agent_boxes: RawBoxes
    fused_boxes: RawBoxes
    shared_tokens: SparseBev
    mask: Tensor
    fused_features: SparseBev


def forward_single(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> SingleAgentOutput:
    """Encode every view as ego."""
    views = [view for sample in samples for view in sample.views]
    seen = model.extract_features([v.cloud for v in views], [v.previous_cloud for v in views], prune_threshold)
    alone = model.predict(seen.tokens)
    shared = model.make_tokens(seen.tokens, alone)
    return SingleAgentOutput(seen, alone, shared, model.score_tokens(shared))


def forward(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> ForwardOutput:
    """Encode every view as ego and fuse the shared tokens of every sample (CoSTr section III-A).

    Tokens are processed as in deployment: computed in the sender's frame, transformed metrically, fused, decoded.
    """
    single = forward_single(model, samples, prune_threshold)
    shared, score, mask = single.shared_tokens, single.score, torch.sigmoid(single.score)
    links = [
        _Link(ego, view, (*sample.key, i), is_own=not i)
        for ego, sample in enumerate(samples)
        for i, view in enumerate(sample.views)
    ]
    parts = _deliver(_as_sent(model, shared, links), links, score, mask)
    ego_history, sender_history = (
        _history_tokens(model, samples, which, prune_threshold) for which in ("ego_history", "sender_history")
    )
    tokens = to_ego_frame([*parts, *ego_history, *sender_history], shared.grid, len(samples))
    ego_past = to_ego_frame(ego_history, shared.grid, len(samples)) if ego_history else None
    fused, boxes = model.fuse(tokens, ego_past)
    return ForwardOutput(single.features, single.boxes, boxes, shared, mask, fused.bev)


@dataclass(frozen=True)
class _Link:
    """How the tokens of a view reach an ego: its number in the batch, the key of random draws, and whether they are its own current
    ones, which nothing degrades.
    """

    ego: int
    view: AgentView
    key: tuple[int | str, ...]
    is_own: bool = False


def _deliver(shared: SparseBev, links: list[_Link], score: Tensor, mask: Tensor | None) -> list[AgentTokens]:
    """Return what arrives of the tokens of each view, a grid of the batch; mask (N,): of the selector, for its gradient."""
    sizes, device = count_sites(shared.sites), score.device
    is_whole = all(link.is_own or _is_complete(link.view) for link in links)
    features, xy = shared.features, shared.sites.xy
    masks: list[Tensor | None] = [None] * len(links)
    if not is_whole:
        # What arrives is drawn on the CPU, so that the device is asked once and not once a view.
        drawn, chosen = score.detach().cpu(), list[Tensor]()
        for rows, link in zip(torch.arange(len(drawn), device="cpu").split(sizes), links):
            chosen.append(rows if link.is_own else _select_delivered(rows, drawn, link.view, link.key))
        sizes, rows = [len(part) for part in chosen], torch.cat(chosen).to(device)
        features, xy = features.index_select(0, rows), xy.index_select(0, rows)
        if mask is not None:
            kept = mask.index_select(0, rows)
            parts = (1 + kept - kept.detach()).split(sizes)
            masks = [None if link.is_own or link.view.max_tokens is None else part for link, part in zip(links, parts)]
    split = zip(links, features.split(sizes), xy.split(sizes), masks)
    return [_agent_tokens(link, own, place, kept) for link, own, place, kept in split]


def _as_sent(model: Detector, shared: SparseBev, links: list[_Link]) -> SparseBev:
    """Return the tokens of each view as they are fused: compressed by their senders, but of the egos themselves."""
    packed = model.unpack_tokens(model.pack_tokens(shared))
    sent = model.compress_tokens(packed)
    if sent is packed:
        return packed
    is_own = torch.tensor([link.is_own for link in links], device=shared.features.device)[shared.sites.batch]
    return packed.with_features(torch.where(is_own[:, None], packed.features, sent.features))


def _is_complete(view: AgentView) -> bool:
    return view.max_tokens is None and not view.loss_fraction


def _agent_tokens(link: _Link, features: Tensor, xy: Tensor, mask: Tensor | None = None) -> AgentTokens:
    view = link.view
    motion = None if link.is_own else view.ego_from_view
    sigmas, roadside = (view.sigma_xy_m, view.sigma_yaw_rad), view.is_infrastructure
    return AgentTokens(link.ego, features, xy, motion, view.age_s, *sigmas, mask, roadside)


def count_sites(sites: Sites) -> list[int]:
    """Return the number of sites of each grid of the batch."""
    rows, columns = sites.grid.shape
    ends = torch.arange(1, sites.batch_size + 1, device=sites.key.device) * (rows * columns)
    total = torch.searchsorted(sites.key, ends).tolist()
    return [after - before for before, after in pairwise([0, *total])]


def _select_delivered(rows: Tensor, score: Tensor, view: AgentView, key: tuple[int | str, ...]) -> Tensor:
    """Select the rows of a view's tokens that fit its budget and are not lost, packet by packet; all on the CPU."""
    if _is_complete(view):
        return rows
    rng = keyed_generator("arriving", *key)
    if view.max_tokens is not None:
        # Noise exchanges tokens of similar score, so that those just below the budget are explored.
        noise = torch.from_numpy(rng.gumbel(size=len(rows))).float()
        order = (score[rows] + 0.5 * noise).sort(descending=True, stable=True).indices
        rows = rows[order[: view.max_tokens]]
    packet = torch.arange(len(rows), device="cpu") // TOKENS_PER_PACKET
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
    keys = [(*samples[ego].key, _HISTORY_KEYS[which], number) for number, (ego, _) in enumerate(views)]
    links = [_Link(ego, view, key) for (ego, view), key in zip(views, keys)]
    sent = _as_sent(model, shared, links if which == "sender_history" else [replace(k, is_own=True) for k in links])
    return _deliver(sent, links, model.score_tokens(shared), None)


def loss_terms(
    model: Detector,
    samples: list[Sample],
    targets: TargetConfig,
    prune_threshold: float | None = None,
    fusion_weight: float = 0.5,
    target: InformationTarget = "own_task",
    teacher: Detector | None = None,
) -> LossTerms:
    """Compute the losses of one batch: fused boxes against the merged ground truth, single-agent boxes against each
    agent's own.

    fusion_weight: fraction of the former; at 0 nothing is fused. target: reference of the selector's mutual information.
    teacher: of the fused features, on merged clouds (``distillation``).
    """
    if fusion_weight == 0 and target == "own_task":
        single = forward_single(model, samples, prune_threshold)
        own = _single_terms(model, single, torch.sigmoid(single.score), samples, targets)
        return heads_terms([own.head], *own.rest)[0]
    out = forward(model, samples, prune_threshold)
    single = SingleAgentOutput(out.features, out.single_agent_boxes, out.shared_tokens, out.mask)
    own = _single_terms(model, single, out.mask, samples, targets)
    if target != "own_task":
        own = replace(own, information=STUDY_TARGETS[target](pair_agent_tokens(out, samples)))
    merged_boxes, sites = [sample.merged_gt_boxes for sample in samples], out.fused_boxes.sites
    assigned = assign_targets(sites, BoxBatch.of(merged_boxes, out.mask.device), targets)
    both = add_class_heat(assigned, sites, merged_boxes, model.config.classes, targets)
    alone, fused = heads_terms((own.head, (out.fused_boxes, both)), *own.rest)
    mixed = alone.mix(fused, fusion_weight)
    if teacher is None:
        return mixed
    taught = teacher_features(teacher, samples, prune_threshold)
    return replace(mixed, distillation=distillation_loss(out.fused_features, taught))


@dataclass(frozen=True)
class _SingleTerms:
    """Single-agent boxes with their targets, and the losses that no fusion changes."""

    head: tuple[RawBoxes, Targets]
    prune: Tensor
    mask_l1: Tensor
    information: Tensor

    @property
    def rest(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.prune, self.mask_l1, self.information


def _single_terms(
    model: Detector, single: SingleAgentOutput, mask: Tensor, samples: list[Sample], targets: TargetConfig
) -> _SingleTerms:
    """Assign the targets of single-agent boxes, and compute the losses of pruning and of the selector's mask (N,)."""
    listed_boxes = [view.visible_boxes for sample in samples for view in sample.views]
    listed = BoxBatch.of(listed_boxes, mask.device)
    found = ((pruned, find_nearby_objects(pruned.sites, listed, targets)) for pruned in single.features.pruned)
    prune = torch.stack([prune_focal(pruned, near, len(listed.boxes)) for pruned, near in found]).mean()
    sites = single.boxes.sites
    own = add_class_heat(assign_targets(sites, listed, targets), sites, listed_boxes, model.config.classes, targets)
    kept, information = mutual_information_loss(single.shared_tokens, mask, own.heat)
    return _SingleTerms((single.boxes, own), prune, kept, information)


def pair_agent_tokens(out: ForwardOutput, samples: list[Sample]) -> AgentPairTokens:
    """Pair the collaborators' tokens with the egos' own in windows of the egos' frames; only the mask carries a
    gradient.
    """
    shared, xy, sizes = out.shared_tokens, out.shared_tokens.sites.xy, count_sites(out.shared_tokens.sites)
    views = [(ego, i, view) for ego, sample in enumerate(samples) for i, view in enumerate(sample.views)]
    sides: tuple[list[AgentTokens], list[AgentTokens]] = ([], [])
    columns = zip(shared.features.detach().split(sizes), xy.split(sizes), out.mask.split(sizes))
    for (ego, i, view), column in zip(views, columns):
        sides[i > 0].append(_agent_tokens(_Link(ego, view, ()), *column))
    none = AgentTokens(0, shared.features[:0].detach(), xy[:0], selection_mask=out.mask[:0])
    own, sent = (to_ego_frame([none, *parts], shared.grid, len(samples)) for parts in sides)
    origin, edge = (shared.grid.x_min, shared.grid.y_min), WINDOW_CELLS * shared.grid.cell_size_m
    ids = torch.cat([window_ids(t.xy, t.ego, origin, edge) for t in (sent, own)])
    row = ids.unique(return_inverse=True)[1]
    unit = [functional.normalize(t.features, dim=1) for t in (sent, own)]
    return AgentPairTokens(unit[0], sent.selection_mask, row[: len(sent.xy)], unit[1], row[len(sent.xy) :])
