# SPDX-License-Identifier: Apache-2.0
"""Faults on real transports, in threads of one process and in slow motion: restart, partition, flood, late and double packets."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("cryptography", reason="the extra live is not installed")

from tests.runtime.fault_team import PLACE, OneCar, claimed_agent, frame_of

from manyeyes import Agent
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.network.interface import Network
from manyeyes.runtime.clock import LiveClock
from manyeyes.runtime.live import LiveConfig, LiveRun, LiveTick
from manyeyes.runtime.transports.faulty import FaultPlan, FaultyNetwork
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork
from manyeyes.runtime.transports.zenoh import ZenohConfig, ZenohNetwork

pytestmark = pytest.mark.slow
RATE, TENTH_NS, WAIT_S = 0.25, 10**8, 60.0
PLAN = FaultPlan(3, duplicate_fraction=0.3, reorder_ns=20_000_000)


class Member:
    """One agent in a thread; clocks of all members are one."""

    def __init__(self, agent_id: int, clock: LiveClock, network: Network) -> None:
        self.agent_id, self.clock, self.stopped, self.ticks = agent_id, clock, False, list[LiveTick]()
        self.network = FaultyNetwork(network, clock.now_ns, PLAN)
        self.network.join(PLACE)
        agent = Agent(OneCar(), get_strategy("late"))
        self.run = LiveRun(self.frames(), agent, self.network, clock, LiveConfig(ladder=False))
        self.thread = threading.Thread(target=self.work, daemon=True)
        self.thread.start()

    def frames(self):
        stamp_ns = -(-self.clock.now_ns() // TENTH_NS) * TENTH_NS
        while not self.stopped:
            stamp_ns = max(stamp_ns + TENTH_NS, self.clock.now_ns() // TENTH_NS * TENTH_NS)
            yield frame_of(self.agent_id, stamp_ns)

    def work(self) -> None:
        for tick in self.run:
            self.ticks.append(tick)

    def fused(self) -> set[int]:
        return {one.message.agent_id for one in self.ticks[-1].perception.received} if self.ticks else set()

    def stop(self) -> None:
        self.stopped = True
        self.run.stop()
        self.thread.join()
        self.network.close()


@pytest.fixture(params=["udp", "zenoh"])
def start(request: pytest.FixtureRequest) -> Iterator[Callable[[int], Member]]:
    """Starts an agent on a network of this test."""
    if request.param == "zenoh":
        pytest.importorskip("zenoh", reason="the extra live is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    clock, name, made = LiveClock(rate=RATE), f"faults-{os.getpid()}", list[Member]()

    def make(agent_id: int) -> Member:
        if request.param == "udp":
            network: Network = UdpNetwork(UdpConfig(name, port=port), clock.now_ns)
        else:
            seed = f"tcp/127.0.0.1:{port}"
            config = ZenohConfig(name, listen=(seed,)) if agent_id == 1 else ZenohConfig(name, connect=(seed,))
            network = ZenohNetwork(config, agent_id, clock.now_ns)
        made.append(Member(agent_id, clock, network))
        return made[-1]

    yield make
    for member in made:
        member.stop()


def wait(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_agents_restart_separate_and_heal(start: Callable[[int], Member]) -> None:
    team = {agent_id: start(agent_id) for agent_id in (1, 2, 3)}
    wait(lambda: all(member.fused() == {1, 2, 3} - {k} for k, member in team.items()))
    # An agent that is gone is fused for half a second at most; one that comes back is fused again.
    team.pop(3).stop()
    wait(lambda: team[1].fused() == {2} and team[2].fused() == {1})
    team[3] = start(3)
    wait(lambda: all(member.fused() == {1, 2, 3} - {k} for k, member in team.items()))
    for member in team.values():
        side = {1} if member.agent_id == 1 else {2, 3}
        member.network.accepts = lambda received, side=side: claimed_agent(received.packet) in side
    wait(lambda: team[1].fused() == set() and team[2].fused() == {3} and team[3].fused() == {2})
    for member in team.values():
        member.network.accepts = lambda received: True
    wait(lambda: all(member.fused() == {1, 2, 3} - {k} for k, member in team.items()))
    assert sum(member.ticks[-1].dropped.duplicate for member in team.values()) > 0
    # A perception begins within the age that packets may have, and is done a little later.
    assert all(age <= 700_000_000 for member in team.values() for tick in member.ticks for age in tick.ages_ns)
