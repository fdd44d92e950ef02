# SPDX-License-Identifier: Apache-2.0
"""Replay of a recording with agents on a channel: share, encode, deliver, perceive."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.content_budget import BudgetedStrategy
from manyeyes.agents.exchange import Exchange
from manyeyes.agents.perception_cache import HISTORY_FRAMES, TRACK_FRAMES, AgentOutput, PerceptionCache
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.registry import FusionStrategy, get_strategy
from manyeyes.agents.trust.interface import MisbehaviourDetector
from manyeyes.comms.bandwidth import allocate_max_min_fair
from manyeyes.comms.channel import ChannelPreset, channel_preset
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.message_contents import MessageContents, count_contents
from manyeyes.comms.wire import SIGHT_PACKET_BYTES, TokenEncoding
from manyeyes.datasets.base import Recording, RecordingReader
from manyeyes.datatypes import AgentFrame, Boxes, Snapshot, Transform
from manyeyes.models.detector.protocols import BoxDetector

EXPIRE_NS = 500_000_000
WARMUP_FRAMES = TRACK_FRAMES + HISTORY_FRAMES
"""Number of snapshots after which all histories of agents and receivers are full."""

CachedOutputs = dict[tuple[int, int], AgentOutput]
"""Detector outputs by agent and timestamp."""


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of a replay.

    channel: name of a preset, or a preset. token_encoding: of tokens; None: the default of the weights. latency_budget_s: time
    between the ego's sweep and its perception; it fuses the newest message of each sender that has arrived by then. all_egos:
    evaluate every agent as ego, not only the first. warmup_frames: snapshots replayed before the first evaluated one, to fill
    histories. comm_range_m: maximum distance of sender and receiver (true poses). channel_budget_bytes: bytes of all agents at one
    instant, allocated by ``comms.bandwidth.allocate_max_min_fair`` from what each agent would send without a limit, as by a central
    scheduler. send_request_map: messages with tokens carry a request map, and received request maps weight the token scores.
    send_sight: messages carry the free space of their senders (``datatypes.sight``), by which trusted ones refute claims of others.
    pose_correction: of received messages; None uses their prior poses. misbehaviour: of all agents; None trusts every sender.
    limits_contents: budget_bytes limits boxes and points too (``agents.content_budget``), not tokens alone.
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
    send_sight: bool = False
    pose_correction: PoseCorrection | None = None
    misbehaviour: MisbehaviourDetector | None = None
    limits_contents: bool = False

    @property
    def radio(self) -> ChannelPreset:
        """The preset of the channel."""
        return self.channel if isinstance(self.channel, ChannelPreset) else channel_preset(self.channel)

    def adapt_to(self, recording: Recording) -> ReplayConfig:
        """Return the configuration with the range and the latency budget that the reader of a recording sets, if any."""
        if not isinstance(recording, RecordingReader):
            return self
        range_m, budget_s = recording.comm_range_m, recording.latency_budget_s
        return replace(
            self,
            comm_range_m=self.comm_range_m if range_m is None else range_m,
            latency_budget_s=self.latency_budget_s if budget_s is None else budget_s,
        )


@dataclass(frozen=True)
class SentPackets:
    """Packets that one agent sent at one instant. packet_sizes: bytes of each packet; seconds: duration of share; contents: of all
    packets together.
    """

    agent_id: int
    packet_sizes: tuple[int, ...]
    seconds: float
    contents: MessageContents = MessageContents()

    @property
    def num_bytes(self) -> int:
        """Bytes of all packets."""
        return sum(self.packet_sizes)

    @property
    def num_packets(self) -> int:
        """Number of sent packets."""
        return len(self.packet_sizes)


@dataclass(frozen=True)
class ReplayStep:
    """One ego at one instant with one method.

    ages_s: of every fused message at the time of perception. wait_s: from the ego's sweep to that time; 0 with a strategy
    that fuses no messages.
    """

    method: str
    snapshot: Snapshot
    ego: int
    perception: Perception
    sent: tuple[SentPackets, ...]
    ages_s: tuple[float, ...]
    perceive_seconds: float
    wait_s: float = 0.0

    @property
    def boxes(self) -> Boxes:
        """The boxes around the ego, in its frame."""
        return self.perception.boxes


@dataclass
class DetectionReplay:
    """All agents of one scenario with one method.

    feature_cache: detector outputs that are read and extended.
    """

    method: str
    detector: BoxDetector
    config: ReplayConfig
    feature_cache: CachedOutputs | None = None
    _agents: dict[int, Agent] = field(default_factory=dict)
    _exchange: Exchange = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        self._exchange = Exchange(config.radio, config.seed, self._make_inbox, config.comm_range_m)

    def step(self, snapshot: Snapshot) -> Iterator[ReplayStep]:
        """Let all agents share; the evaluated egos receive and perceive."""
        frames, latency_ns = snapshot.frames, round(self.config.latency_budget_s * 1e9)
        outgoing = self._share(frames)
        sent = tuple(
            SentPackets(frame.agent_id, tuple(map(len, packets)), took, count_contents(packets))
            for frame, (packets, took) in zip(frames, outgoing)
        )
        deadlines_ns = [frame.timestamp_ns + latency_ns for frame in frames]
        packets, positions = [own for own, _ in outgoing], _antenna_positions(snapshot)
        exchanged = self._exchange.run(frames, packets, deadlines_ns, positions)
        for ego, (frame, inbox, deadline_ns) in enumerate(exchanged):
            if ego and not self.config.all_egos:
                continue
            began = time.perf_counter()
            perception = self._agent(frame.agent_id).perceive(frame, inbox, deadline_ns)
            took = time.perf_counter() - began
            for rejection in perception.rejected:
                # All senders of a replay are agents of this program: an error is a defect of the code.
                if rejection.cause is not None:
                    raise rejection.cause
            ages = tuple(message.age_ns(deadline_ns) / 1e9 for message in perception.received)
            wait_s = self.config.latency_budget_s if self._agent(frame.agent_id).strategy.waits_for_messages else 0.0
            yield ReplayStep(self.method, snapshot, ego, perception, sent, ages, took, wait_s)

    def _share(self, frames: Sequence[AgentFrame]) -> list[tuple[list[bytes], float]]:
        """Compose the packets of all agents, within the budget of the channel; with the duration of share in seconds."""
        outgoing = [self._share_one(frame) for frame in frames]
        if self.config.channel_budget_bytes is None:
            return outgoing
        requested = [sum(map(len, packets)) for packets, _ in outgoing]
        shares = allocate_max_min_fair(self.config.channel_budget_bytes, requested)
        return [
            message if share == want else self._share_one(frame, share)
            for frame, message, want, share in zip(frames, outgoing, requested, shares)
        ]

    def _share_one(self, frame: AgentFrame, budget_bytes: int | None = None) -> tuple[list[bytes], float]:
        """Return packets of one agent, and the duration of share in seconds."""
        agent = self._agent(frame.agent_id)
        requests = self._exchange.inbox(frame.agent_id).messages() if self.config.send_request_map else ()
        began = time.perf_counter()
        packets = agent.share(frame, budget_bytes, requests)
        return packets, time.perf_counter() - began

    def _agent(self, agent_id: int) -> Agent:
        if agent_id not in self._agents:
            config = self.config
            self._agents[agent_id] = Agent(
                self.detector,
                self._make_strategy(),
                config.token_encoding,
                config.budget_bytes,
                PerceptionCache(self.detector, feature_cache=self.feature_cache),
                config.pose_correction,
                config.send_request_map,
                misbehaviour=config.misbehaviour,
                send_sight=config.send_sight,
            )
        return self._agents[agent_id]

    def _make_strategy(self) -> FusionStrategy:
        strategy, budget = get_strategy(self.method), self.config.budget_bytes
        if budget is None or not self.config.limits_contents:
            return strategy
        return BudgetedStrategy(strategy, budget - self.config.send_sight * SIGHT_PACKET_BYTES)

    def _make_inbox(self, agent_id: int) -> Inbox:
        return self._agent(agent_id).inbox(EXPIRE_NS)


def _antenna_positions(snapshot: Snapshot) -> dict[int, tuple[float, float]]:
    """Return true positions of the antennas, or prior positions in recordings without ground truth."""
    poses = (
        snapshot.truth.world_from_agent
        if snapshot.truth
        else Transform.stack([f.world_from_agent for f in snapshot.frames])
    )
    return {frame.agent_id: (xyz[0], xyz[1]) for frame, xyz in zip(snapshot.frames, poses.translation.tolist())}


def replay(
    recording: Recording,
    scenario: str,
    detector: BoxDetector,
    methods: Sequence[str],
    config: ReplayConfig,
    perturb: Callable[[Snapshot], Snapshot] = lambda snapshot: snapshot,
    feature_cache: CachedOutputs | None = None,
) -> Iterator[ReplayStep]:
    """Replay every evaluated snapshot of one scenario with each method in turn.

    perturb: applied to each snapshot before the agents read it. feature_cache: detector outputs of this scenario and these weights,
    from the same first snapshot on; it is extended, so that the detector runs once a sweep for all methods. Boxes do not change;
    durations of methods are then not comparable.
    """
    replays = [DetectionReplay(name, detector, config, feature_cache) for name in methods]
    eval_indices = recording.eval_indices(scenario)
    for index in range(max(0, eval_indices.start - config.warmup_frames), eval_indices.stop):
        snapshot = perturb(recording.snapshot(scenario, index))
        for player in replays:
            for step in player.step(snapshot):
                if index in eval_indices:
                    yield step
