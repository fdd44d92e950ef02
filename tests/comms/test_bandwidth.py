# SPDX-License-Identifier: Apache-2.0
"""Shares of a channel: never exceeded, fair, nothing left over."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manyeyes.comms.bandwidth import equal_share, fair_shares
from manyeyes.datatypes import ConfigError

QUICK = settings(max_examples=200, derandomize=True, deadline=None)
wants = st.lists(st.integers(0, 5000), max_size=8)


def test_by_hand():
    """900 B for wants of 100, 500, 500: 100 are enough for one, the other 800 are halved."""
    assert fair_shares(900, [500, 100, 500]) == (400, 100, 400)
    assert fair_shares(10, [9, 9, 9]) == (4, 3, 3)
    assert fair_shares(10_000, [500, 0, 100]) == (500, 0, 100)
    assert fair_shares(7, []) == ()
    assert equal_share(1000, 3) == 333


@QUICK
@given(st.integers(0, 20_000), wants)
def test_the_total_is_used_and_never_exceeded(total, wanted):
    shares = fair_shares(total, wanted)
    assert sum(shares) == min(total, sum(wanted))
    assert all(0 <= s <= w for s, w in zip(shares, wanted))


@QUICK
@given(st.integers(0, 20_000), wants)
def test_who_gets_less_than_it_wants_gets_as_much_as_anybody(total, wanted):
    shares = fair_shares(total, wanted)
    for share, want in zip(shares, wanted):
        if share < want:
            assert share >= max(shares) - 1


@QUICK
@given(st.integers(0, 20_000), st.integers(0, 500), wants)
def test_more_bytes_take_none_from_anybody_but_the_odd_one(total, more, wanted):
    before, after = fair_shares(total, wanted), fair_shares(total + more, wanted)
    assert all(b >= a - 1 for a, b in zip(before, after))


@QUICK
@given(st.integers(0, 20_000), wants, st.randoms(use_true_random=False))
def test_the_order_of_senders_changes_a_byte_at_most(total, wanted, random):
    order = list(range(len(wanted)))
    random.shuffle(order)
    shares, shuffled = fair_shares(total, wanted), fair_shares(total, [wanted[i] for i in order])
    assert all(abs(shares[i] - s) <= 1 for i, s in zip(order, shuffled))


@pytest.mark.parametrize("call", [lambda: fair_shares(-1, []), lambda: fair_shares(5, [-1]), lambda: equal_share(5, 0)])
def test_what_cannot_be_is_refused(call):
    with pytest.raises(ConfigError):
        call()
