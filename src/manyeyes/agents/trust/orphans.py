# SPDX-License-Identifier: Apache-2.0
"""Orphans: fused boxes that neither the ego detects nor any sender proposes, the mark of features made against fusion.

A learned fusion may move an object or sharpen it, but it has no reason to find one where no agent proposes any.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.agents.trust._orphan_kernels import clear_proposed, find_near_sites, list_proposals
from manyeyes.agents.trust.association import Floats, find_nearest
from manyeyes.agents.trust.interface import Assessment, Evidence
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT
from manyeyes.models.detector.proposal import PROPOSAL_DIM

RADIUS_M = 2.5
"""A box is of a proposal, or of an own detection, within this distance."""
MIN_PROPOSAL_SCORE = 0.05
"""Minimum score of a proposal: every token proposes something."""
MIN_PROPOSAL_LOGIT = math.log(MIN_PROPOSAL_SCORE / (1 - MIN_PROPOSAL_SCORE))
MAX_SCORE = 0.2
"""Maximum score of an orphan."""
MIN_ORPHANS = 3
"""Number of orphans of one frame among the tokens of one sender alone that count as a fault of that sender."""
# Members of an enumeration are slow to read.
_REFUTED = int(Evidence.REFUTED)
_PROPOSALS: WeakKeyDictionary[SparseBev, Floats] = WeakKeyDictionary()
_COLUMNS = np.array([BOX_LAYOUT.heatmap_logit.start, BOX_LAYOUT.offset.start, BOX_LAYOUT.velocity.start])
"""Of the heat logit, and the first of offset and velocity, in a proposal."""


@dataclass(frozen=True)
class Orphans:
    """rows: (N,) bool, of the boxes of a result. senders: those to whose tokens alone MIN_ORPHANS of them belong."""

    rows: NDArray[np.bool_]
    senders: frozenset[int]


def find_orphans(
    frame: AgentFrame,
    boxes: Boxes,
    cache: PerceptionCache,
    messages: Sequence[Message],
    assessment: Assessment | None = None,
) -> Orphans | None:
    """Return the orphans among boxes (N) in the ego's levelled frame, of a score above MAX_SCORE; None without any.

    messages: all that were fused, older ones too. Clouds propose nothing until they are merged, hence with clouds no box is an
    orphan. assessment: of the senders; claims that were fused as they are propose what most boxes rest on, and are compared first.
    """
    if any(message.points is not None for message in messages):
        return None
    xy = boxes.center[:, :2].double().contiguous().numpy()
    own = cache.process(frame).boxes.center[:, :2].double().numpy()
    places = np.concatenate([own, *_list_fused_claims(assessment)])
    is_orphan = (boxes.score > MAX_SCORE).numpy()
    is_orphan[is_orphan] = find_nearest(xy[is_orphan], places, RADIUS_M) < 0
    if not is_orphan.any():
        return None
    # The newest ones are the most likely to propose what is left; at equal times the ego's own.
    sources = sorted(
        (*_list_own_tokens(cache, frame), *_list_messages(frame, messages)), key=lambda source: source.seconds
    )
    for source in sources:
        source.clear_stated(is_orphan, xy)
    _clear_proposed(is_orphan, xy, [source for source in sources if source.has_proposals])
    if not is_orphan.any():
        return None
    if np.count_nonzero(is_orphan) < MIN_ORPHANS:
        return Orphans(is_orphan, frozenset())
    orphans = np.ascontiguousarray(xy[is_orphan])
    owners = dict[int, NDArray[np.bool_]]()
    for source in sources:
        if source.agent_id is not None:
            owners[source.agent_id] = source.find_near(orphans) | owners.get(source.agent_id, False)
    num_owners = sum((near.astype(np.int64) for near in owners.values()), np.zeros(len(orphans), np.int64))
    alone = {agent_id: int((near & (num_owners == 1)).sum()) for agent_id, near in owners.items()}
    return Orphans(is_orphan, frozenset(agent_id for agent_id, count in alone.items() if count >= MIN_ORPHANS))


def _list_fused_claims(assessment: Assessment | None) -> list[Floats]:
    """List the places of claims (N, 2) whose messages were fused unchanged: of full weight, and none of them refuted.

    A score of ``claims.MIN_SCORE`` is not reached by a proposal below MIN_PROPOSAL_SCORE, so that all of them are proposals.
    """
    if assessment is None:
        return []
    claims = [one for one in assessment.claims or () if assessment.weights.get(one.agent_id, 0.0) >= 1]
    return [one.claims.xy for one in claims if not np.count_nonzero(one.kinds == _REFUTED)]


@dataclass(frozen=True)
class _Source:
    """What some agent observed at some time; seconds since, and rotation (3, 3) and shift (3,) from there to the ego's frame.

    agent_id: None of the ego itself.
    """

    agent_id: int | None
    tokens: SparseBev | None
    objects: Boxes | None
    seconds: float
    rotation: Floats
    shift: Floats

    @property
    def has_proposals(self) -> bool:
        """Whether it has tokens that propose boxes."""
        return self.tokens is not None and self.tokens.features.shape[1] >= PROPOSAL_DIM

    def clear_stated(self, is_orphan: NDArray[np.bool_], boxes: Floats) -> None:
        """Clear the marks (N,) of the boxes (N, 2) that its objects state."""
        if self.objects is not None:
            places = self.objects.center[:, :2].numpy() + self.objects.velocity.numpy() * self.seconds
            # Heights of objects change nothing on level ground.
            is_orphan &= ~find_near_sites(boxes, places.astype(np.float32), self.rotation, self.shift, RADIUS_M)

    def find_near(self, boxes: Floats) -> NDArray[np.bool_]:
        """Return (N,) which of the boxes (N, 2) have a token nearby, whatever it proposes."""
        if self.tokens is None or not self.has_proposals:
            return np.zeros(len(boxes), np.bool_)
        return find_near_sites(boxes, self.tokens.sites.xy.numpy(), self.rotation, self.shift, RADIUS_M)


def _clear_proposed(is_orphan: NDArray[np.bool_], boxes: Floats, sources: Sequence[_Source]) -> None:
    """Clear the marks (N,) of the boxes (N, 2) that tokens of sources propose."""
    proposals = [_find_proposals(source.tokens) for source in sources if source.tokens is not None]
    if not proposals:
        return
    motions = np.empty((len(sources), 7))
    for row, source in zip(motions, sources):
        row[0], row[5:] = source.seconds, source.shift[:2]
        row[1:3], row[3:5] = source.rotation[0, :2], source.rotation[1, :2]
    first = np.cumsum([0, *map(len, proposals)])
    clear_proposed(is_orphan, boxes, np.concatenate(proposals), first, motions, RADIUS_M)


def _find_proposals(tokens: SparseBev) -> Floats:
    """Return the places and velocities (P, 4) that tokens propose, in their own frame; tokens stay in use for some frames."""
    found = _PROPOSALS.get(tokens)
    if found is None:
        columns = tokens.features.shape[1] - PROPOSAL_DIM + _COLUMNS
        scales = np.array((float(tokens.grid.cell_size_m), SPEED_UNIT, MIN_PROPOSAL_LOGIT))
        rows = tokens.features.float().contiguous().numpy()
        found = _PROPOSALS[tokens] = list_proposals(rows, tokens.sites.xy.numpy(), columns, scales)
    return found


def _list_own_tokens(cache: PerceptionCache, frame: AgentFrame) -> list[_Source]:
    """List the ego's own tokens, of this frame and of those before that may be fused too."""
    found, current = list[_Source](), cache.process(frame)
    if isinstance(current, TokenOutput):
        found.append(_Source(None, current.shared_tokens, None, 0.0, np.eye(3), np.zeros(3)))
    for before, output in cache.previous_outputs(frame):
        if isinstance(output, TokenOutput):
            seconds, motion = (frame.timestamp_ns - before.timestamp_ns) * 1e-9, cache.motion_since(frame, before)
            rotation, shift = motion.rotation.double().numpy(), motion.translation.double().numpy()
            found.append(_Source(None, output.shared_tokens, None, seconds, rotation, shift))
    return found


def _list_messages(frame: AgentFrame, messages: Sequence[Message]) -> Iterator[_Source]:
    """List what messages state and propose."""
    from_world, position = frame.world_from_agent.rotation.numpy().T, frame.world_from_agent.translation.numpy()
    for message in messages:
        pose = message.world_from_agent
        rotation, shift = from_world @ pose.rotation.numpy(), from_world @ (pose.translation.numpy() - position)
        seconds = age_s(frame, message)
        yield _Source(message.agent_id, message.tokens, message.objects, seconds, rotation, shift)


def bound_orphans(boxes: Boxes, orphans: Orphans) -> Boxes:
    """Return the boxes with bounded scores of orphans, by falling score."""
    score = boxes.score.clone()
    score[torch.from_numpy(orphans.rows)] = MAX_SCORE
    return replace(boxes, score=score)[score.argsort(descending=True, stable=True)]
