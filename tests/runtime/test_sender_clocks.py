# SPDX-License-Identifier: Apache-2.0
"""Offsets of senders' clocks: by arrivals, whose minimum bounds the offset, and by two-way queries."""

from __future__ import annotations

import pytest

from manyeyes.comms.inbox import Arrival
from manyeyes.datatypes import ConfigError
from manyeyes.runtime.sender_clocks import MAX_SENDERS, NUM_QUERIES, SenderClocks, SkewLimits, TwoWayClock

S, MS = 10**9, 10**6


def feed(
    clocks: SenderClocks, agent_id: int, offset_ns: int, begin_ns: int, num: int = 20, delay_ns: int = 40 * MS
) -> int:
    """Messages at 10 Hz of a sender whose clock is ahead by an offset; every second one takes longer. Returns the last arrival."""
    arrival_ns = begin_ns
    for k in range(num):
        captured_ns = begin_ns + k * S // 10
        arrival_ns = captured_ns + delay_ns + (k % 2) * 60 * MS
        clocks.record(Arrival(agent_id, captured_ns + offset_ns, arrival_ns))
    return arrival_ns


@pytest.mark.parametrize(
    ("offset_ms", "is_skewed"), [(0, False), (30, False), (-30, False), (150, True), (-150, False), (-300, True)]
)
def test_a_clock_beyond_the_limits_is_skewed(offset_ms: int, is_skewed: bool) -> None:
    """A clock that is behind looks like a delay: it is excluded where no usable link takes so long."""
    clocks = SenderClocks()
    now_ns = feed(clocks, 1, offset_ms * MS, 0)
    assert clocks.skewed(now_ns) == (frozenset({1}) if is_skewed else frozenset())
    assert clocks.min_delay_ns(1, now_ns) == (40 - offset_ms) * MS


def test_one_sender_does_not_touch_another_and_returns_within_two_seconds_of_its_repair() -> None:
    clocks = SenderClocks()
    feed(clocks, 1, 150 * MS, 0)
    now_ns = feed(clocks, 2, 0, 0)
    assert clocks.skewed(now_ns) == {1}
    now_ns = feed(clocks, 1, 0, 2 * S, num=18)
    assert now_ns < 4 * S and clocks.skewed(now_ns) == frozenset()


def test_a_sender_is_not_excluded_for_a_single_message_nor_for_the_same_one_again() -> None:
    clocks = SenderClocks()
    for _ in range(5):
        clocks.record(Arrival(1, 150 * MS, 0))
    assert clocks.skewed(0) == frozenset()
    assert clocks.min_delay_ns(2, 0) is None and clocks.min_delay_ns(1, 60 * S) is None


def test_what_is_kept_is_bounded_and_can_be_forgotten() -> None:
    clocks = SenderClocks()
    for agent_id in range(3 * MAX_SENDERS):
        feed(clocks, agent_id, 150 * MS, 0, num=3)
    assert len(clocks.skewed(300 * MS)) == MAX_SENDERS
    clocks.clear()
    assert clocks.skewed(300 * MS) == frozenset()
    with pytest.raises(ConfigError, match="above 0"):
        SkewLimits(window_ns=0)


def test_two_way_queries_measure_the_offset_within_half_a_round_trip() -> None:
    """there = here + 100 ms. Out 10 ms, back 30 ms: the asymmetry of 20 ms cannot be observed."""
    clock = TwoWayClock()
    assert clock.estimate() is None
    clock.add(0, 110 * MS, 111 * MS, 41 * MS)
    estimate = clock.estimate()
    assert estimate == (90 * MS, 20 * MS) and abs(estimate.offset_ns - 100 * MS) <= estimate.sigma_ns
    clock.add(1000 * MS, 1101 * MS, 1101 * MS, 1002 * MS)
    assert clock.estimate() == (100 * MS, 1 * MS)


def test_the_last_eight_queries_count_and_impossible_ones_do_not() -> None:
    clock = TwoWayClock()
    clock.add(0, 50, 40, 100)
    clock.add(100, 50, 300, 110)
    assert clock.estimate() is None
    clock.add(0, 5, 5, 10)
    for k in range(NUM_QUERIES):
        clock.add(1000 * k, 1000 * k + 50, 1000 * k + 50, 1000 * k + 100)
    assert clock.estimate() == (0, 50)
