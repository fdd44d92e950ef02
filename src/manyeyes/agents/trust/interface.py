# SPDX-License-Identifier: Apache-2.0
"""What a misbehaviour detector receives and returns: claims of senders, evidence on each claim, trust and weight of each sender."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum, IntEnum
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.agents.trust.claims import Claims
from manyeyes.datatypes import AgentFrame, Boxes, Message


class Evidence(IntEnum):
    """Evidence on a claimed object.

    UNCHECKED: neither the ego nor a trusted third agent observes its place. SUPPORTED: the ego detects it, or has returns of it.
    CORROBORATED: a trusted third agent claims it too. DISPUTED: two agents, or two instants, contradict each other; it changes no
    trust. REFUTED: rays of the ego, or of several trusted agents, pass through it. OWN: of a result, a detection of the ego itself.
    """

    UNCHECKED = 0
    SUPPORTED = 1
    CORROBORATED = 2
    DISPUTED = 3
    REFUTED = 4
    OWN = 5


# Members of an enumeration are slow to read.
_SUPPORTED, _CORROBORATED = int(Evidence.SUPPORTED), int(Evidence.CORROBORATED)


class SenderStatus(Enum):
    """NORMAL; MALICIOUS: named, for the whole term of its exclusion; FAULTY: its poses are off, which is no attack."""

    NORMAL = "normal"
    MALICIOUS = "malicious"
    FAULTY = "faulty"


@dataclass(frozen=True)
class SenderAssessment:
    """Assessment of one sender. trust: in [0, 1]. weight: of its content in fusion, in [0, 1]; 0 excludes it. reason: of a
    status that is not normal, or of an exclusion. keeps_confirmed: of an excluded sender, what it states at claims that the ego or
    a trusted third agent confirms is fused nevertheless.
    """

    agent_id: int
    trust: float
    weight: float = 1.0
    status: SenderStatus = SenderStatus.NORMAL
    reason: str = ""
    keeps_confirmed: bool = False


@dataclass(frozen=True)
class AssessedClaims:
    """Claims of one sender, in the ego's levelled frame at its time, and the Evidence (N,) uint8 on each.

    is_detected: (N,) bool, which of the supported ones the ego detects itself: returns alone may be of a wall. None: all of them.
    """

    claims: Claims
    kinds: NDArray[np.uint8]
    is_detected: NDArray[np.bool_] | None = None

    @property
    def agent_id(self) -> int:
        """Id of the sender of the claims."""
        return self.claims.agent_id

    @property
    def boxes(self) -> Boxes:
        """The claimed boxes (N)."""
        return self.claims.boxes

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """Which claims (N,) a detection of the ego or a trusted third agent confirms."""
        is_supported = self.kinds == _SUPPORTED
        if self.is_detected is not None:
            is_supported &= self.is_detected
        return is_supported | (self.kinds == _CORROBORATED)

    @property
    def evidence(self) -> Tensor:
        """The Evidence (N,) uint8 on each box."""
        return torch.from_numpy(self.kinds)


@dataclass(frozen=True)
class Assessment:
    """Result for one frame: of every sender of a message. claims: None of methods that do not assess each claim. state: for the
    next frame.
    """

    senders: tuple[SenderAssessment, ...]
    claims: tuple[AssessedClaims, ...] | None = None
    state: object | None = None

    @cached_property
    def weights(self) -> dict[int, float]:
        """Weights by agent id."""
        return {sender.agent_id: sender.weight for sender in self.senders}


@dataclass(frozen=True)
class MisbehaviourInput:
    """One frame of the ego, before fusion.

    frame: levelled. own: the ego's detections of this frame, by falling score. messages: one a sender, by agent id, with decoded
    tokens and corrected poses. make_claims: extracts the claims of the messages. fuse: boxes of the ego's frame fused with the
    messages of some senders, in the ego's frame; it costs a fusion, and changes no state. faulty: senders whose poses are off.
    """

    frame: AgentFrame
    own: Boxes
    messages: tuple[Message, ...]
    make_claims: Callable[[], tuple[Claims, ...]]
    fuse: Callable[[Collection[int]], Boxes]
    faulty: frozenset[int] = frozenset()

    @property
    def agent_ids(self) -> tuple[int, ...]:
        """Senders of the messages."""
        return tuple(message.agent_id for message in self.messages)

    @cached_property
    def claims(self) -> tuple[Claims, ...]:
        """Claims of each message, in its order."""
        return self.make_claims()


class MisbehaviourDetector(Protocol):
    """A method that finds senders whose content is wrong; a class may derive from it, which gives the defaults.

    It holds settings only and can be shared by agents: what it remembers is the state, which each agent stores if its perception
    succeeds. All methods are deterministic.
    """

    def excluded(self, state: object | None, agent_ids: Collection[int], now_ns: int) -> frozenset[int]:
        """Return senders whose poses are not corrected and take no part in the correction of others. None by default."""
        return frozenset()

    def assess(self, received: MisbehaviourInput, state: object | None) -> Assessment:
        """Assess the senders of one frame before its fusion. state: of the last frame; None at first."""
        ...

    def record_orphans(self, state: object | None, agent_ids: Collection[int]) -> object | None:
        """Return the state after a fusion. agent_ids: senders of tokens near several fused boxes without a proposal
        (``agents.trust.orphans``). The same state by default.
        """
        return state
