# SPDX-License-Identifier: Apache-2.0
"""Claims: the objects that a message states, sent as boxes or proposed by its tokens, in the ego's frame at its time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.agents.trust._claim_kernels import place_claims, place_proposals
from manyeyes.agents.trust.association import Floats
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.models.detector.box_head import DecodeConfig, make_decode_arguments
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.protocols import has_tokens

SIGMA_VELOCITY_MPS = 1.0
"""Standard deviation of an object's velocity."""
MIN_SCORE = 0.3
"""Minimum score of a claim: boxes below are mostly errors of an honest detector."""
MAX_CLAIMS = 256
"""Number of claims of a message that are assessed, by falling score: all that ``comms`` admits as objects."""


@dataclass(frozen=True)
class Claims:
    """N objects that one sender claims, by falling score, in the ego's frame at its time; arrays are float64.

    columns: (N, 7) centre, size (metres) and yaw; velocity: (N, 2) m/s; score: (N,). sigma_m: (N,) metres, of the centres: of both
    poses, of the object, and of its motion since the message. sender_xy: of the sender. is_complete: the message states all
    objects that its sender detects, so that a missing one means something; tokens within a budget do not. stated_xy: (N, 2) centres
    as stated, in the sender's frame at the time of its message; None where unknown.
    """

    agent_id: int
    columns: Floats
    velocity: Floats
    score: Floats
    sigma_m: Floats
    sender_xy: tuple[float, float] = (0.0, 0.0)
    age_s: float = 0.0
    is_complete: bool = False
    stated_xy: Floats | None = None

    @classmethod
    def of(cls, agent_id: int, boxes: Boxes, sigma_m: Floats) -> Claims:
        """Return claims of boxes in the ego's frame."""
        columns = torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1).double().numpy()
        return cls(agent_id, columns, boxes.velocity.double().numpy(), boxes.score.double().numpy(), sigma_m)

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Claims:
        names = ("columns", "velocity", "score", "sigma_m")
        stated = None if self.stated_xy is None else self.stated_xy[rows]
        return replace(self, stated_xy=stated, **{name: getattr(self, name)[rows] for name in names})

    @property
    def xy(self) -> Floats:
        """Centres of the claims (N, 2), metres."""
        return self.columns[:, :2]

    @property
    def boxes(self) -> Boxes:
        """The claims as boxes, float64."""
        center, size, yaw = np.split(self.columns, (3, 6), axis=1)
        return Boxes.of(center, size, yaw[:, 0], self.score, velocity=self.velocity)


def extract_claims(frame: AgentFrame, cache: PerceptionCache, messages: Sequence[Message]) -> tuple[Claims, ...]:
    """Return the claims of each message of MIN_SCORE. Clouds claim nothing: a detector would have to run on each."""
    detector = cache.detector
    config = _lower_threshold(detector.decode_config) if has_tokens(detector) else None
    return tuple(_extract(frame, config, message) for message in messages)


@lru_cache(maxsize=8)
def _lower_threshold(config: DecodeConfig) -> DecodeConfig:
    """Return the configuration with a threshold of MIN_SCORE."""
    return replace(config, score_threshold=MIN_SCORE)


def _extract(frame: AgentFrame, config: DecodeConfig | None, message: Message) -> Claims:
    here, there, seconds = frame.world_from_agent, message.world_from_agent, age_s(frame, message)
    from_world = here.rotation.numpy().T
    rotation = np.ascontiguousarray(from_world @ there.rotation.numpy())
    origin = from_world @ (there.translation.numpy() - here.translation.numpy())
    covariance = frame.pose_covariance.numpy() + message.pose_covariance.numpy()
    x, y, yaw = (max(float(covariance[k, k]), 0.0) for k in range(3))
    variances = (x + y) / 2 + (SIGMA_VELOCITY_MPS * seconds) ** 2, yaw
    numbers, tokens = np.array([seconds, *variances, MIN_SCORE]), message.tokens
    if message.objects is None and tokens is not None and config and tokens.features.shape[1] >= PROPOSAL_DIM:
        proposals = make_decode_arguments(tokens.features[:, -PROPOSAL_DIM:], tokens.sites, config)
        placed = place_proposals(*proposals, rotation, origin, numbers, MAX_CLAIMS)
    else:
        boxes = Boxes.empty() if message.objects is None else message.objects
        parts = (boxes.center, boxes.size, boxes.yaw, boxes.velocity, boxes.score, boxes.sigma_xy)
        center, size, yaw, motion, scores, sigma = (column.double().contiguous().numpy() for column in parts)
        placed = place_claims(center, size, yaw, motion, scores, sigma, rotation, origin, numbers, MAX_CLAIMS)
    columns, velocity, score, sigma_m, stated_xy = placed
    return Claims(
        message.agent_id,
        columns,
        velocity,
        score,
        sigma_m,
        (float(origin[0]), float(origin[1])),
        seconds,
        message.objects is not None and message.tokens is None,
        stated_xy,
    )
