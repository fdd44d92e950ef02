# SPDX-License-Identifier: Apache-2.0
"""Copies: content that another agent sent before, stated under another identity.

Two agents never measure the same positions in their own frames to a centimetre. Of equal content the later one is the copy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.agents.trust._association_kernels import count_equal
from manyeyes.agents.trust.association import Floats
from manyeyes.agents.trust.claims import Claims

NUM_KEPT = 4
"""Number of messages of a sender whose content is kept."""


@dataclass(frozen=True)
class CopyConfig:
    """max_copied: fraction of claims at equal positions above which content is a copy. equal_m: of equal positions. min_equal: such
    claims. min_copies: of the last five messages of a sender that must be copies before it is named malicious.
    """

    max_copied: float = 0.6
    equal_m: float = 0.02
    min_equal: int = 3
    min_copies: int = 3


@dataclass(frozen=True)
class StatedContent:
    """Positions (N, 2) that a sender stated in its own frame in a message captured at a time."""

    timestamp_ns: int
    xy: Floats


Contents = Mapping[int, tuple[StatedContent, ...]]
"""Content of the last messages by agent id, the newest first."""


def find_copies(
    claims: Sequence[Claims], times_ns: Sequence[int], earlier: Contents, config: CopyConfig
) -> dict[int, int]:
    """Return the sources by the senders that copy them. times_ns: of capture of each sender's message.

    A message is compared with the messages of other senders from earlier frames. Senders that state equal content in the same frame
    for the first time are both left: nothing shows which of them copied.
    """
    contents = [(agent_id, content.xy) for agent_id, kept in earlier.items() for content in kept]
    if not contents:
        return {}
    places, sizes = np.concatenate([xy for _, xy in contents]), np.array([len(xy) for _, xy in contents])
    agents, found = np.array([agent_id for agent_id, _ in contents]), dict[int, int]()
    for one, time_ns in zip(claims, times_ns):
        xy = one.stated_xy
        if xy is None or len(xy) < config.min_equal or is_known(earlier.get(one.agent_id, ()), time_ns):
            continue
        equal = count_equal(xy, places, sizes, agents, one.agent_id, config.equal_m)
        is_copied = (equal >= config.min_equal) & (equal > config.max_copied * np.minimum(len(xy), sizes))
        if is_copied.any():
            found[one.agent_id] = int(agents[int(np.argmax(is_copied))])
    return found


def is_known(contents: Sequence[StatedContent], time_ns: int) -> bool:
    """Return whether a message was compared in an earlier frame."""
    return any(content.timestamp_ns == time_ns for content in contents)


def add_contents(earlier: tuple[StatedContent, ...], one: Claims, time_ns: int) -> tuple[StatedContent, ...]:
    """Return the contents of a sender with that of its message."""
    if one.stated_xy is None or is_known(earlier, time_ns):
        return earlier
    return (StatedContent(time_ns, one.stated_xy), *earlier)[:NUM_KEPT]
