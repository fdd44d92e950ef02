# SPDX-License-Identifier: Apache-2.0
"""A recording played through agents on a channel: share, bytes, deliver, perceive; the functions that an agent calls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.perception_cache import HISTORY_FRAMES, TRACK_FRAMES, AgentOutput, PerceptionCache
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies import get_strategy
from manyeyes.comms.bandwidth import allocate_max_min_fair
from manyeyes.comms.channel import Channel, ChannelPreset, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.wire import TokenEncoding
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, Boxes, Snapshot, Transform
from manyeyes.models.detector.detector import Detector

EXPIRE_NS = 500_000_000
WARMUP_FRAMES = TRACK_FRAMES + HISTORY_FRAMES
"""Snapshots after which whoever is heard has looked, and spoken, for as long as anybody looks back."""

CachedOutputs = dict[tuple[int, int], AgentOutput]
"""What agents made of their sweeps, by agent and time of capture."""


@dataclass(frozen=True)
class ReplayConfig:
    """How a recording is played.

    channel: a preset by name, or any other radio. token_encoding: of tokens; None: the weights' usual. latency_budget_s: how long
    after its own sweep an ego waits for messages before it perceives; whatever came by then takes part, the newest of each sender.
    all_egos: every agent is judged as ego, not the first alone. warmup_frames: snapshots played before the first judged one, so
    that messages are under way and boxes followed. comm_range_m: radios farther apart do not hear each other (true poses).
    channel_budget_bytes: what all agents together may send at an instant, shared as ``comms.bandwidth.allocate_max_min_fair`` does
    by what each would say alone, as if scheduled by one who is told.
    send_request_map: messages of tokens say where their sender needs no help, and what came lately weighs what is sent.
    pose_correction: corrects where others say they are, None: nobody does.
    """

    channel: str | ChannelPreset = "ideal"
    token_encoding: TokenEncoding | None = None
    budget_bytes: int | None = 1 << 17
    channel_budget_bytes: int | None = None
    latency_budget_s: float = 0.0
    all_egos: bool = False
    warmup_frames: int = 0
    comm_range_m: float = 70.0
    seed: int = 0
    send_request_map: bool = False
    pose_correction: PoseCorrection | None = None

    @property
    def radio(self) -> ChannelPreset:
        """The channel itself."""
        return self.channel if isinstance(self.channel, ChannelPreset) else channel_preset(self.channel)


@dataclass(frozen=True)
class SentPackets:
    """What one agent put on the air at one instant. packet_sizes: bytes of each packet; seconds: the time that share took."""

    agent_id: int
    packet_sizes: tuple[int, ...]
    seconds: float

    @property
    def num_bytes(self) -> int:
        """Of all packets."""
        return sum(self.packet_sizes)

    @property
    def num_packets(self) -> int:
        """Their number."""
        return len(self.packet_sizes)


@dataclass(frozen=True)
class ReplayStep:
    """One ego at one instant, with one method. ages_s: at the time of perceiving, of every message that took part."""

    method: str
    snapshot: Snapshot
    ego: int
    perception: Perception
    sent: tuple[SentPackets, ...]
    ages_s: tuple[float, ...]
    perceive_seconds: float

    @property
    def boxes(self) -> Boxes:
        """What the ego perceived, in its frame."""
        return self.perception.boxes


@dataclass
class DetectionReplay:
    """All agents of one scenario with one method, their inboxes and the air between them. feature_cache: views that need no
    second look.
    """

    method: str
    detector: Detector
    config: ReplayConfig
    feature_cache: CachedOutputs | None = None
    _agents: dict[int, Agent] = field(default_factory=dict)
    _inboxes: dict[int, Inbox] = field(default_factory=dict)
    _bus: LocalBus = field(init=False)

    def __post_init__(self) -> None:
        self._bus = LocalBus(Channel(self.config.radio, self.config.seed))

    def step(self, snapshot: Snapshot) -> Iterator[ReplayStep]:
        """Everybody shares; whoever is judged waits, hears and perceives."""
        positions = _antenna_positions(snapshot)
        sent = self._share(snapshot.frames, positions)
        egos = range(len(snapshot.frames)) if self.config.all_egos else range(1)
        for ego, frame in enumerate(snapshot.frames):
            deadline_ns = frame.timestamp_ns + round(self.config.latency_budget_s * 1e9)
            agent, inbox = self._get_agent_and_inbox(frame)
            here = positions[frame.agent_id]
            for delivery in self._bus.deliver(frame.agent_id, here, deadline_ns):
                if math.dist(here, positions.get(delivery.sender_id, here)) <= self.config.comm_range_m:
                    inbox.push(delivery.packet, delivery.arrival_ns)
            if ego in egos:
                began = time.perf_counter()
                perception = agent.perceive(frame, inbox, deadline_ns)
                took = time.perf_counter() - began
                for rejection in perception.rejected:
                    # All senders of a replay are agents of this program: an error is a defect, not an attack.
                    if rejection.cause is not None:
                        raise rejection.cause
                ages = tuple(message.age_ns(deadline_ns) / 1e9 for message in perception.received)
                yield ReplayStep(self.method, snapshot, ego, perception, sent, ages, took)

    def _share(
        self, frames: Sequence[AgentFrame], positions: dict[int, tuple[float, float]]
    ) -> tuple[SentPackets, ...]:
        """What everybody says, handed to the bus: each packet is counted as it is handed over."""
        outgoing = [self._share_one(frame) for frame in frames]
        if self.config.channel_budget_bytes is not None:
            requested = [sum(map(len, packets)) for packets, _ in outgoing]
            shares = allocate_max_min_fair(self.config.channel_budget_bytes, requested)
            limited = zip(frames, outgoing, requested, shares)
            outgoing = [
                message if share == want else self._share_one(frame, share) for frame, message, want, share in limited
            ]
        for frame, (packets, _) in zip(frames, outgoing):
            self._bus.publish(frame.agent_id, positions[frame.agent_id], packets, frame.timestamp_ns)
        return tuple(
            SentPackets(frame.agent_id, tuple(map(len, packets)), took)
            for frame, (packets, took) in zip(frames, outgoing)
        )

    def _share_one(self, frame: AgentFrame, budget_bytes: int | None = None) -> tuple[list[bytes], float]:
        """An agent's packets, and the seconds that they took it."""
        agent, inbox = self._get_agent_and_inbox(frame)
        requests = inbox.messages() if self.config.send_request_map else ()
        began = time.perf_counter()
        packets = agent.share(frame, budget_bytes, requests)
        return packets, time.perf_counter() - began

    def _get_agent_and_inbox(self, frame: AgentFrame) -> tuple[Agent, Inbox]:
        agent_id = frame.agent_id
        if agent_id not in self._agents:
            cache = PerceptionCache(self.detector, feature_cache=self.feature_cache)
            config = self.config
            strategy = get_strategy(self.method)
            self._agents[agent_id] = Agent(
                self.detector,
                strategy,
                config.token_encoding,
                config.budget_bytes,
                cache,
                config.pose_correction,
                config.send_request_map,
            )
            self._inboxes[agent_id] = self._agents[agent_id].inbox(EXPIRE_NS)
        return self._agents[agent_id], self._inboxes[agent_id]


def _antenna_positions(snapshot: Snapshot) -> dict[int, tuple[float, float]]:
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
    perturb: Callable[[Snapshot], Snapshot] = lambda snapshot: snapshot,
    feature_cache: CachedOutputs | None = None,
) -> Iterator[ReplayStep]:
    """Every judged snapshot of one scenario through each method in turn.

    perturb: what happens to claimed poses before anybody sees them. feature_cache: what agents of this scenario and these weights
    made of their sweeps, played from the same first snapshot on; it is added to, so that the methods look at a sweep once between
    them. Their boxes are the same; their times are then not to be compared.
    """
    replays = [DetectionReplay(name, detector, config, feature_cache) for name in methods]
    eval_indices = recording.eval_indices(scenario)
    for index in range(max(0, eval_indices.start - config.warmup_frames), eval_indices.stop):
        snapshot = perturb(recording.snapshot(scenario, index))
        for player in replays:
            for step in player.step(snapshot):
                if index in eval_indices:
                    yield step
