# SPDX-License-Identifier: Apache-2.0
"""Shares of a channel: never exceeded, fair, nothing left over."""

import pytest
from hypothesis import given, strategies as st

from manyeyes.comms.bandwidth import allocate_equal_share, allocate_max_min_fair
from manyeyes.datatypes import ConfigError

wants = st.lists(st.integers(0, 5000), max_size=8)


def test_by_hand():
    """900 B for wants of 100, 500, 500: 100 are enough for one, the other 800 are halved."""
    assert allocate_max_min_fair(900, [500, 100, 500]) == (400, 100, 400)
    assert allocate_max_min_fair(10, [9, 9, 9]) == (4, 3, 3)
    assert allocate_max_min_fair(10_000, [500, 0, 100]) == (500, 0, 100)
    assert allocate_max_min_fair(7, []) == ()
    assert allocate_equal_share(1000, 3) == 333


@given(st.integers(0, 20_000), wants)
def test_the_total_is_used_and_never_exceeded(total, requested):
    shares = allocate_max_min_fair(total, requested)
    assert sum(shares) == min(total, sum(requested))
    assert all(0 <= s <= w for s, w in zip(shares, requested))


@given(st.integers(0, 20_000), wants)
def test_a_limited_sender_gets_the_largest_share(total, requested):
    shares = allocate_max_min_fair(total, requested)
    for share, want in zip(shares, requested):
        if share < want:
            assert share >= max(shares) - 1


@given(st.integers(0, 20_000), st.integers(0, 500), wants)
def test_a_larger_total_lowers_no_share_by_more_than_a_byte(total, more, requested):
    before, after = allocate_max_min_fair(total, requested), allocate_max_min_fair(total + more, requested)
    assert all(b >= a - 1 for a, b in zip(before, after))


@given(st.integers(0, 20_000), wants, st.randoms(use_true_random=False))
def test_the_order_of_senders_changes_a_byte_at_most(total, requested, random):
    order = list(range(len(requested)))
    random.shuffle(order)
    shares, shuffled = (
        allocate_max_min_fair(total, requested),
        allocate_max_min_fair(total, [requested[i] for i in order]),
    )
    assert all(abs(shares[i] - s) <= 1 for i, s in zip(order, shuffled))


@pytest.mark.parametrize(
    "call",
    [lambda: allocate_max_min_fair(-1, []), lambda: allocate_max_min_fair(5, [-1]), lambda: allocate_equal_share(5, 0)],
)
def test_invalid_values_are_rejected(call):
    with pytest.raises(ConfigError):
        call()
