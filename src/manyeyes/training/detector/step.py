# SPDX-License-Identifier: Apache-2.0
"""One forward pass as training sees it: every agent alone, and every ego with its collaborators, in one batch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import Boxes, SparseBev
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.detector import Detector, Seen
from manyeyes.models.fusion.transform_tokens import Part, gather
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.window_attention import window_ids
from manyeyes.training.detector.losses import LossTerms, head_terms, prune_focal
from manyeyes.training.detector.mutual_information import STUDIED, WINDOW_CELLS, Meeting, Target, information_terms
from manyeyes.training.detector.samples import Sample, View
from manyeyes.training.detector.targets import TargetConfig, assign, objects_near

PACKET_TOKENS = 8
"""How many tokens are lost together: what a packet of 1,398 bytes holds of float16 features, about."""


@dataclass(frozen=True)
class Outcome:
    """What one batch of samples gave: every agent's own view (alone), and every ego's with all it hears (together).

    told: what each view tells, on a batch of grids. mask: (N,) in (0, 1), how much of it the selector would keep.
    """

    seen: Seen
    alone: RawBoxes
    together: RawBoxes
    told: SparseBev
    mask: Tensor


def forward(model: Detector, samples: list[Sample], prune_threshold: float | None = None) -> Outcome:
    """Every agent looks as ego, then tells; every sample's ego fuses (CoSTr section III-A).

    The tokens take the very path that they take as bytes: seen in the sender's frame, moved metrically, fused, decoded.
    """
    views = [view for sample in samples for view in sample.views]
    seen = model.see([v.now for v in views], [v.earlier for v in views], prune_threshold)
    alone = model.look(seen.tokens)
    told = model.tell(seen.tokens, alone)
    score = model.choose(told)
    mask = torch.sigmoid(score)
    parts, number = [], 0
    batch, xy = told.sites.batch, told.sites.xy
    for ego, sample in enumerate(samples):
        for i, view in enumerate(sample.views):
            rows = (batch == number).nonzero()[:, 0]
            part = _part(ego, view, told.features, xy)
            if not i:
                part = replace(part, ego_from_sender=None, told=told.features[rows], xy=xy[rows])
            else:
                rows = _arriving(rows, score.detach(), view, (*sample.key, i))
                kept = None if view.keep is None else 1 + mask[rows] - mask[rows].detach()
                part = replace(part, told=told.features[rows], xy=xy[rows], kept=kept)
            parts.append(part)
            number += 1
    past, said = (_before(model, samples, which, prune_threshold) for which in ("past", "said"))
    tokens = gather([*parts, *past, *said], told.grid, len(samples))
    looked_back = gather(past, told.grid, len(samples)) if past else None
    return Outcome(seen, alone, model.fuse(tokens, looked_back), told, mask)


def _part(ego: int, view: View, told: Tensor, xy: Tensor) -> Part:
    return Part(ego, told, xy, view.ego_from_view, view.age_s, view.doubt_xy_m, view.doubt_yaw_rad)


def _arriving(rows: Tensor, score: Tensor, view: View, key: tuple[int | str, ...]) -> Tensor:
    """The rows of a view's tokens that a budget sends and the air does not lose, packet by packet."""
    if view.keep is None and not view.lost:
        return rows
    rng = keyed_generator("arriving", *key)
    if view.keep is not None:
        # Near ties are drawn by chance, so that what is just left out is tried too.
        noise = torch.from_numpy(rng.gumbel(size=len(rows))).float()
        order = (score[rows] + 0.5 * noise).sort(descending=True, stable=True).indices
        rows = rows[order[: view.keep]]
    packet = torch.arange(len(rows)) // PACKET_TOKENS
    luck = torch.from_numpy(rng.random(int(packet[-1]) + 1 if len(rows) else 0))
    return rows[luck[packet] >= view.lost].sort().values


@torch.no_grad()
def _before(
    model: Detector, samples: list[Sample], which: Literal["past", "said"], prune_threshold: float | None
) -> list[Part]:
    """What egos, or those that they hear, told at instants before, as memory holds it: no gradient reaches it."""
    looks = [(ego, view) for ego, sample in enumerate(samples) for view in getattr(sample, which)]
    if not looks:
        return []
    seen = model.see([v.now for _, v in looks], [v.earlier for _, v in looks], prune_threshold)
    told = model.tell(seen.tokens, model.look(seen.tokens))
    score, batch, xy = model.choose(told), told.sites.batch, told.sites.xy
    parts = []
    for number, (ego, view) in enumerate(looks):
        key = (*samples[ego].key, which, number)
        rows = _arriving((batch == number).nonzero()[:, 0], score, view, key)
        parts.append(_part(ego, view, told.features[rows], xy[rows]))
    return parts


def loss_terms(
    model: Detector,
    samples: list[Sample],
    targets: TargetConfig,
    prune_threshold: float | None = None,
    together: float = 0.5,
    target: Target = "own_task",
) -> LossTerms:
    """Losses of one batch: egos against the union of what their agents list, each agent against its own list.

    together: the share of the former. target: what the selector's information is measured against.
    """
    out = forward(model, samples, prune_threshold)
    listed: list[Boxes] = [view.seen for sample in samples for view in sample.views]
    union = [sample.union for sample in samples]
    prune = torch.stack([prune_focal(p, objects_near(p.sites, listed, targets)) for p in out.seen.pruned]).mean()
    own = assign(out.alone.sites, listed, targets)
    kept, information = information_terms(out.told, out.mask, own.heat)
    if target != "own_task":
        information = STUDIED[target](meeting(out, samples))
    alone = head_terms(out.alone, own, prune, kept, information)
    fused = head_terms(out.together, assign(out.together.sites, union, targets), prune, kept, information)
    return alone.mixed(fused, together)


def meeting(out: Outcome, samples: list[Sample]) -> Meeting:
    """What collaborators tell and what their egos see themselves, in windows of the egos' frames; no gradient but the mask's."""
    told, batch, xy = out.told, out.told.sites.batch, out.told.sites.xy
    views = [(ego, i, view) for ego, sample in enumerate(samples) for i, view in enumerate(sample.views)]
    sides: tuple[list[Part], list[Part]] = ([], [])
    for number, (ego, i, view) in enumerate(views):
        rows = batch == number
        part = _part(ego, view, told.features[rows].detach(), xy[rows])
        sides[i > 0].append(replace(part, kept=out.mask[rows]))
    none = Part(0, told.features[:0].detach(), xy[:0], kept=out.mask[:0])
    had, sent = (gather([none, *parts], told.grid, len(samples)) for parts in sides)
    origin, edge = (told.grid.x_min, told.grid.y_min), WINDOW_CELLS * told.grid.cell
    ids = torch.cat([window_ids(t.xy, t.ego, origin, edge) for t in (sent, had)])
    row = ids.unique(return_inverse=True)[1]
    unit = [functional.normalize(t.features, dim=1) for t in (sent, had)]
    return Meeting(unit[0], sent.kept, row[: len(sent.xy)], unit[1], row[len(sent.xy) :])
