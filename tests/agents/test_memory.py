# SPDX-License-Identifier: Apache-2.0
"""What was lost is filled from what was said before: once, where it is by now, and not from long ago."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.memory import KEPT_NS, SAME_M, Memory
from manyeyes.comms.inbox import Reception
from manyeyes.datatypes import BevGrid, Boxes, Message, SparseBev, Transform
from manyeyes.models.box_head import RAW, SPEED_UNIT
from manyeyes.models.proposal import PROPOSAL

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 4
TENTH_NS = 100_000_000


def tokens(*places: tuple[int, int], speed: tuple[float, float] = (0.0, 0.0)) -> SparseBev:
    """Tokens on (row, column), each of a thing that moves at that many metres per second."""
    rows = torch.zeros(len(places), CHANNELS + PROPOSAL)
    rows[:, :CHANNELS] = torch.arange(len(places))[:, None] + 1.0
    rows[:, CHANNELS:][:, RAW.velocity] = torch.tensor(speed) / SPEED_UNIT
    return SparseBev.from_cells(rows, torch.tensor(places).view(-1, 2), GRID)


def said(at: int, some: SparseBev | None, agent: int = 1, pose: Transform | None = None, **sections) -> Message:
    """A message of that tenth of a second."""
    place = pose or Transform.identity()
    return Message(agent, at * TENTH_NS, place, torch.zeros(3, 3).double(), tokens=some, **sections)


def whole(message: Message) -> Reception:
    return Reception(message, 3, 3, None)


def cut(message: Message) -> Reception:
    return Reception(message, 2, 3, None)


def cells(message: Message) -> list[list[int]]:
    assert message.tokens is not None
    return message.tokens.sites.yx.tolist()


def test_a_lost_packet_is_filled_from_the_message_before_and_nothing_is_said_twice():
    memory = Memory()
    before, now = said(0, tokens((2, 2), (8, 8), (14, 14))), said(1, tokens((2, 2), (8, 9)))
    assert memory.complete([whole(before)]) == [before]
    first, rest = memory.complete([cut(now)])
    # (2, 2) is said again, (8, 8) lies one cell of 1.6 m from what is said at (8, 9); the third was lost.
    assert first is now and cells(rest) == [[14, 14]] and rest.timestamp_ns == 0
    assert torch.equal(rest.tokens.features[:, :CHANNELS], torch.full((1, CHANNELS), 3.0))
    assert rest.token_score is None and rest.agent_id == 1


def test_a_whole_message_needs_no_memory():
    memory = Memory()
    memory.complete([whole(said(0, tokens((2, 2), (14, 14))))])
    now = said(1, tokens((2, 2)))
    assert memory.complete([whole(now)]) == [now]


def test_a_cut_message_alone_stays_as_it_came():
    now = said(1, tokens((2, 2)))
    assert Memory().complete([cut(now)]) == [now]


def test_heard_again_it_is_completed_again_and_less_where_more_has_come():
    memory = Memory()
    memory.complete([whole(said(0, tokens((2, 2), (8, 8), (14, 14))))])
    now = said(1, tokens((2, 2)))
    for _ in range(2):
        assert cells(memory.complete([cut(now)])[1]) == [[8, 8], [14, 14]]
    more = said(1, tokens((2, 2), (8, 8)))
    assert cells(memory.complete([cut(more)])[1]) == [[14, 14]]
    assert memory.complete([whole(more)]) == [more]
    # What the next one lacks comes from the newest that there is, not from the filling.
    assert cells(memory.complete([cut(said(2, tokens((2, 2))))])[1]) == [[8, 8]]


@pytest.mark.parametrize(
    ("tenths", "filled"), ((1, True), (KEPT_NS // TENTH_NS, True), (KEPT_NS // TENTH_NS + 1, False))
)
def test_nothing_older_than_its_keep_is_used(tenths, filled):
    memory = Memory()
    memory.complete([whole(said(0, tokens((14, 14))))])
    assert len(memory.complete([cut(said(tenths, tokens((2, 2))))])) == 1 + filled


def test_who_is_silent_for_long_is_forgotten():
    memory = Memory()
    memory.complete([whole(said(0, tokens((2, 2)), agent)) for agent in range(100)])
    memory.complete([whole(said(9, tokens((2, 2)), 7))])
    assert list(memory._held) == [7]


def test_a_time_that_goes_back_begins_anew():
    memory = Memory()
    memory.complete([whole(said(0, tokens((14, 14))))])
    memory.complete([whole(said(2, tokens((14, 14))))])
    again = said(1, tokens((2, 2)))
    assert memory.complete([cut(again)]) == [again]
    assert cells(memory.complete([cut(said(2, tokens((8, 8))))])[1]) == [[2, 2]]


def test_senders_do_not_fill_each_others_gaps():
    memory = Memory()
    memory.complete([whole(said(0, tokens((14, 14)), 1)), whole(said(0, tokens((8, 8)), 2))])
    now = [cut(said(1, tokens((2, 2)), agent)) for agent in (2, 1, 3)]
    filled = memory.complete(now)
    assert [m.agent_id for m in filled] == [2, 2, 1, 1, 3]
    assert cells(filled[1]) == [[8, 8]] and cells(filled[3]) == [[14, 14]]


def test_what_moved_is_known_again_where_it_is_by_now():
    # A thing at (8, 8) drives 20 m/s along x: in 0.4 s it is five cells of 1.6 m on. A standing thing is lost there.
    moving, standing = (tokens((8, 8), speed=s) for s in ((20.0, 0.0), (0.0, 0.0)))
    for some, filled in ((moving, False), (standing, True)):
        memory = Memory()
        memory.complete([whole(said(0, some))])
        assert len(memory.complete([cut(said(4, tokens((8, 13))))])) == 1 + filled


def test_a_sender_that_drove_on_says_the_same_from_elsewhere():
    # It drove two cells ahead: what it saw at (8, 8) it sees at (8, 6).
    memory, ahead = Memory(), Transform.from_xyz_yaw(2 * GRID.cell, 0.0)
    memory.complete([whole(said(0, tokens((8, 8), (14, 14))))])
    rest = memory.complete([cut(said(1, tokens((8, 6)), pose=ahead))])[1]
    assert cells(rest) == [[14, 14]] and torch.equal(rest.world_from_agent.translation, torch.zeros(3).double())


def boxes(*x: float, speed: float = 0.0) -> Boxes:
    n = len(x)
    center = torch.tensor([[at, 0.0, 0.8] for at in x]).view(n, 3)
    velocity = torch.tensor([[speed, 0.0]]).expand(n, 2)
    return Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(n, 3), torch.zeros(n), velocity=velocity)


def test_boxes_are_filled_by_the_same_rule():
    memory = Memory()
    memory.complete([whole(said(0, None, objects=boxes(0.0, 10.0, 30.0, speed=10.0)))])
    # By 0.2 s the first is at 2 m, the second at 12 m, just near enough to one said there; the third was lost.
    rest = memory.complete([cut(said(2, None, objects=boxes(2.0, 12.0 + 0.9 * SAME_M)))])[1]
    assert rest.objects is not None and rest.objects.center[:, 0].tolist() == [30.0]
    assert rest.tokens is None


def test_a_message_with_nothing_left_in_it_is_filled_whole():
    memory, before = Memory(), said(0, tokens((2, 2), (8, 8)), objects=boxes(1.0))
    memory.complete([whole(before)])
    rest = memory.complete([cut(said(1, None))])[1]
    assert cells(rest) == [[2, 2], [8, 8]] and len(rest.objects) == 1
    assert len(memory.complete([cut(replace(before, timestamp_ns=2 * TENTH_NS))])) == 1
