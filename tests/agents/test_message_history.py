# SPDX-License-Identifier: Apache-2.0
"""Message history: the last few messages of each sender, newest first, without old ones."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.message_history import MAX_AGE_NS, MessageHistory
from manyeyes.agents.perception_cache import HISTORY_FRAMES
from manyeyes.datatypes import Message, Transform

TENTH_NS = 100_000_000


def message_of(at: int, agent: int = 1) -> Message:
    """A message of that tenth of a second."""
    return Message(agent, at * TENTH_NS, Transform.identity(), torch.zeros(3, 3).double())


def update(
    memory: MessageHistory, *messages: Message, at: int | None = None, untrusted: tuple[int, ...] = ()
) -> list[Message]:
    """The history at a tenth of a second; None: that of the newest message."""
    now = max(m.timestamp_ns for m in messages) if at is None else at * TENTH_NS
    return memory.update_and_get(messages, now, untrusted)


def times(messages: list[Message]) -> list[tuple[int, int]]:
    return [(message.agent_id, message.timestamp_ns // TENTH_NS) for message in messages]


def test_earlier_messages_follow_the_newest_up_to_the_history_length():
    memory = MessageHistory()
    found = [times(update(memory, message_of(at))) for at in range(HISTORY_FRAMES + 2)]
    assert HISTORY_FRAMES == 2 and found == [
        [(1, 0)],
        [(1, 1), (1, 0)],
        [(1, 2), (1, 1), (1, 0)],
        [(1, 3), (1, 2), (1, 1)],
    ]


def test_each_sender_has_its_own_history():
    memory = MessageHistory()
    update(memory, message_of(0, 1), message_of(0, 2))
    assert times(update(memory, message_of(1, 2), message_of(2, 1))) == [(2, 1), (2, 0), (1, 2), (1, 0)]


def test_a_message_received_again_with_more_packets_replaces_itself():
    memory = MessageHistory()
    update(memory, message_of(0))
    update(memory, message_of(1))
    again = message_of(1)
    found = update(memory, again)
    assert times(found) == [(1, 1), (1, 0)] and found[0] is again


def test_a_repeated_message_changes_nothing():
    memory = MessageHistory()
    update(memory, message_of(0))
    now = message_of(1)
    assert times(update(memory, now)) == times(update(memory, now)) == [(1, 1), (1, 0)]


def test_messages_older_than_half_a_second_are_dropped():
    apart = MAX_AGE_NS // TENTH_NS
    for gap, length in ((apart, 2), (apart + 1, 1)):
        memory = MessageHistory()
        update(memory, message_of(0))
        assert len(update(memory, message_of(gap))) == length


def test_a_decreasing_time_resets_the_history():
    memory = MessageHistory()
    update(memory, message_of(50))
    update(memory, message_of(51))
    assert times(update(memory, message_of(49))) == [(1, 49)]
    assert times(update(memory, message_of(50))) == [(1, 50), (1, 49)]


def test_absent_senders_are_dropped_although_a_delayed_message_arrives():
    memory = MessageHistory()
    update(memory, *(message_of(0, agent) for agent in range(100)))
    assert times(update(memory, message_of(9, 7), message_of(2, 8))) == [(7, 9), (8, 2), (8, 0)]
    assert times(update(memory, message_of(13, 7))) == [(7, 13), (7, 9)]
    assert memory.senders == {7}


def test_messages_of_an_absent_sender_are_kept_for_half_a_second():
    """Its packets were lost, or its pose was uncertain."""
    memory = MessageHistory()
    for at in (0, 1, 2):
        update(memory, message_of(at, 1), message_of(at, 2))
    assert times(update(memory, message_of(3, 2))) == [(2, 3), (2, 2), (2, 1), (1, 2), (1, 1)]
    assert times(update(memory, at=4)) == [(1, 2), (1, 1), (2, 3), (2, 2)]
    assert times(update(memory, at=7)) == [(1, 2), (2, 3), (2, 2)]
    assert times(update(memory, at=8)) == [(2, 3)] and update(memory, at=9) == []


def test_delayed_messages_of_an_absent_sender_are_kept_for_half_a_second():
    memory = MessageHistory()
    update(memory, message_of(0, 1), message_of(0, 2), at=4)
    assert times(update(memory, message_of(1, 2), at=5)) == [(2, 1), (2, 0), (1, 0)]
    assert times(update(memory, message_of(2, 2), at=6)) == [(2, 2), (2, 1), (2, 0)]


def test_untrusted_senders_are_dropped():
    memory = MessageHistory()
    update(memory, message_of(0, 1), message_of(0, 2))
    assert times(update(memory, message_of(1, 2), untrusted=(1,))) == [(2, 1), (2, 0)]
    assert times(update(memory, message_of(2, 1), message_of(2, 2))) == [(1, 2), (2, 2), (2, 1), (2, 0)]


def test_messages_of_absent_senders_are_not_kept_over_drives():
    memory = MessageHistory()
    update(memory, message_of(50))
    assert update(memory, at=49) == []


@pytest.mark.parametrize("lead", [2, 9, 10**11])
def test_a_message_of_the_future_removes_no_other_sender(lead: int) -> None:
    """The newest received stamp counted as the time: one sender stamped 0.9 s ahead cleared the history of all others."""
    memory = MessageHistory()
    for at in range(3):
        update(memory, message_of(at, 1), message_of(at, 2), at=at)
    clean = times(update(memory, message_of(3, 1), at=3))
    memory = MessageHistory()
    for at in range(3):
        update(memory, message_of(at, 1), message_of(at, 2), message_of(at + lead, 9), at=at)
    found = times(update(memory, message_of(3, 1), at=3))
    assert [entry for entry in found if entry[0] != 9] == clean == [(1, 3), (1, 2), (1, 1), (2, 2), (2, 1)]


@pytest.mark.parametrize("stamp_ns", [-(2**63), 2**63 - 1, -3600 * 10**9, 2 * 10**9])
def test_messages_far_from_the_receivers_time_are_neither_returned_nor_stored(stamp_ns: int) -> None:
    memory = MessageHistory()
    strange = replace(message_of(0, 9), timestamp_ns=stamp_ns)
    assert times(memory.update_and_get([message_of(0), strange], 0)) == [(1, 0)]
    assert memory.senders == {1}


def test_the_history_of_a_sender_does_not_depend_on_other_senders() -> None:
    """A message that is delayed by 0.4 s finds its predecessor, whatever came in between."""
    alone, among = MessageHistory(), MessageHistory()
    for memory, others in ((alone, ()), (among, (6, 7, 8))):
        update(memory, message_of(0), at=0)
        for at in others:
            update(memory, message_of(at, 2), at=at)
        found = [entry for entry in times(update(memory, message_of(4), at=8)) if entry[0] == 1]
        assert found == [(1, 4), (1, 0)]
