# SPDX-License-Identifier: Apache-2.0
"""What was said before is heard again: the last few messages of each sender, newest first, and nothing from long ago."""

from __future__ import annotations

import torch

from manyeyes.agents.message_history import KEPT_NS, Memory
from manyeyes.agents.perception_cache import REMEMBERED
from manyeyes.datatypes import Message, Transform

TENTH_NS = 100_000_000


def said(at: int, agent: int = 1) -> Message:
    """A message of that tenth of a second."""
    return Message(agent, at * TENTH_NS, Transform.identity(), torch.zeros(3, 3).double())


def recall(
    memory: Memory, *messages: Message, at: int | None = None, distrusted: tuple[int, ...] = ()
) -> list[Message]:
    """What is heard at a tenth of a second; None: that of the newest message."""
    now = max(m.timestamp_ns for m in messages) if at is None else at * TENTH_NS
    return memory.recall(messages, now, distrusted)


def times(messages: list[Message]) -> list[tuple[int, int]]:
    return [(message.agent_id, message.timestamp_ns // TENTH_NS) for message in messages]


def test_what_a_sender_said_before_stands_behind_what_it_says_newest_first_and_no_more_of_it_than_is_kept():
    memory = Memory()
    found = [times(recall(memory, said(at))) for at in range(REMEMBERED + 2)]
    assert REMEMBERED == 2 and found == [[(1, 0)], [(1, 1), (1, 0)], [(1, 2), (1, 1), (1, 0)], [(1, 3), (1, 2), (1, 1)]]


def test_each_sender_is_remembered_by_itself():
    memory = Memory()
    recall(memory, said(0, 1), said(0, 2))
    assert times(recall(memory, said(1, 2), said(2, 1))) == [(2, 1), (2, 0), (1, 2), (1, 0)]


def test_a_message_heard_again_with_more_packets_takes_its_own_place():
    memory = Memory()
    recall(memory, said(0))
    recall(memory, said(1))
    again = said(1)
    found = recall(memory, again)
    assert times(found) == [(1, 1), (1, 0)] and found[0] is again


def test_a_sender_that_says_nothing_new_is_heard_as_it_was():
    memory = Memory()
    recall(memory, said(0))
    now = said(1)
    assert times(recall(memory, now)) == times(recall(memory, now)) == [(1, 1), (1, 0)]


def test_what_is_older_than_half_a_second_is_forgotten():
    apart = KEPT_NS // TENTH_NS
    for gap, length in ((apart, 2), (apart + 1, 1)):
        memory = Memory()
        recall(memory, said(0))
        assert len(recall(memory, said(gap))) == length


def test_a_time_that_goes_back_begins_anew():
    memory = Memory()
    recall(memory, said(50))
    recall(memory, said(51))
    assert times(recall(memory, said(49))) == [(1, 49)]
    assert times(recall(memory, said(50))) == [(1, 50), (1, 49)]


def test_senders_that_fell_silent_are_forgotten_even_where_one_that_is_late_is_heard():
    memory = Memory()
    recall(memory, *(said(0, agent) for agent in range(100)))
    assert times(recall(memory, said(9, 7), said(2, 8))) == [(7, 9), (8, 2), (8, 0)]
    assert list(memory._held) == [7]


def test_who_falls_silent_is_remembered_for_half_a_second():
    """Its packets were lost, or nobody could say from where it spoke."""
    memory = Memory()
    for at in (0, 1, 2):
        recall(memory, said(at, 1), said(at, 2))
    assert times(recall(memory, said(3, 2))) == [(2, 3), (2, 2), (2, 1), (1, 2), (1, 1)]
    assert times(recall(memory, at=4)) == [(1, 2), (1, 1), (2, 3), (2, 2)]
    assert times(recall(memory, at=7)) == [(1, 2), (2, 3), (2, 2)]
    assert times(recall(memory, at=8)) == [(2, 3)] and recall(memory, at=9) == []


def test_who_is_late_and_falls_silent_is_no_older_than_half_a_second():
    memory = Memory()
    recall(memory, said(0, 1), said(0, 2), at=4)
    assert times(recall(memory, said(1, 2), at=5)) == [(2, 1), (2, 0), (1, 0)]
    assert times(recall(memory, said(2, 2), at=6)) == [(2, 2), (2, 1), (2, 0)]


def test_who_is_distrusted_is_forgotten():
    memory = Memory()
    recall(memory, said(0, 1), said(0, 2))
    assert times(recall(memory, said(1, 2), distrusted=(1,))) == [(2, 1), (2, 0)]
    assert times(recall(memory, said(2, 1), said(2, 2))) == [(1, 2), (2, 2), (2, 1), (2, 0)]


def test_silence_does_not_outlive_a_drive():
    memory = Memory()
    recall(memory, said(50))
    assert recall(memory, at=49) == []
