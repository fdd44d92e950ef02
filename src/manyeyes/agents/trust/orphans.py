# SPDX-License-Identifier: Apache-2.0
"""Orphans: fused boxes that neither the ego detects nor any sender proposes, the mark of features made against fusion.

A learned fusion may move an object or sharpen it, but it has no reason to find one where no agent proposes any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.perception_cache import PerceptionCache, TokenOutput
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.agents.trust._orphan_kernels import clear_proposed, find_near_sites
from manyeyes.agents.trust.association import Floats, find_nearest
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
_COLUMNS = np.array([BOX_LAYOUT.heatmap_logit.start, BOX_LAYOUT.offset.start, BOX_LAYOUT.velocity.start])
"""Of the heat logit, and the first of offset and velocity, in a proposal."""


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
    xy = boxes.center[:, :2].double().contiguous().numpy()
    own = cache.process(frame).boxes.center[:, :2].double().numpy()
    is_orphan = (boxes.score > MAX_SCORE).numpy() & (find_nearest(xy, own, RADIUS_M) < 0)
    if not is_orphan.any():
        return None
    senders = _Senders(frame)
    # The newest ones are the most likely to propose what is left; at equal times the ego's own.
    for source in sorted([*_list_own_tokens(cache, frame), *messages], key=lambda one: -one.timestamp_ns):
        if isinstance(source, Message):
            senders.clear(is_orphan, xy, source)
        else:
            source.place(frame).clear(is_orphan, xy)
        if not is_orphan.any():
            return None
    orphans = np.ascontiguousarray(xy[is_orphan])
    owners = dict[int, NDArray[np.bool_]]()
    for message in messages:
        owners[message.agent_id] = senders.find_near(orphans, message) | owners.get(message.agent_id, False)
    num_owners = sum((near.astype(np.int64) for near in owners.values()), np.zeros(len(orphans), np.int64))
    alone = {agent_id: int((near & (num_owners == 1)).sum()) for agent_id, near in owners.items()}
    return Orphans(is_orphan, frozenset(agent_id for agent_id, count in alone.items() if count >= MIN_ORPHANS))


@dataclass(frozen=True)
class _PlacedTokens:
    """Tokens of some frame; seconds since, and rotation (3, 3) and shift (3,) from there to the ego's frame."""

    tokens: SparseBev
    seconds: float
    rotation: Floats
    shift: Floats

    def clear(self, is_orphan: NDArray[np.bool_], boxes: Floats) -> None:
        """Clear the marks (N,) of the boxes (N, 2) that the tokens propose."""
        features = self.tokens.features
        columns = features.shape[1] - PROPOSAL_DIM + _COLUMNS
        scales = (float(self.tokens.grid.cell_size_m), SPEED_UNIT * self.seconds, MIN_PROPOSAL_LOGIT, RADIUS_M)
        rows = features.float().contiguous().numpy()
        sites = self.tokens.sites.xy.numpy()
        clear_proposed(is_orphan, boxes, rows, sites, columns, self.rotation, self.shift, np.array(scales))


@dataclass(frozen=True)
class _OwnTokens:
    """The ego's tokens of one of its frames."""

    frame: AgentFrame
    tokens: SparseBev

    @property
    def timestamp_ns(self) -> int:
        return self.frame.timestamp_ns

    def place(self, now: AgentFrame) -> _PlacedTokens:
        """Return them relative to a later frame."""
        seconds, motion = (now.timestamp_ns - self.timestamp_ns) * 1e-9, now.now_from_earlier(self.frame)
        return _PlacedTokens(
            self.tokens, seconds, motion.rotation.double().numpy(), motion.translation.double().numpy()
        )


def _list_own_tokens(cache: PerceptionCache, frame: AgentFrame) -> list[_OwnTokens]:
    """List the ego's own tokens, of this frame and of those before that may be fused too."""
    outputs = ((frame, cache.process(frame)), *cache.previous_outputs(frame))
    return [_OwnTokens(then, one.shared_tokens) for then, one in outputs if isinstance(one, TokenOutput)]


class _Senders:
    """Places in messages relative to the ego's frame at its time."""

    def __init__(self, frame: AgentFrame) -> None:
        self._frame = frame
        self._rotation = frame.world_from_agent.rotation.numpy().T
        self._position = frame.world_from_agent.translation.numpy()

    def clear(self, is_orphan: NDArray[np.bool_], boxes: Floats, message: Message) -> None:
        """Clear the marks (N,) of the boxes (N, 2) that a message proposes or states."""
        if message.objects is not None:
            objects, seconds = message.objects, age_s(self._frame, message)
            places = objects.center[:, :2].numpy() + objects.velocity.numpy() * seconds
            rotation, shift = self._find_motion(message)
            # Heights of objects change nothing on level ground.
            is_orphan &= ~find_near_sites(boxes, places.astype(np.float32), rotation, shift, RADIUS_M)
        if message.tokens is not None and message.tokens.features.shape[1] >= PROPOSAL_DIM:
            motion = self._find_motion(message)
            _PlacedTokens(message.tokens, age_s(self._frame, message), *motion).clear(is_orphan, boxes)

    def find_near(self, boxes: Floats, message: Message) -> NDArray[np.bool_]:
        """Return (N,) which of the boxes (N, 2) have a token of a message nearby, whatever it proposes."""
        if message.tokens is None or message.tokens.features.shape[1] < PROPOSAL_DIM:
            return np.zeros(len(boxes), np.bool_)
        return find_near_sites(boxes, message.tokens.sites.xy.numpy(), *self._find_motion(message), RADIUS_M)

    def _find_motion(self, message: Message) -> tuple[Floats, Floats]:
        pose = message.world_from_agent
        rotation = self._rotation @ pose.rotation.numpy()
        return rotation, self._rotation @ (pose.translation.numpy() - self._position)


def bound_orphans(boxes: Boxes, orphans: Orphans) -> Boxes:
    """Return the boxes with bounded scores of orphans, by falling score."""
    score = boxes.score.clone()
    score[torch.from_numpy(orphans.rows)] = MAX_SCORE
    return replace(boxes, score=score)[score.argsort(descending=True, stable=True)]
