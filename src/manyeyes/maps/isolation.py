# SPDX-License-Identifier: Apache-2.0
"""Find the items that make a computation over many items fail, so that it goes on with the rest.

Source: delta debugging by bisection (A. Zeller, "Yesterday, my program worked. Today, it does not. Why?", ESEC/FSE 1999), here
over prefixes: the item that ends the shortest failing prefix is left out, until all that remain succeed together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from manyeyes.datatypes import ManyeyesError
from manyeyes.maps.elements.observation import ObservationContent, shorten
from manyeyes.maps.elements.observation_file import RejectedRows

R = TypeVar("R")

CONTENT_ERRORS = (ArithmeticError, AssertionError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
"""What numbers of an observation can raise in a fusion; a full disk, a missing package or a lost worker is none of these."""
# A computation that fails with each of so many items alone, or still fails without so many, fails for another reason.
_MAX_LEADING_FAILURES = 4
_MAX_FAILURES = 32


@dataclass(frozen=True)
class IsolatedFailure:
    """An item that is left out: its row among all, and the error with it, on one line."""

    row: int
    reason: str


@dataclass(frozen=True)
class FailedObservation:
    """An observation with which the fusion fails, by id, and the error."""

    id: str
    reason: str


class FailedObservationsError(ManyeyesError):
    """Observations with which a fusion fails; failures: each of them, once."""

    def __init__(self, failures: Sequence[FailedObservation]) -> None:
        self.failures = tuple({failure.id: failure for failure in failures}.values())
        first = self.failures[0]
        super().__init__(
            f"{len(self.failures)} observations make the fusion fail; the first, {first.id}: {first.reason}"
        )


def isolate_failures(
    run: Callable[[Sequence[int]], R], count: int, max_failures: int = _MAX_FAILURES
) -> tuple[R, tuple[IsolatedFailure, ...]]:
    """Run on all rows 0 to count - 1; where that raises one of ``CONTENT_ERRORS``, on those that do not cause it.

    Each row to leave out costs about log2(count) runs.

    Args:
        run: called with rows in ascending order. max_failures: how many rows are left out at most, and never more than half.

    Returns:
        The result, and the rows that were left out, ascending.

    Raises:
        Exception: the first error, if leaving rows out does not help.
    """
    rows, failures = list(range(count)), list[IsolatedFailure]()
    result, first = _try(run, rows)
    error, num_good = first, 0
    while error is not None:
        low, high = num_good, len(rows)
        while high - low > 1:
            middle = (low + high) // 2
            _, found = _try(run, rows[:middle])
            low, high, error = (middle, high, error) if found is None else (low, middle, found)
        num_good = high - 1
        is_systematic = num_good == 0 and len(failures) >= _MAX_LEADING_FAILURES
        if first is not None and (is_systematic or len(failures) >= min(max_failures, count // 2)):
            raise first
        failures.append(IsolatedFailure(rows.pop(num_good), describe_error(error)))
        result, error = _try(run, rows)
    return result, tuple(sorted(failures, key=lambda failure: failure.row))  # pyright: ignore[reportReturnType]


def _try(run: Callable[[Sequence[int]], R], rows: list[int]) -> tuple[R | None, Exception | None]:
    """Return the result, or the content error."""
    try:
        return run(tuple(rows)), None
    except CONTENT_ERRORS as error:
        return None, error


def describe_error(error: BaseException) -> str:
    """Name an error of a fusion on one line."""
    return f"the fusion fails with it: {type(error).__name__}: {shorten(error) or 'no text'}."


def reject_failed(file: str, observation: ObservationContent, reason: str) -> RejectedRows:
    """Make the record of an observation with which the fusion fails."""
    o = observation
    where = f"observation {o.id} of agent {shorten(o.agent)} at {o.time_ns} ns"
    return RejectedRows(file, -1, 1, f"{where}: {reason} It is left out; report it with this line.")
