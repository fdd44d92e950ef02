# SPDX-License-Identifier: Apache-2.0
"""Faults of agents, clocks and networks, each with its outcome, on clocks that the test moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.runtime.conftest import START_S, Federation
from tests.runtime.fault_team import MS, START_NS, FaultTeam, Member, claimed_agent, frame_of, fused

from manyeyes import Agent
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.network.interface import Origin
from manyeyes.comms.network.link_rings import LinkRings
from manyeyes.comms.wire import open_packet
from manyeyes.runtime.engine import Engine
from manyeyes.runtime.keys import Validity
from manyeyes.runtime.live import LiveTick
from manyeyes.runtime.transports.faulty import FaultPlan
from manyeyes.runtime.trust_file import Revocations

pytestmark = pytest.mark.slow
MAX_AGE_NS = 500 * MS
ALL = {1, 2, 3, 4, 5}


@pytest.fixture
def team(federation: Federation, tmp_path: Path) -> FaultTeam:
    """A message takes 40 ms."""
    return FaultTeam(federation, tmp_path, plan=FaultPlan(late_fraction=1.0, late_ns=40 * MS))


def ages_are_recent(ticks: list[dict[int, LiveTick]]) -> bool:
    return all(age <= MAX_AGE_NS for step in ticks for tick in step.values() for age in tick.ages_ns)


def test_a_killed_agent_that_restarts_is_fused_within_half_a_second(federation, tmp_path) -> None:
    """Signed, in mode require; the others miss no tick, and keep nothing of the agent while it is gone."""
    team = FaultTeam(federation, tmp_path, mode="require")
    team.steps(3)
    for _ in range(4):
        team.stop(3)
        gone = team.steps(10)
        assert all(not tick.missed and len(fused(tick)) == 3 for tick in gone[-1].values())
        for member in team.members.values():
            assert 3 not in {arrival.agent_id for arrival in member.engine.inbox.arrivals()}
            assert 3 not in member.engine.agent.message_history.senders
        team.start(3)
        back = team.steps(5)
        assert not any(tick.missed for step in gone + back for tick in step.values())
        first = [next(k for k, step in enumerate(back) if 3 in fused(step[agent])) for agent in (1, 2, 4, 5)]
        assert max(first) <= 4 and fused(back[-1][3]) == {1, 2, 4, 5}


def test_no_state_of_an_earlier_life_changes_results(detector, drive) -> None:
    """After a second of silence, results equal those of an ego that never received the earlier life, bit for bit."""
    some = drive(2)

    def frame(agent_id: int, index: int):
        return replace(some.frame(agent_id, index), timestamp_ns=START_NS + index * 10**8)

    results = []
    for knows_earlier_life in (True, False):
        ego = Engine(Agent(detector, get_strategy("intermediate-temporal"), budget_bytes=4_096))
        lives = [Agent(detector, get_strategy("intermediate-temporal"), budget_bytes=4_096) for _ in range(2)]
        for index in range(17):
            own, other = frame(0, index), frame(1, index)
            ego.share(own)
            life = lives[index >= 14]
            if index >= 14 or (knows_earlier_life and index < 3):
                for packet in life.share(other):
                    ego.inbox.push(packet, own.timestamp_ns + 50 * MS)
            found = ego.perceive(own, own.timestamp_ns + 70 * MS)
        assert [one.message.agent_id for one in found.received] == [1]
        results.append(torch.cat((found.boxes.bev(), found.boxes.score[:, None]), 1))
    assert torch.equal(*results)


def test_a_partition_separates_and_heals(team: FaultTeam) -> None:
    team.steps(3)
    sides = ({1, 2}, {3, 4, 5})
    for agent_id, member in team.members.items():
        own = next(side for side in sides if agent_id in side)
        member.network.accepts = lambda received, own=own: claimed_agent(received.packet) in own
    apart = team.steps(20)
    for agent_id, tick in apart[-1].items():
        assert fused(tick) == next(side for side in sides if agent_id in side) - {agent_id}
    for member in team.members.values():
        member.network.accepts = lambda received: True
    healed = team.steps(10)
    assert all(fused(tick) == ALL - {agent_id} for agent_id, tick in healed[-1].items())
    assert ages_are_recent(apart + healed)
    assert not any(tick.missed for step in apart + healed for tick in step.values())


def test_duplicates_reordered_and_late_packets_change_nothing_beyond_what_got_lost(
    detector, drive, federation, tmp_path
) -> None:
    """30 % twice, reordered within 0.2 s, 10 % late by 0.6 s: the result is that of the messages that were used, each once."""
    some = drive(3)
    plan = FaultPlan(5, duplicate_fraction=0.3, reorder_ns=200 * MS, late_fraction=0.1, late_ns=600 * MS)

    def make_agent() -> Agent:
        return Agent(detector, get_strategy("intermediate-temporal"), budget_bytes=4_096)

    def frame(agent_id: int, stamp_ns: int):
        index = (stamp_ns - START_NS) // 10**8
        return replace(some.frame(agent_id - 1, index), agent_id=agent_id, timestamp_ns=stamp_ns)

    team = FaultTeam(federation, tmp_path, 3, plan=plan, make_agent=make_agent, make_frame=frame)
    engine, accepted = team.members[1].engine, dict[tuple[int, int], list[bytes]]()
    push = engine.push

    def record(received) -> None:
        before = engine.dropped.total
        push(received)
        header = open_packet(received.packet).header
        if engine.dropped.total == before:
            accepted.setdefault((header.agent_id, header.timestamp_ns), []).append(received.packet)

    engine.push = record
    clean, used, num_old = Engine(make_agent()), 0, 0
    for _ in range(12):
        now_ns = team.ns
        tick = team.step()[1]
        clean.share(tick.frame)
        for one in tick.perception.received:
            stamp_ns = one.message.timestamp_ns
            num_old += stamp_ns < now_ns
            for packet in sorted(accepted.pop((one.message.agent_id, stamp_ns), [])):
                used += 1
                clean.inbox.push(packet, now_ns + 70 * MS)
        again = clean.perceive(tick.frame, now_ns + 70 * MS)
        assert torch.equal(again.boxes.bev(), tick.perception.boxes.bev())
        assert torch.equal(again.boxes.score, tick.perception.boxes.score)
    dropped = engine.dropped
    assert used >= 20 and num_old >= 2 and dropped.duplicate > 0 and dropped.expired > 0


@pytest.mark.parametrize("offset_ms", [300, -300, 150])
def test_a_sender_whose_clock_is_wrong_is_left_out_and_returns_within_two_seconds(team: FaultTeam, offset_ms) -> None:
    """+0.3 s: its packets are of the future. +0.15 s and -0.3 s: its clock is skewed. The others are fused as before."""
    team.steps(12)
    team.members[3].clock.offset_ns = offset_ms * MS
    wrong = team.steps(15)
    for agent_id in (1, 2, 4, 5):
        tick = wrong[-1][agent_id]
        assert fused(tick) == ALL - {agent_id, 3}
        reasons = [rejection.reason for rejection in tick.perception.rejected]
        dropped = tick.dropped
        assert dropped.future > 0 if offset_ms == 300 else reasons == ["skewed"]
    team.members[3].clock.offset_ns = 0
    repaired = team.steps(20)
    assert all(fused(tick) == ALL - {agent_id} for agent_id, tick in repaired[-1].items())
    assert ages_are_recent(wrong + repaired)


@pytest.mark.parametrize("step_ms", [300, -300])
def test_a_step_of_the_own_clock_is_an_event_and_a_second_alone(team: FaultTeam, step_ms: int) -> None:
    team.steps(5)
    member = team.members[1]
    member.clock.step(step_ms * MS)
    first = team.step()[1]
    assert first.note.startswith("clock_step") and fused(first) == set() and len(first.perception.boxes.score)
    # The clocks of the others follow, as those of one time server do.
    for other in (2, 3, 4, 5):
        team.members[other].clock.offset_ns = step_ms * MS
    alone = team.steps(8)
    assert all(fused(step[1]) == set() for step in alone)
    after = team.steps(4)
    assert fused(after[-1][1]) == ALL - {1} and member.engine.dropped.garbage == 0


def test_a_slow_ego_does_less_and_never_fuses_what_is_old(team: FaultTeam) -> None:
    team.members[1].delay_ns = 80 * MS
    slow = team.steps(12)
    assert slow[-1][1].level >= 1 and all(step[2].level == 0 for step in slow) and ages_are_recent(slow)
    team.members[1].delay_ns = 0
    assert not any(step[1].missed for step in team.steps(3))


def test_an_ego_that_was_stopped_for_five_seconds_recovers_within_one(team: FaultTeam) -> None:
    team.steps(3)
    stopped = team.steps(50, paused={1})
    assert all(fused(step[2]) == {3, 4, 5} for step in stopped[10:])
    back = team.steps(10)
    assert fused(back[-1][1]) == ALL - {1} and not back[-1][1].missed and ages_are_recent(back)
    assert fused(back[-1][2]) == ALL - {2}


def test_a_flood_of_forged_packets_changes_nothing_bit_for_bit(federation, tmp_path) -> None:
    """2,000 forged packets an instant on a link of their own, 20,000 a second, between the honest ones, in mode require."""
    results = []
    for is_flooded in (False, True):
        team = FaultTeam(federation, tmp_path, mode="require")
        if is_flooded:
            _flood(team.members[1], team)
        results.append([team.step()[1] for _ in range(6)])
        dropped = team.members[1].engine.dropped
    assert dropped.total > 500 and dropped.forged > 100
    for quiet, flooded in zip(*results):
        assert fused(flooded) == fused(quiet) == ALL - {1} and not flooded.missed
        assert torch.equal(quiet.perception.boxes.bev(), flooded.perception.boxes.bev())


def _flood(member: Member, team: FaultTeam) -> None:
    """Put forged packets into the bounded buffer of a link whenever the agent polls."""
    rings, poll = LinkRings(member.clock.true_ns), member.network.poll

    def flooded():
        honest = poll()
        for number in range(2_000 if honest else 0):
            packet = bytearray(honest[number % len(honest)].packet)
            packet[-1 - number % 64] ^= 1 + number % 255
            rings.put(bytes(packet), Origin("outsider"))
        return rings.take() + honest

    member.network.poll = flooded


def test_objects_of_an_agent_with_other_weights_are_fused_without_its_tokens(
    detector, drive, federation, tmp_path
) -> None:
    some = drive(2)

    def frame(agent_id: int, stamp_ns: int):
        index = (stamp_ns - START_NS) // 10**8
        return replace(some.frame(agent_id - 1, index), agent_id=agent_id, timestamp_ns=stamp_ns)

    def make_agent(strategy: str = "intermediate") -> Agent:
        return Agent(detector, get_strategy(strategy), budget_bytes=4_096)

    team = FaultTeam(federation, tmp_path, 2, make_agent=make_agent, make_frame=frame)
    engine = team.members[1].engine
    engine.agent.token_format = replace(engine.agent.token_format, fingerprint=b"anothers")
    engine.inbox = engine.agent.inbox()
    ticks = team.steps(3)
    tick = ticks[-1][1]
    assert tick.dropped.wrong_model > 0 and "wrong_model" in {r.reason for r in tick.perception.rejected}
    assert all(one.message.tokens is None for one in tick.perception.received)
    assert fused(ticks[-1][2]) == {1} and ticks[-1][2].dropped.wrong_model == 0
    # Boxes alone do not depend on weights.
    late = Engine(make_agent("late"))
    late.agent.token_format = engine.agent.token_format
    late.inbox = late.agent.inbox()
    own, other = frame(1, team.ns), frame(2, team.ns)
    for packet in make_agent("late").share(other):
        late.inbox.push(packet, team.ns + 30 * MS)
    late.share(own)
    assert [one.message.agent_id for one in late.perceive(own, team.ns + 70 * MS).received] == [2]


def test_a_revoked_issuer_and_an_expired_certificate_take_effect_within_a_second(federation, tmp_path) -> None:
    team = FaultTeam(federation, tmp_path, num=3, mode="off")
    # Valid for one minute from 55 s before the start; 60 s of tolerance: expires at 65 s.
    team.mode = "require"
    team.identities[2] = federation.identity(2, valid=Validity(START_S - 55, 1))
    team.members = {agent_id: Member(team, agent_id) for agent_id in (1, 2, 3)}
    team.steps(3)
    assert fused(team.step()[1]) == {2, 3}
    team.ns = START_NS + 66 * 10**9
    expired = team.steps(10)
    assert fused(expired[-1][1]) == {3} and expired[-1][1].dropped.certificate > 0
    issuer = federation.trust.issuers[0].certificate.identifier
    replace(federation.trust, revoked=Revocations(issuers=frozenset({issuer}))).save(team.trust_file)
    revoked = team.steps(10)
    assert fused(revoked[-1][1]) == set() and revoked[-1][1].dropped.revoked > 0
    assert not any(tick.missed for step in revoked for tick in step.values())


def test_frames_are_those_of_the_team() -> None:
    """Cars are 6 m apart: no two are one object."""
    places = [frame_of(k, 0).world_from_agent.apply(frame_of(k, 0).points.xyz.double()).mean(0) for k in (1, 2)]
    assert float((places[1] - places[0]).norm()) == pytest.approx(6.0, abs=0.01)
