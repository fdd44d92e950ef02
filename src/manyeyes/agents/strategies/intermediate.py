# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion: every agent sends tokens; the ego moves them into its frame and fuses them (CoSTr Eq. 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.strategies.message_header import age_s, ego_from_sender, header
from manyeyes.agents.strategies.redundancy import unsaid
from manyeyes.datatypes import AgentFrame, Boxes, Message, SparseBev
from manyeyes.models.detector.proposal import PROPOSAL, proposed_heat
from manyeyes.models.fusion.transform_tokens import Part, Tokens, gather
from manyeyes.ops.keyed_random import keyed_uniform


def learned(eyes: Eyes, frame: AgentFrame) -> Tensor:
    """What the trained mask says (CoSTr section III-E)."""
    with torch.inference_mode():
        return torch.sigmoid(eyes.detector.choose(eyes.see(frame).stated))


def confidence(eyes: Eyes, frame: AgentFrame) -> Tensor:
    """How sure the sender is that the token is the middle of an object: the rule of Where2comm, on tokens."""
    return torch.sigmoid(proposed_heat(eyes.see(frame).told.features[:, -PROPOSAL:]))


def at_random(eyes: Eyes, frame: AgentFrame) -> Tensor:
    """A uniform draw for every token, keyed by sender and time."""
    return keyed_uniform((len(eyes.see(frame).told.sites),), 0, "selection", frame.agent_id, frame.timestamp_ns).float()


@dataclass(frozen=True)
class Intermediate:
    """Tokens of the weights that the ego carries itself; the inbox refuses others. score: which of them a budget keeps first."""

    name: str = "intermediate"
    score: Callable[[Eyes, AgentFrame], Tensor] = unsaid
    remembers: bool = True

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """The tokens that pruning kept with what the agent makes of them, and their worth, by which a budget chooses."""
        told = eyes.see(frame).told
        return replace(header(frame, eyes.detector.fingerprint), tokens=told, token_score=self.score(eyes, frame))

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the fused tokens, with the agent's own last two instants to look back at."""
        return eyes.decode(eyes.fuse(*tokens_around(frame, eyes.see(frame).told, eyes.past(frame), messages)))


def tokens_around(
    frame: AgentFrame, own: SparseBev, past: Sequence[Part], messages: Sequence[Message]
) -> tuple[Tokens, Tokens | None]:
    """The ego's own tokens, of now and of its past, and those of every message on the same lattice; and its own past alone.

    What was seen or said a moment ago stands beside what is seen now, where its object should be by now, and weighs what its age
    leaves of its trust (``models.fusion.token_merge``).
    """
    there = [(m, m.tokens) for m in messages if m.tokens is not None and m.tokens.grid == own.grid]
    heard = [_part(frame, message, tokens.features, tokens.sites.xy) for message, tokens in there]
    tokens = gather([Part(0, own.features, own.sites.xy), *heard, *past], own.grid, 1)
    return tokens, gather(past, own.grid, 1) if past else None


def _part(frame: AgentFrame, message: Message, told: Tensor, xy: Tensor) -> Part:
    """Both claims may be wrong: their variances add up."""
    doubt = (frame.pose_covariance + message.pose_covariance).diagonal()
    across = float((doubt[:2].mean()).clamp_min(0).sqrt())
    turn = float(doubt[2].clamp_min(0).sqrt())
    return Part(0, told, xy, ego_from_sender(frame, message), age_s(frame, message), across, turn)
