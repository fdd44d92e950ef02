# SPDX-License-Identifier: Apache-2.0
"""A recording played through agents on a channel: share, bytes, deliver, perceive; the functions that an agent calls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.perception_cache import FOLLOWED, REMEMBERED, Eyes, Sight
from manyeyes.agents.pose_correction import Aligner
from manyeyes.agents.strategies import method
from manyeyes.comms.bandwidth import fair_shares
from manyeyes.comms.channel import Channel, ChannelPreset, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.wire import Precision
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, Boxes, Snapshot, Transform
from manyeyes.models.detector.detector import Detector

EXPIRE_NS = 500_000_000
STEADY = FOLLOWED + REMEMBERED
"""Snapshots after which whoever is heard has looked, and spoken, for as long as anybody looks back."""

Views = dict[tuple[int, int], Sight]
"""What agents made of their sweeps, by agent and time of capture."""


@dataclass(frozen=True)
class ReplayConfig:
    """How a recording is played.

    channel: a preset by name, or any other radio. precision: of tokens; None: the weights' usual. wait_s: how long after its own
    sweep an ego waits for messages before it perceives; whatever came by then takes part, the newest of each sender. all_egos:
    every agent is judged as ego, not the first alone. history: snapshots played before the first judged one, so that messages are
    under way and boxes followed. reach_m: radios farther apart do not hear each other (true poses). channel_bytes: what all
    agents together may send at an instant, shared as ``comms.bandwidth.fair_shares`` does by what each would say alone, as if
    scheduled by one who is told.
    requests: messages of tokens say where their sender needs no help, and what came lately weighs what is sent.
    aligner: corrects where others say they are, None: nobody does.
    """

    channel: str | ChannelPreset = "ideal"
    precision: Precision | None = None
    budget_bytes: int | None = 1 << 17
    channel_bytes: int | None = None
    wait_s: float = 0.0
    all_egos: bool = False
    history: int = 0
    reach_m: float = 70.0
    seed: int = 0
    requests: bool = False
    aligner: Aligner | None = None

    @property
    def radio(self) -> ChannelPreset:
        """The channel itself."""
        return self.channel if isinstance(self.channel, ChannelPreset) else channel_preset(self.channel)


@dataclass(frozen=True)
class Sent:
    """What one agent put on the air at one instant. sizes: bytes of each packet; seconds: the time that share took."""

    agent_id: int
    sizes: tuple[int, ...]
    seconds: float

    @property
    def bytes(self) -> int:
        """Of all packets."""
        return sum(self.sizes)

    @property
    def packets(self) -> int:
        """Their number."""
        return len(self.sizes)


@dataclass(frozen=True)
class Step:
    """One ego at one instant, with one method. ages_s: at the time of perceiving, of every message that took part."""

    method: str
    snapshot: Snapshot
    ego: int
    perception: Perception
    sent: tuple[Sent, ...]
    ages_s: tuple[float, ...]
    perceive_seconds: float

    @property
    def boxes(self) -> Boxes:
        """What the ego perceived, in its frame."""
        return self.perception.boxes


@dataclass
class Team:
    """All agents of one scenario with one method, their inboxes and the air between them. known: views that need no second look."""

    method: str
    detector: Detector
    config: ReplayConfig
    known: Views | None = None
    _agents: dict[int, Agent] = field(default_factory=dict)
    _inboxes: dict[int, Inbox] = field(default_factory=dict)
    _bus: LocalBus = field(init=False)

    def __post_init__(self) -> None:
        self._bus = LocalBus(Channel(self.config.radio, self.config.seed))

    def step(self, snapshot: Snapshot) -> Iterator[Step]:
        """Everybody shares; whoever is judged waits, hears and perceives."""
        places = _places(snapshot)
        sent = self._share(snapshot.frames, places)
        egos = range(len(snapshot.frames)) if self.config.all_egos else range(1)
        for ego, frame in enumerate(snapshot.frames):
            until = frame.timestamp_ns + round(self.config.wait_s * 1e9)
            agent, inbox = self._at(frame)
            here = places[frame.agent_id]
            for delivery in self._bus.deliver(frame.agent_id, here, until):
                if math.dist(here, places.get(delivery.sender, here)) <= self.config.reach_m:
                    inbox.push(delivery.packet, delivery.arrival_ns)
            if ego in egos:
                began = time.perf_counter()
                perception = agent.perceive(frame, inbox, until)
                took = time.perf_counter() - began
                for rejection in perception.rejected:
                    # All senders of a replay are agents of this program: an error is a defect, not an attack.
                    if rejection.cause is not None:
                        raise rejection.cause
                ages = tuple(heard.age_ns(until) / 1e9 for heard in perception.heard)
                yield Step(self.method, snapshot, ego, perception, sent, ages, took)

    def _share(self, frames: Sequence[AgentFrame], places: dict[int, tuple[float, float]]) -> tuple[Sent, ...]:
        """What everybody says, handed to the bus: each packet is counted as it is handed over."""
        said = [self._say(frame) for frame in frames]
        if self.config.channel_bytes is not None:
            wanted = [sum(map(len, packets)) for packets, _ in said]
            shares = fair_shares(self.config.channel_bytes, wanted)
            less = zip(frames, said, wanted, shares)
            said = [spoken if share == want else self._say(frame, share) for frame, spoken, want, share in less]
        for frame, (packets, _) in zip(frames, said):
            self._bus.publish(frame.agent_id, places[frame.agent_id], packets, frame.timestamp_ns)
        return tuple(
            Sent(frame.agent_id, tuple(map(len, packets)), took) for frame, (packets, took) in zip(frames, said)
        )

    def _say(self, frame: AgentFrame, budget_bytes: int | None = None) -> tuple[list[bytes], float]:
        """An agent's packets, and the seconds that they took it."""
        agent, inbox = self._at(frame)
        asked = inbox.messages() if self.config.requests else ()
        began = time.perf_counter()
        packets = agent.share(frame, budget_bytes, asked)
        return packets, time.perf_counter() - began

    def _at(self, frame: AgentFrame) -> tuple[Agent, Inbox]:
        who = frame.agent_id
        if who not in self._agents:
            eyes = Eyes(self.detector, known=self.known)
            config = self.config
            way = method(self.method)
            self._agents[who] = Agent(
                self.detector, way, config.precision, config.budget_bytes, eyes, config.aligner, config.requests
            )
            self._inboxes[who] = self._agents[who].inbox(EXPIRE_NS)
        return self._agents[who], self._inboxes[who]


