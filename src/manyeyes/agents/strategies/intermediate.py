# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion: every agent sends tokens; the ego moves them into its frame and fuses them (CoSTr Eq. 1).

Without history: the ego's tokens of the present sweep and the newest message of each sender. With it (the forms ``-temporal``, and
the default of agents): also the tokens of the last two frames, own and received ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import age_s, make_header
from manyeyes.agents.strategies.redundancy import distinct_score, novelty_score
from manyeyes.agents.strategies.registry import FusionStrategy, register_strategy
from manyeyes.agents.token_codec import has_token_history
from manyeyes.comms.request_map import compute_request_weights
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev, Transform
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens, split_last, to_ego_frame
from manyeyes.ops.keyed_random import keyed_uniform


def mask_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Score of the trained mask (CoSTr section III-E)."""
    with torch.inference_mode():
        return torch.sigmoid(cache.token_detector.score_tokens(cache.process_tokens(frame).tokens_raw_velocity))


def confidence_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Confidence of the sender that the token is the centre of an object: the rule of Where2comm, on tokens."""
    return torch.sigmoid(proposed_heat(cache.process_tokens(frame).shared_tokens.features[:, -PROPOSAL_DIM:]))


def random_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return a uniform draw for every token, keyed by sender and time."""
    return keyed_uniform(
        (len(cache.process_tokens(frame).shared_tokens.sites),), 0, "selection", frame.agent_id, frame.timestamp_ns
    ).float()


WeighScores = Callable[[PerceptionCache, AgentFrame, SparseBev, Tensor, Sequence[Message]], Tensor]
"""Weighs the scores (N,) of tokens by received messages, the requests of the last instant; tokens of -inf are not sent."""


def weigh_by_requests(
    cache: PerceptionCache, frame: AgentFrame, tokens: SparseBev, score: Tensor, requests: Sequence[Message]
) -> Tensor:
    """Lower the scores (N,) of tokens where receivers are confident (``comms.request_map``)."""
    return score * compute_request_weights(tokens.sites.xy, frame.world_from_agent, requests)


@register_strategy("intermediate")
@dataclass(frozen=True)
class IntermediateFusion(FusionStrategy):
    """Fusion of tokens of the ego's own weights; the inbox rejects others.

    score: order in which a budget keeps tokens. uses_history: the tokens of the last two frames are fused too; receivers then have
    earlier tokens, which novelty_score takes into account. weigh: how requests of receivers change the scores.
    """

    score: Callable[[PerceptionCache, AgentFrame], Tensor] = distinct_score
    uses_history: bool = False
    needs_tokens: bool = True
    uses_points = False
    score_form = "fused"
    weigh: WeighScores = weigh_by_requests

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return the pruned tokens with their proposals, and their scores for selection within a budget."""
        tokens, header = cache.process_tokens(frame).shared_tokens, make_header(frame, cache.detector.fingerprint)
        score = self.weigh(cache, frame, tokens, self.score(cache, frame), requests)
        is_sent = score > -torch.inf
        if not bool(is_sent.all()):
            tokens, score = tokens.keep(is_sent), score[is_sent]
        return replace(header, tokens=tokens, token_score=score)

    def record_sent(self, cache: PerceptionCache, frame: AgentFrame, message: Message) -> None:
        """Record the sent tokens, which reduce the scores of later ones (``strategies.redundancy``)."""
        if message.tokens is not None:
            cache.record_sent(frame, message.tokens)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the fused tokens."""
        return cache.decode(cache.fuse(*self.gather(cache, frame, messages))[1])

    def gather(
        self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]
    ) -> tuple[Tokens, Tokens | None]:
        """Return the tokens that are fused, and the ego's own past ones among them, if any."""
        if self.uses_history:
            return gather_with_past(cache, frame, messages)
        return gather_tokens(cache, frame, messages), None


register_strategy("intermediate-temporal")(partial(IntermediateFusion, novelty_score, uses_history=True))
for name, score in (("mi", mask_score), ("confidence", confidence_score), ("random", random_score)):
    register_strategy(f"intermediate-{name}")(partial(IntermediateFusion, score))
    register_strategy(f"intermediate-{name}-temporal")(partial(IntermediateFusion, score, uses_history=True))


def gather_tokens(
    cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message], past: Sequence[AgentTokens] = ()
) -> Tokens:
    """Return the ego's tokens of a frame, those of every message on the same lattice, and its own past ones, in the ego's frame.

    Older tokens are propagated by their proposed velocity, and weighted by their age (``models.fusion.token_merge``).
    """
    own = cache.process_tokens(frame).shared_tokens
    on_grid = [(m, m.tokens) for m in messages if m.tokens is not None and m.tokens.grid == own.grid]
    ego_from_world = frame.world_from_agent.inverse()
    received = [_to_agent_tokens(frame, ego_from_world, message, tokens) for message, tokens in on_grid]
    current = AgentTokens(0, own.features, own.sites.xy, is_infrastructure=frame.is_infrastructure)
    return to_ego_frame([current, *received, *past], own.grid, 1)


def gather_with_past(
    cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]
) -> tuple[Tokens, Tokens | None]:
    """Return the ego's current and past tokens with those of every message on the same lattice; and its own past tokens alone."""
    grid = cache.process_tokens(frame).shared_tokens.grid
    past = cache.previous_tokens(frame) if has_token_history(cache.detector) else []
    num_received = sum(m.tokens is not None and m.tokens.grid == grid for m in messages)
    tokens = gather_tokens(cache, frame, messages, past)
    return tokens, split_last(tokens, 1 + num_received) if past else None


def _to_agent_tokens(frame: AgentFrame, ego_from_world: Transform, message: Message, tokens: SparseBev) -> AgentTokens:
    """Return tokens in the ego's frame; the pose variances of ego and sender add up."""
    x, y, yaw = (frame.pose_covariance + message.pose_covariance).diagonal().tolist()
    motion, age, roadside = ego_from_world @ message.world_from_agent, age_s(frame, message), message.is_infrastructure
    sigma_xy_m, sigma_yaw_rad = math.sqrt(max((x + y) / 2, 0.0)), math.sqrt(max(yaw, 0.0))
    return AgentTokens(
        0, tokens.features, tokens.sites.xy, motion, age, sigma_xy_m, sigma_yaw_rad, is_infrastructure=roadside
    )
