# SPDX-License-Identifier: Apache-2.0
"""Orphans: fused boxes that neither the ego detects nor any sender proposes, the mark of features made against fusion.

A learned fusion may move an object or sharpen it, but it has no reason to find one where no agent proposes any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.agents.strategies.message_header import age_s, ego_from_sender
from manyeyes.agents.trust.association import Floats, find_nearest
from manyeyes.agents.trust.fusion_weights import object_places, token_places
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat

RADIUS_M = 2.5
"""A box is of a proposal, or of an own detection, within this distance."""
MIN_PROPOSAL_SCORE = 0.05
"""Minimum score of a proposal: every token proposes something."""
MAX_SCORE = 0.2
"""Maximum score of an orphan."""
MIN_ORPHANS = 3
"""Number of orphans of one frame among the tokens of one sender alone that count as a fault of that sender."""


@dataclass(frozen=True)
class Orphans:
    """rows: (N,) bool, of the boxes of a result. senders: those to whose tokens alone MIN_ORPHANS of them belong."""

    rows: NDArray[np.bool_]
    senders: frozenset[int]


def find_orphans(
    frame: AgentFrame, boxes: Boxes, cache: PerceptionCache, messages: Sequence[Message]
) -> Orphans | None:
    """Return the orphans among boxes (N) in the ego's levelled frame, of a score above MAX_SCORE; None without any.

    messages: all that were fused, older ones too. Clouds propose nothing until they are merged, hence with clouds no box is an
    orphan.
    """
    if any(message.points is not None for message in messages):
        return None
    xy = boxes.center[:, :2].double().numpy()
    own = cache.process(frame).boxes.center[:, :2].double().numpy()
    is_orphan = (boxes.score > MAX_SCORE).numpy() & (find_nearest(xy, own, RADIUS_M) < 0)
    tokens_of = dict[int, list[Floats]]()
    for message in messages:
        if not is_orphan.any():
            return None
        proposed, places = _find_places(frame, message)
        is_orphan &= find_nearest(xy, proposed, RADIUS_M) < 0
        tokens_of.setdefault(message.agent_id, []).append(places)
    if is_orphan.any():
        is_orphan &= find_nearest(xy, _find_own_proposals(cache, frame), RADIUS_M) < 0
    if not is_orphan.any():
        return None
    orphans = xy[is_orphan]
    owners = {a: find_nearest(orphans, np.concatenate(places), RADIUS_M) >= 0 for a, places in tokens_of.items()}
    num_owners = sum((near.astype(np.int64) for near in owners.values()), np.zeros(len(orphans), np.int64))
    alone = {agent_id: int((near & (num_owners == 1)).sum()) for agent_id, near in owners.items()}
    return Orphans(is_orphan, frozenset(agent_id for agent_id, count in alone.items() if count >= MIN_ORPHANS))


def _find_own_proposals(cache: PerceptionCache, frame: AgentFrame) -> Floats:
    """Return what the ego itself proposes (N, 2), in this frame and in those before that may be fused too."""
    found = list[Tensor]()
    for then, output in ((frame, cache.process(frame)), *cache.previous_outputs(frame)):
        if isinstance(output, TokenOutput):
            seconds = (frame.timestamp_ns - then.timestamp_ns) * 1e-9
            motion = frame.now_from_earlier(then)
            tokens = output.shared_tokens
            heat = proposed_heat(tokens.features[:, -PROPOSAL_DIM:])
            found.append(token_places(tokens, seconds, motion)[torch.sigmoid(heat) >= MIN_PROPOSAL_SCORE])
    return torch.cat(found).double().numpy() if found else np.zeros((0, 2))


def _find_places(frame: AgentFrame, message: Message) -> tuple[Floats, Floats]:
    """Return the proposals (N, 2) of MIN_PROPOSAL_SCORE and the tokens (M, 2) of a message, in the ego's frame at its time."""
    seconds, ego_from_other = age_s(frame, message), ego_from_sender(frame, message)
    proposed, tokens = list[Tensor](), torch.zeros(0, 2)
    if message.objects is not None:
        proposed.append(object_places(message.objects, seconds, ego_from_other))
    if message.tokens is not None and message.tokens.features.shape[1] >= PROPOSAL_DIM:
        heat = proposed_heat(message.tokens.features[:, -PROPOSAL_DIM:])
        places = token_places(message.tokens, seconds, ego_from_other)
        proposed.append(places[torch.sigmoid(heat) >= MIN_PROPOSAL_SCORE])
        sites = message.tokens.sites.xy
        tokens = ego_from_other.apply(torch.cat((sites, sites.new_zeros(len(sites), 1)), 1).double())[:, :2]
    found = torch.cat([place.double() for place in proposed]) if proposed else tokens.new_zeros((0, 2))
    return found.double().numpy(), tokens.double().numpy()


def bound_orphans(boxes: Boxes, orphans: Orphans) -> Boxes:
    """Return the boxes with bounded scores of orphans, by falling score."""
    score = boxes.score.clone()
    score[torch.from_numpy(orphans.rows)] = MAX_SCORE
    return replace(boxes, score=score)[score.argsort(descending=True, stable=True)]