def _places(snapshot: Snapshot) -> dict[int, tuple[float, float]]:
    """Where each antenna really is, as far as the recording knows: radio waves do not care for claims."""
    poses = (
        snapshot.truth.world_from_agent
        if snapshot.truth
        else Transform.stack([f.world_from_agent for f in snapshot.frames])
    )
    return {frame.agent_id: (xyz[0], xyz[1]) for frame, xyz in zip(snapshot.frames, poses.translation.tolist())}


def replay(
    recording: Recording,
    scenario: str,
    detector: Detector,
    methods: Sequence[str],
    config: ReplayConfig,
    disturb: Callable[[Snapshot], Snapshot] = lambda snapshot: snapshot,
    known: Views | None = None,
) -> Iterator[Step]:
    """Every judged snapshot of one scenario through each method in turn.

    disturb: what happens to claimed poses before anybody sees them. known: what agents of this scenario and these weights made of
    their sweeps, played from the same first snapshot on; it is added to, so that the methods look at a sweep once between them.
    Their boxes are the same; their times are then not to be compared.
    """
    teams = [Team(name, detector, config, known) for name in methods]
    judged = recording.judged(scenario)
    for index in range(max(0, judged.start - config.history), judged.stop):
        snapshot = disturb(recording.snapshot(scenario, index))
        for team in teams:
            for step in team.step(snapshot):
                if index in judged:
                    yield step
