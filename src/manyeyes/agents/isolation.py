# SPDX-License-Identifier: Apache-2.0
"""Isolation of senders whose content makes fusion fail: a maximal set that can be fused, and quarantine of the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from manyeyes.comms.inbox import Rejection

Result = TypeVar("Result")

FIRST_QUARANTINE_NS, MAX_QUARANTINE_NS = 10_000_000_000, 300_000_000_000
"""A failing sender is excluded for 10 s at first, and twice as long each further time, up to 300 s."""
MAX_QUARANTINED = 64


@dataclass(frozen=True)
class Isolated(Generic[Result]):
    """The result of the senders that can be fused together, and the error of each of the others.

    untested: senders that were left out because max_attempts were used up.
    """

    result: Result
    errors: Mapping[int, Exception]
    untested: frozenset[int] = frozenset()


def isolate_failing(
    attempt: Callable[[Sequence[int]], Result], senders: Sequence[int], error: Exception, max_attempts: int = 16
) -> Isolated[Result]:
    """Fuse as many senders as can be fused together, in order of preference.

    Groups of senders are added to the set of fused senders; a group that fails is bisected. One failing sender of n costs at most
    2 log2(n) attempts. Each excluded sender fails together with those before it, so none is excluded needlessly.

    Args:
        attempt: fuse the content of some senders, without side effects; called with a subsequence of senders.
        senders: by preference; all of them together failed with the error.
        max_attempts: the number of fusions; senders that are undecided after it are excluded.

    Raises:
        Exception: fusion fails without any sender.
    """
    kept: list[int] = []
    errors: dict[int, Exception] = {}
    found: list[Result] = []
    pending, used = _split(senders), 0
    untested: list[int] = []
    while pending:
        group = pending.pop()
        if used == max_attempts:
            untested += group
            continue
        # A single sender has failed already, alone, with the error.
        if len(group) == len(senders):
            errors[group[0]] = error
            continue
        used += 1
        try:
            found = [attempt([*kept, *group])]
            kept += group
        except Exception as group_error:
            if len(group) == 1:
                errors[group[0]] = group_error
            else:
                pending += _split(group)
    result = found[0] if found else attempt([])
    return Isolated(result, errors | dict.fromkeys(untested, error), frozenset(untested))


def content_error(agent_id: int, error: Exception) -> Rejection:
    """Return the rejection of a sender whose content made fusion fail."""
    text = " ".join(f"fusing its content failed: {type(error).__name__}: {error}".split())
    return Rejection(agent_id, "content_error", text, error)


def _split(group: Sequence[int]) -> list[Sequence[int]]:
    """Return the halves of a group, the first one last; a single sender as it is."""
    middle = len(group) // 2
    return [part for part in (group[middle:], group[:middle]) if part]


@dataclass(frozen=True)
class _Term:
    """until_ns: end of the exclusion. duration_ns: its length."""

    until_ns: int
    duration_ns: int


@dataclass(frozen=True)
class Quarantine:
    """Excluded senders, at most MAX_QUARANTINED. Times are those of the receiver's clock."""

    _terms: Mapping[int, _Term] = field(default_factory=dict[int, _Term])

    def contains(self, agent_id: int, now_ns: int) -> bool:
        """Return whether a sender is excluded at a time."""
        term = self._terms.get(agent_id)
        # A clock that was set back does not prolong an exclusion.
        return term is not None and 0 <= term.until_ns - now_ns <= term.duration_ns

    def add(self, agent_id: int, now_ns: int) -> Quarantine:
        """Return the quarantine with one more sender; beyond the limit the one that ends first is released."""
        term = self._terms.get(agent_id)
        known = term is not None and abs(now_ns - term.until_ns) <= MAX_QUARANTINE_NS
        duration = min(2 * term.duration_ns, MAX_QUARANTINE_NS) if known and term else FIRST_QUARANTINE_NS
        terms = {**self._terms, agent_id: _Term(now_ns + duration, duration)}
        if len(terms) > MAX_QUARANTINED:
            del terms[min(terms, key=lambda sender: (terms[sender].until_ns, sender))]
        return Quarantine(terms)
