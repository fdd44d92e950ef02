# SPDX-License-Identifier: Apache-2.0
"""Isolation of failing senders: minimal sets, bounded attempts, bounded quarantine."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import pytest

from manyeyes.agents.isolation import (
    FIRST_QUARANTINE_NS,
    MAX_QUARANTINE_NS,
    MAX_QUARANTINED,
    Quarantine,
    isolate_failing,
)


class Fusion:
    """A fusion that fails if it has one of the bad senders, or both senders of a bad pair; it counts its calls."""

    def __init__(self, bad: Collection[int] = (), pairs: Collection[tuple[int, int]] = ()) -> None:
        self.bad, self.pairs, self.calls = set(bad), list(pairs), 0

    def __call__(self, senders: Sequence[int]) -> tuple[int, ...]:
        self.calls += 1
        if self.bad & set(senders) or any({*pair} <= set(senders) for pair in self.pairs):
            raise ValueError("cannot be fused")
        return tuple(senders)


ERROR = ValueError("together")


@pytest.mark.parametrize("bad", range(8))
def test_one_failing_sender_of_eight_is_found_in_six_attempts(bad: int) -> None:
    fusion = Fusion({bad})
    found = isolate_failing(fusion, range(8), ERROR)
    assert found.result == tuple(n for n in range(8) if n != bad)
    assert set(found.errors) == {bad} and fusion.calls <= 6 and not found.untested


def test_of_a_pair_that_cannot_be_fused_together_only_the_second_is_excluded() -> None:
    """All senders were excluded."""
    found = isolate_failing(Fusion(pairs=[(1, 6)]), range(8), ERROR)
    assert found.result == (0, 1, 2, 3, 4, 5, 7) and set(found.errors) == {6}
    assert isolate_failing(Fusion(pairs=[(1, 6)]), [6, 1, 2], ERROR).result == (6, 2)


def test_several_failing_senders_are_excluded_and_no_other_one() -> None:
    found = isolate_failing(Fusion({0, 5}, [(2, 3)]), range(8), ERROR, max_attempts=32)
    assert found.result == (1, 2, 4, 6, 7) and set(found.errors) == {0, 3, 5}


def test_a_single_sender_is_excluded_without_another_attempt_on_it() -> None:
    fusion = Fusion({4})
    found = isolate_failing(fusion, [4], ERROR)
    assert found.result == () and found.errors == {4: ERROR} and fusion.calls == 1


def test_the_number_of_attempts_is_bounded() -> None:
    fusion = Fusion(range(1, 64, 2))
    found = isolate_failing(fusion, range(64), ERROR, max_attempts=16)
    assert fusion.calls <= 17 and found.untested
    assert sorted([*found.result, *found.errors]) == list(range(64))
    assert not fusion.bad & set(found.result) and found.untested <= found.errors.keys()


def test_a_fusion_that_fails_without_senders_raises() -> None:
    def broken(senders: Sequence[int]) -> None:
        raise RuntimeError("a defect")

    with pytest.raises(RuntimeError, match="a defect"):
        isolate_failing(broken, range(4), ERROR)


def test_the_quarantine_doubles_up_to_five_minutes() -> None:
    quarantine, now_ns, lengths = Quarantine(), 0, []
    for _ in range(8):
        quarantine = quarantine.add(7, now_ns)
        end_ns = now_ns
        while quarantine.contains(7, end_ns):
            end_ns += FIRST_QUARANTINE_NS
        lengths.append((end_ns - now_ns) // FIRST_QUARANTINE_NS - 1)
        now_ns = end_ns
    assert lengths == [1, 2, 4, 8, 16, 30, 30, 30]
    assert not quarantine.contains(8, 0)
    assert not Quarantine().add(7, 0).contains(7, -1)


def test_an_old_quarantine_is_forgotten() -> None:
    quarantine = Quarantine().add(7, 0).add(7, 0)
    later = FIRST_QUARANTINE_NS * 2 + MAX_QUARANTINE_NS + 1
    assert not quarantine.add(7, later).contains(7, later + FIRST_QUARANTINE_NS + 1)


def test_the_quarantine_is_bounded() -> None:
    quarantine = Quarantine()
    for agent_id in range(1000):
        quarantine = quarantine.add(agent_id, agent_id)
    held = [agent_id for agent_id in range(1000) if quarantine.contains(agent_id, 1000)]
    assert held == list(range(1000 - MAX_QUARANTINED, 1000))
