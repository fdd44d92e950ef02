# SPDX-License-Identifier: Apache-2.0
"""What an attack is given and what it returns: the honest message of a malicious agent before encoding, and what replaces it.

Attacks change messages, never packets, so that bytes, budgets and every check of a receiver apply to them as to honest messages.
Malicious agents hold valid keys. Three levels of knowledge: a black box uses the messages that it receives and its own sensors; a
grey box the weights too; a white box also the victim's frame, the messages of the same instant and the defence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import torch

from manyeyes.datatypes import AgentFrame, Boxes, Message, Transform
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.fusion.transform_tokens import Tokens

Knowledge = Literal["black-box", "grey-box", "white-box"]
Placement = Literal["seen", "blind", "ahead"]
"""Where a false object is put: where the victim sees road, where it sees nothing, or on the road 8 to 25 m ahead of it."""


@dataclass(frozen=True)
class AttackKey:
    """Key of the random draws of one malicious agent. group: equal for colluding agents, else the agent's id."""

    seed: int
    scenario: str
    group: int


GatherTokens = Callable[[Sequence[Message]], Tokens]
"""Transforms the tokens of messages to the frame of one agent, together with its own tokens; differentiable in the features."""


@dataclass(frozen=True, eq=False)
class Victim:
    """What a white box knows of the ego that it attacks, at the same instant.

    frame: levelled. own: its honest message. messages: those of the other honest agents. gather: of the ego. log_weight: logarithm
    of the weight that the defence gives the attacker's content, which fusion adds to the heat of its proposals; 0 without one.
    """

    frame: AgentFrame
    own: Message
    messages: tuple[Message, ...]
    gather: GatherTokens
    log_weight: float = 0.0


@dataclass(frozen=True, eq=False)
class AttackInput:
    """What a malicious agent has at one instant.

    frame: its own levelled frame. message: its honest message, tokens as floats before selection, with its sight where agents send
    sights. received: the newest messages of other agents as of the instant before. victim_pose: the pose that the ego states, world
    from ego. instant: number of instants since the attack began. gather: of the malicious agent itself. detector: the weights; None
    for a black box. victim: None but for a white box.
    """

    frame: AgentFrame
    message: Message
    received: tuple[Message, ...]
    victim_pose: Transform
    instant: int
    gather: GatherTokens | None = None
    detector: BoxDetector | None = None
    victim: Victim | None = None

    @property
    def seconds(self) -> float:
        """Time of the frame, seconds."""
        return self.frame.timestamp_ns / 1e9


@dataclass(frozen=True, eq=False)
class FalseClaims:
    """The false content of a message, world frame, float64, for evaluation alone. Invented objects keep their id.

    invented: objects that do not exist. hidden: objects that the agent detects and does not report.
    """

    invented: Boxes = field(default_factory=lambda: Boxes.empty(torch.float64))
    hidden: Boxes = field(default_factory=lambda: Boxes.empty(torch.float64))


@dataclass(frozen=True, eq=False)
class AttackOutput:
    """What is sent instead of the honest message; None sends nothing."""

    message: Message | None
    claims: FalseClaims = field(default_factory=FalseClaims)


AlterMessage = Callable[[AttackInput], AttackOutput]
"""One running attack of one malicious agent; it may hold state."""


class Attack(Protocol):
    """Frozen settings of an attack.

    knowledge: what it needs. num_pseudonyms: further identities under which one malicious agent sends.
    """

    @property
    def knowledge(self) -> Knowledge:
        """What the attack needs to know."""
        ...

    @property
    def num_pseudonyms(self) -> int:
        """Further identities of one malicious agent; 0 but for a Sybil attack."""
        return 0

    def begin(self, key: AttackKey) -> AlterMessage:
        """Return the attack of one malicious agent in one scenario."""
        ...


@dataclass(frozen=True, kw_only=True)
class AttackSettings:
    """Settings that every attack of the families has, as of ``Attack``."""

    num_pseudonyms: int = 0
    knowledge: Knowledge = "black-box"
