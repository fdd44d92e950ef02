# SPDX-License-Identifier: Apache-2.0
"""Claims: the objects that a message states, sent as boxes or proposed by its tokens, in the ego's frame at its time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.pose_correction import extract_message_boxes
from manyeyes.agents.strategies.message_header import age_s, ego_from_sender
from manyeyes.datatypes import AgentFrame, Boxes, Message

SIGMA_VELOCITY_MPS = 1.0
"""Standard deviation of an object's velocity."""
MAX_CLAIMS = 256
"""Number of claims of a message that are assessed, by falling score: all that ``comms`` admits as objects."""


@dataclass(frozen=True)
class Claims:
    """Objects that one sender claims.

    boxes: (N,) by falling score, in the ego's frame at its time. sigma_m: (N,) metres, of their centres: of both poses, of the
    object, and of its motion since the message. sender_xy: (2,) metres, of the sender in the ego's frame. is_complete: the message
    states all objects that its sender detects, so that a missing one means something; tokens within a budget do not.
    """

    agent_id: int
    boxes: Boxes
    sigma_m: Tensor
    sender_xy: tuple[float, float]
    age_s: float = 0.0
    is_complete: bool = False

    def __len__(self) -> int:
        return len(self.boxes)


def extract_claims(frame: AgentFrame, cache: PerceptionCache, messages: Sequence[Message]) -> tuple[Claims, ...]:
    """Return the claims of each message. Clouds claim nothing: a detector would have to run on each."""
    return tuple(_extract(frame, cache, message) for message in messages)


def _extract(frame: AgentFrame, cache: PerceptionCache, message: Message) -> Claims:
    ego_from_other, seconds = ego_from_sender(frame, message), age_s(frame, message)
    has_claims = message.objects is not None or message.tokens is not None
    stated = extract_message_boxes(cache, message) if has_claims else Boxes.empty()
    there = stated[stated.score.argsort(descending=True, stable=True)[:MAX_CLAIMS]].to(torch.float64)
    boxes = there.after(seconds).transform(ego_from_other)
    x, y, yaw = (frame.pose_covariance + message.pose_covariance).double().diagonal().clamp_min(0).tolist()
    lever = there.center[:, :2].square().sum(1)
    variance = (x + y) / 2 + yaw * lever + there.sigma_xy.square() + (SIGMA_VELOCITY_MPS * seconds) ** 2
    origin = ego_from_other.translation.tolist()
    return Claims(
        message.agent_id,
        boxes,
        variance.sqrt(),
        (origin[0], origin[1]),
        seconds,
        message.objects is not None and message.tokens is None and math.isfinite(x + y + yaw),
    )
