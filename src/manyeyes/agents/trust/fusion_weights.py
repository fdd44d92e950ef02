# SPDX-License-Identifier: Apache-2.0
"""Trust in fusion: messages with weighted scores, without refuted claims; excluded senders contribute nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from manyeyes.agents.strategies.message_header import age_s, ego_from_sender
from manyeyes.agents.strategies.redundancy import proposed_centres
from manyeyes.agents.trust.interface import AssessedClaims, Assessment, Evidence
from manyeyes.comms.inbox import ReceivedMessage, Rejection
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev, Transform
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_velocity

REMOVAL_RADIUS_M = 2.0
"""Objects and tokens whose centres are closer to a refuted claim are removed."""
MIN_LOG_WEIGHT = -4.0
"""Minimum of what a weight adds to the heat logit of a token."""


def weigh_received(
    frame: AgentFrame, received: Sequence[ReceivedMessage], assessment: Assessment
) -> tuple[tuple[ReceivedMessage, ...], tuple[Rejection, ...]]:
    """Return the weighted messages of senders of a positive weight, and the rejection of the others.

    Of an excluded sender whose confirmed claims are kept, the part near them is returned, beside the rejection.
    """
    claims = {assessed.agent_id: assessed for assessed in assessment.claims or ()}
    kept, rejected = list[ReceivedMessage](), list[Rejection]()
    senders = {sender.agent_id: sender for sender in assessment.senders}
    for reception in received:
        agent_id = reception.message.agent_id
        sender = senders[agent_id]
        if sender.weight > 0:
            message = weigh_message(frame, reception.message, sender.weight, claims.get(agent_id))
            kept.append(replace(reception, message=message))
        else:
            text = f"{sender.status.value}, trust {sender.trust:.2f}: {sender.reason}"
            message = None
            if sender.keeps_confirmed and agent_id in claims:
                message = keep_confirmed(frame, reception.message, claims[agent_id])
            if message is not None:
                kept.append(replace(reception, message=message))
                text += "; only what is near its confirmed claims is fused"
            rejected.append(Rejection(agent_id, "untrusted", text))
    return tuple(kept), tuple(rejected)


def weigh_message(frame: AgentFrame, message: Message, weight: float, claims: AssessedClaims | None) -> Message:
    """Return a message with weighted scores, without what is near its refuted claims.

    The score of an object is multiplied by the square root of the weight, in (0, 1]; the heat logit of a token is increased by the
    logarithm of the weight. A message of weight 1 without refuted claims is returned as it is.
    """
    is_refuted = None if claims is None else claims.kinds == Evidence.REFUTED
    if claims is not None and is_refuted is not None and is_refuted.any():
        message = _remove_near(frame, message, torch.from_numpy(claims.claims.xy[is_refuted]))
    if weight >= 1.0:
        return message
    objects, tokens = message.objects, message.tokens
    if objects is not None:
        objects = replace(objects, score=objects.score * math.sqrt(weight))
    if tokens is not None:
        features = tokens.features.clone()
        features[:, -PROPOSAL_DIM] += max(math.log(weight), MIN_LOG_WEIGHT)
        tokens = tokens.with_features(features)
    return replace(message, objects=objects, tokens=tokens)


def keep_confirmed(frame: AgentFrame, message: Message, claims: AssessedClaims) -> Message | None:
    """Return what a message states near its confirmed claims and near none that is refuted or disputed; None if it is nothing."""
    confirmed = torch.from_numpy(claims.claims.xy[claims.is_confirmed])
    is_denied = (claims.kinds == Evidence.REFUTED) | (claims.kinds == Evidence.DISPUTED)
    denied = torch.from_numpy(claims.claims.xy[is_denied])
    bare = replace(message, points=None, local_map=None, request=None, sight=None)
    kept = _keep(frame, bare, lambda xy: ~_is_far(xy, confirmed) & _is_far(xy, denied))
    num_kept = sum(len(part) for part in (kept.objects, None if kept.tokens is None else kept.tokens.sites) if part)
    return kept if num_kept else None


def _remove_near(frame: AgentFrame, message: Message, places: Tensor) -> Message:
    """Return a message without objects and tokens near places (K, 2) in the ego's frame at its time."""
    return _keep(frame, message, lambda xy: _is_far(xy, places))


def _keep(frame: AgentFrame, message: Message, choose: Callable[[Tensor], Tensor]) -> Message:
    """Return a message with some of its objects and tokens; choose: (N,) bool by places (N, 2) in the ego's frame at its time."""
    seconds, ego_from_other = age_s(frame, message), ego_from_sender(frame, message)
    objects, tokens, score = message.objects, message.tokens, message.token_score
    descriptors = message.descriptors
    if objects is not None:
        is_kept = choose(object_places(objects, seconds, ego_from_other))
        descriptors = None if descriptors is None else descriptors[is_kept]
        objects = objects[is_kept]
    if tokens is not None:
        is_kept = choose(token_places(tokens, seconds, ego_from_other))
        tokens, score = tokens.keep(is_kept), None if score is None else score[is_kept]
    return replace(message, objects=objects, tokens=tokens, token_score=score, descriptors=descriptors)


def object_places(objects: Boxes, seconds: float, ego_from_other: Transform) -> Tensor:
    """Return the centres (N, 2) of objects, in the ego's frame at its time."""
    return ego_from_other.apply(objects.after(seconds).center.double())[:, :2]


def token_places(tokens: SparseBev, seconds: float, ego_from_other: Transform) -> Tensor:
    """Return the centres (N, 2) that tokens propose, in the ego's frame at its time."""
    xy = proposed_centres(tokens) + proposed_velocity(tokens.features[:, -PROPOSAL_DIM:]) * seconds
    return ego_from_other.apply(torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double())[:, :2]


def _is_far(xy: Tensor, places: Tensor) -> Tensor:
    """Return (N,) bool: which of the points (N, 2) are near none of the places (K, 2)."""
    return (torch.cdist(xy, places) > REMOVAL_RADIUS_M).all(1)
