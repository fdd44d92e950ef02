# SPDX-License-Identifier: Apache-2.0
"""Bytes of one instant, shared out among all senders of a channel so that together they never exceed it.

Equal shares of those who speak; what one does not need goes to the others (max-min fairness; Bertsekas and Gallager, "Data
Networks", section 6.5.2). The rule needs what each sender would say. Who knows that: a roadside unit or a base station that
schedules the channel, if each announces its want; the replay of a recording, which sees all messages of an instant before any
is cut. Senders that only hear each other know who spoke lately and not what each will want: for them, :func:`allocate_equal_share`
of the bytes among those heard, which is never exceeded where everybody hears everybody.
"""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.datatypes import ConfigError


def allocate_max_min_fair(total_bytes: int, requested_bytes: Sequence[int]) -> tuple[int, ...]:
    """Bytes that each sender may send, in the order of what each wants (0: it does not speak).

    They sum to total_bytes, or to all that is wanted where that is less; nobody gets more than it wants, and who gets less
    gets, within a byte, as much as anybody. A byte that does not divide goes to the first in order.
    """
    if total_bytes < 0 or any(w < 0 for w in requested_bytes):
        raise ConfigError(f"Budgets and wants are 0 bytes or more; got {total_bytes} for {list(requested_bytes)}.")
    shares, left = [0] * len(requested_bytes), total_bytes
    # The most modest first: what it leaves is shared among the rest. Among equals the last first, so that what does not
    # divide is left to the first.
    order = sorted(range(len(requested_bytes)), key=lambda i: (requested_bytes[i], -i))
    for place, sender in enumerate(order):
        shares[sender] = min(requested_bytes[sender], left // (len(order) - place))
        left -= shares[sender]
    return tuple(shares)


def allocate_equal_share(total_bytes: int, num_senders: int) -> int:
    """Bytes for each of so many speakers that know no more of each other than that they are there."""
    if total_bytes < 0 or num_senders < 1:
        raise ConfigError(
            f"An equal share is of 0 bytes or more, for one speaker or more; got {total_bytes}, {num_senders}."
        )
    return total_bytes // num_senders
