# SPDX-License-Identifier: Apache-2.0
"""Selection of the received content that is fused at one instant, which bounds the time of a fusion."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import torch

from manyeyes.comms.bandwidth import allocate_max_min_fair
from manyeyes.comms.inbox import ReceivedMessage, Rejection
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import AgentFrame, Message, SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat

KnownSenders = Mapping[int, tuple[int, int]]
"""Times (ns) of the first and of the last fusion of senders, by agent id."""
MAX_GAP_NS = 2_000_000_000
"""A sender that was not fused for longer is unknown again."""
MIN_SHARE = 256
"""Number of tokens that a sender may have fused whatever its trust, so that it can regain it."""


def update_known_senders(known: KnownSenders, fused: Collection[int], now_ns: int) -> KnownSenders:
    """Return the known senders after a fusion."""
    current = {agent_id: (known[agent_id][0] if agent_id in known else now_ns, now_ns) for agent_id in fused}
    return {a: (first, last) for a, (first, last) in {**known, **current}.items() if abs(now_ns - last) <= MAX_GAP_NS}


def first_fusion_ns(known: KnownSenders, agent_id: int) -> float:
    """Return the time of the first fusion of a sender, ns; infinite for an unknown one."""
    return known[agent_id][0] if agent_id in known else math.inf


def select_for_fusion(
    frame: AgentFrame,
    received: Sequence[ReceivedMessage],
    known: KnownSenders,
    limits: ReceiverLimits,
    weights: Mapping[int, float] | None = None,
) -> tuple[list[ReceivedMessage], list[Rejection]]:
    """Return at most limits.max_fused_senders messages, with at most limits.max_fused_tokens tokens; and the senders left out.

    weights: of senders by trust, in [0, 1]; 1 of all others. Messages with content come before empty ones, senders of weight 0
    last, then senders in the order of their first fusion, so that new ones displace none, then the nearest. Where there are too
    many tokens, the demand of a sender is multiplied by its weight, but for MIN_SHARE tokens. The tokens of one message that
    exceed its share are left out in the order of their proposed confidence.
    """
    weights = weights or {}
    if len(received) > limits.max_fused_senders:
        order = sorted(
            received,
            key=lambda r: (
                _is_empty(r.message),
                weights.get(r.message.agent_id, 1.0) <= 0.0,
                first_fusion_ns(known, r.message.agent_id),
                _distance_m(frame, r),
            ),
        )
        selected = {r.message.agent_id for r in order[: limits.max_fused_senders]}
    else:
        selected = {r.message.agent_id for r in received}
    kept = [r for r in received if r.message.agent_id in selected]
    left_out = [busy_rejection(r.message.agent_id, limits) for r in received if r.message.agent_id not in selected]
    counts = [r.num_tokens for r in kept]
    demands = counts
    if sum(counts) > limits.max_fused_tokens:
        trusted = [min(1.0, weights.get(r.message.agent_id, 1.0)) for r in kept]
        demands = [min(n, max(MIN_SHARE, round(w * n))) for w, n in zip(trusted, counts)]
    shares = allocate_max_min_fair(limits.max_fused_tokens, demands)
    return [_keep_tokens(r, share) if share < n else r for r, n, share in zip(kept, counts, shares)], left_out


def busy_rejection(agent_id: int, limits: ReceiverLimits) -> Rejection:
    """Return the rejection of a sender beyond the number of senders that are fused."""
    return Rejection(agent_id, "busy", f"more than {limits.max_fused_senders} senders at one instant")


def _is_empty(message: Message) -> bool:
    return message.tokens is None and message.objects is None and message.points is None


def _distance_m(frame: AgentFrame, reception: ReceivedMessage) -> float:
    here, there = frame.world_from_agent.translation, reception.message.world_from_agent.translation
    distance = math.dist(here.tolist(), there.tolist())
    return distance if distance == distance else math.inf


def _keep_tokens(reception: ReceivedMessage, count: int) -> ReceivedMessage:
    """Return a message with its most confident tokens."""
    message = reception.message
    assert message.tokens is not None
    tokens: SparseBev = message.tokens
    heat = proposed_heat(tokens.features[:, -PROPOSAL_DIM:])
    rows = heat.argsort(descending=True, stable=True)[:count]
    kept = torch.zeros(len(heat), dtype=torch.bool).index_fill(0, rows, True)
    score = None if message.token_score is None else message.token_score[kept]
    return replace(reception, message=replace(message, tokens=tokens.keep(kept), token_score=score))
