# SPDX-License-Identifier: Apache-2.0
"""Bandwidth allocation: bytes of one instant, divided among all senders of a channel.

Senders get equal shares; unused bytes go to the others (max-min fairness; Bertsekas and Gallager, "Data Networks", section 6.5.2).
The rule needs the requested bytes of each sender. A roadside unit or a base station that schedules the channel knows them, and so
does the replay of a recording. Senders without a scheduler know only the number of recent senders: they use
:func:`allocate_equal_share`, which never exceeds the total if all senders receive each other.
"""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.datatypes import ConfigError


def allocate_max_min_fair(total_bytes: int, requested_bytes: Sequence[int]) -> tuple[int, ...]:
    """Return bytes that each sender may send, in the order of requested_bytes (0: sends nothing).

    They sum to total_bytes, or to all requested bytes if these are fewer. No sender gets more than it requests, and a sender with
    less than it requests gets, within a byte, the maximum share. Indivisible bytes go to the first senders.
    """
    if total_bytes < 0 or any(w < 0 for w in requested_bytes):
        raise ConfigError(f"Budgets and requests are 0 bytes or more; got {total_bytes} for {list(requested_bytes)}.")
    shares, left = [0] * len(requested_bytes), total_bytes
    # Ascending requests: unused bytes are divided among the rest. Equal requests in reverse order, so that indivisible bytes are
    # left to the first.
    order = sorted(range(len(requested_bytes)), key=lambda i: (requested_bytes[i], -i))
    for place, sender in enumerate(order):
        shares[sender] = min(requested_bytes[sender], left // (len(order) - place))
        left -= shares[sender]
    return tuple(shares)


def allocate_equal_share(total_bytes: int, num_senders: int) -> int:
    """Return bytes for each of num_senders, without knowledge of their requests."""
    if total_bytes < 0 or num_senders < 1:
        raise ConfigError(
            f"An equal share is of 0 bytes or more, for one sender or more; got {total_bytes}, {num_senders}."
        )
    return total_bytes // num_senders
