# SPDX-License-Identifier: Apache-2.0
"""A team of live agents in one process, on clocks that the test moves: each can be stopped, restarted and slowed."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import torch
from tests.runtime.conftest import START_S, Federation

from manyeyes import Agent, AgentFrame, BevGrid, BoxDetector, Boxes, PointCloud, Transform
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.channel import Channel, channel_preset
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.network.interface import ReceivedPacket
from manyeyes.comms.signatures.envelope import is_signed, split_signed
from manyeyes.comms.wire import open_packet
from manyeyes.runtime.clock import TAI_UTC_NS
from manyeyes.runtime.live import LiveConfig, LiveRun, LiveTick
from manyeyes.runtime.pseudonyms import PseudonymPool
from manyeyes.runtime.recorder import Recorder
from manyeyes.runtime.security import Security
from manyeyes.runtime.transports.faulty import FaultPlan, FaultyNetwork
from manyeyes.runtime.transports.local import LocalNetwork

START_NS, MS, TENTH_NS = START_S * 10**9 + TAI_UTC_NS, 10**6, 10**8
PLACE = (100.0, 100.0)


class OneCar(BoxDetector):
    """One car around the middle of all points."""

    grid = BevGrid(-70.4, -38.4, 0.3, 70.4, 38.4, 2.5)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        centre = points.xyz.mean(0, keepdim=True)
        return Boxes.of(centre, torch.tensor([[4.5, 1.9, 1.6]]), torch.zeros(1), torch.tensor([0.9]))


def frame_of(agent_id: int, stamp_ns: int) -> AgentFrame:
    """A frame with a car of the agent's own, 6 m from those of its neighbours, in the world."""
    points = torch.tensor([10.0, 3.0 * agent_id, 0.8]) + 0.1 * torch.randn(
        20, 3, generator=torch.Generator().manual_seed(7)
    )
    return AgentFrame.of(
        PointCloud.of(points), Transform.from_xyz_yaw(PLACE[0], PLACE[1] + 3.0 * agent_id, 0.0), agent_id, stamp_ns
    )


def claimed_agent(packet: bytes) -> int:
    """The agent id in the header of a packet."""
    return open_packet(split_signed(packet).packet if is_signed(packet) else packet).header.agent_id


class AgentClock:
    """The time of the world, as far as its agent got in this frame, plus the offset of the agent's clock."""

    start_ns, rate = START_NS, 1.0

    def __init__(self, team: FaultTeam) -> None:
        self._team, self.ahead_ns, self.offset_ns, self._step_ns = team, 0, 0, 0

    def true_ns(self) -> int:
        return self._team.ns + self.ahead_ns

    def now_ns(self) -> int:
        return self.true_ns() + self.offset_ns

    def sleep(self, duration_ns: int) -> None:
        self.ahead_ns += max(duration_ns, 1)

    def step(self, step_ns: int) -> None:
        """The system clock steps, and the agent notices."""
        self.offset_ns += step_ns
        self._step_ns += step_ns

    def discipline(self) -> int:
        step_ns, self._step_ns = self._step_ns, 0
        return step_ns


class OffsetNetwork(FaultyNetwork):
    """Arrivals by the clock of the agent."""

    clock: AgentClock

    def poll(self) -> list[ReceivedPacket]:
        return [r._replace(arrival_ns=r.arrival_ns + self.clock.offset_ns) for r in super().poll()]


class Member:
    """One agent of the team, from its start to its end."""

    def __init__(self, team: FaultTeam, agent_id: int) -> None:
        self.agent_id, self.clock, self.delay_ns = agent_id, AgentClock(team), 0
        local = LocalNetwork(team.bus, agent_id, self.clock.true_ns)
        self.network = OffsetNetwork(local, self.clock.true_ns, replace(team.plan, seed=team.plan.seed + agent_id))
        self.network.clock = self.clock
        self.network.join(PLACE)
        self.network.poll()
        security = Security()
        if team.mode != "off":
            identity = team.identities.setdefault(agent_id, team.federation.identity(agent_id))
            security = Security(team.mode, PseudonymPool([identity]), team.trust_file)
        self.recorder: Recorder | None = None
        self.run = LiveRun([], team.make_agent(), self.network, self.clock, LiveConfig(), security)
        perceive = self.run._loop.engine.perceive

        def slow(frame: AgentFrame, now_ns: int):
            self.clock.ahead_ns += self.delay_ns
            return perceive(frame, now_ns)

        self.run._loop.engine.perceive = slow

    @property
    def engine(self):
        return self.run._loop.engine


class FaultTeam:
    """Agents 1 to num on one channel without loss. step: one instant of all that run."""

    def __init__(
        self,
        federation: Federation,
        tmp_path: Path,
        num: int = 5,
        mode: str = "off",
        plan: FaultPlan | None = None,
        make_agent: Callable[[], Agent] = lambda: Agent(OneCar(), get_strategy("late")),
        make_frame: Callable[[int, int], AgentFrame] = frame_of,
    ) -> None:
        self.ns, self.federation, self.mode, self.plan = START_NS, federation, mode, plan or FaultPlan()
        self.bus, self.make_agent, self.make_frame = LocalBus(Channel(channel_preset("ideal"))), make_agent, make_frame
        self.identities, self.trust_file = {}, tmp_path / "trust.toml"
        federation.trust.save(self.trust_file)
        self.members = {agent_id: Member(self, agent_id) for agent_id in range(1, num + 1)}

    def start(self, agent_id: int) -> Member:
        self.members[agent_id] = Member(self, agent_id)
        return self.members[agent_id]

    def stop(self, agent_id: int) -> None:
        del self.members[agent_id]

    def step(self, paused: Collection[int] = ()) -> dict[int, LiveTick]:
        """Return the ticks of an instant; paused: agents that do nothing in it."""
        running = {agent_id: member for agent_id, member in self.members.items() if agent_id not in paused}
        for member in self.members.values():
            member.clock.ahead_ns = 0
        shared = {
            agent_id: member.run.share(self.make_frame(agent_id, member.clock.now_ns()))
            for agent_id, member in running.items()
        }
        ticks = {agent_id: member.run.perceive(shared[agent_id]) for agent_id, member in running.items()}
        self.ns += TENTH_NS
        return ticks

    def steps(self, num: int, paused: Collection[int] = ()) -> list[dict[int, LiveTick]]:
        return [self.step(paused) for _ in range(num)]


def fused(tick: LiveTick) -> set[int]:
    return {one.message.agent_id for one in tick.perception.received}
