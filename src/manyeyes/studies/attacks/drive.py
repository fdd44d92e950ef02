# SPDX-License-Identifier: Apache-2.0
"""One scenario under attack: agents share over the channel, malicious ones alter their messages, and the ego perceives.

As ``agents.replay`` but for the malicious agents: without any, all packets and boxes are the same, bit for bit. Honest agents share
first, since a white box knows their messages of the same instant.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import partial

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.exchange import Exchange
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.replay import EXPIRE_NS, CachedOutputs, ReplayConfig, ReplayStep, SentPackets
from manyeyes.agents.strategies.intermediate import gather_tokens
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.token_codec import decode_tokens
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, Message, Snapshot, Transform
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.ops.lidar.free_range import measure_sight
from manyeyes.studies.attacks.interface import (
    AlterMessage,
    Attack,
    AttackInput,
    AttackKey,
    AttackOutput,
    FalseClaims,
    Victim,
)
from manyeyes.studies.attacks.malicious_strategy import MaliciousStrategy
from manyeyes.studies.attacks.roles import Roles

SPACING_M = 0.5
"""Distance between the stated positions of the pseudonyms of one agent."""


@dataclass(frozen=True)
class DriveSetting:
    """What one drive is played with. attack: None is none. colluding: malicious agents share one random key.

    drops_malicious: messages of malicious agents never reach the ego, as of an oracle.
    """

    method: str
    replay: ReplayConfig
    roles: Roles
    attack: Attack | None = None
    colluding: bool = False
    drops_malicious: bool = False

    @property
    def num_pseudonyms(self) -> int:
        """Further identities of each malicious agent."""
        return 0 if self.attack is None else self.attack.num_pseudonyms


@dataclass(frozen=True)
class DriveStep:
    """One instant. claims: the false claims of each malicious identity."""

    step: ReplayStep
    claims: dict[int, FalseClaims]


@dataclass
class AttackedDrive:
    """The agents of one scenario. feature_cache: detector outputs by agent and time, which are read and extended."""

    scenario: str
    detector: BoxDetector
    setting: DriveSetting
    feature_cache: CachedOutputs
    _agents: dict[int, Agent] = field(default_factory=dict)
    _running: dict[int, AlterMessage] = field(default_factory=dict)
    _exchange: Exchange = field(init=False)
    _instant: int = field(default=-1, init=False)
    _snapshot: Snapshot = field(init=False)
    _honest_packets: dict[int, list[bytes]] = field(default_factory=dict)
    _last_perception: Perception | None = None

    def __post_init__(self) -> None:
        replay = self.setting.replay
        self._exchange = Exchange(replay.radio, replay.seed, self._make_inbox, replay.comm_range_m)

    def play(self, snapshot: Snapshot, is_attacked: bool) -> DriveStep:
        """Let all agents share, and the ego perceive."""
        setting, roles = self.setting, self.setting.roles
        self._snapshot, self._instant = snapshot, self._instant + 1 if is_attacked else -1
        frames = {frame.agent_id: frame for frame in snapshot.frames}
        attackers = self._add_pseudonyms(frames)
        self._honest_packets, claims = {}, dict[int, FalseClaims]()
        sent: dict[int, SentPackets] = {}
        positions = _find_antennas(snapshot)
        for name in attackers - positions.keys():
            positions[name] = positions[self._owner(name)]
        outgoing: dict[int, list[bytes]] = {}
        for agent_id, frame in sorted(frames.items(), key=lambda item: item[0] in attackers):
            packets, took = self._share(frame)
            outgoing[agent_id], sent[agent_id] = packets, SentPackets(agent_id, tuple(map(len, packets)), took)
            if agent_id in attackers:
                claims[agent_id] = self._claims_of(agent_id)
            else:
                self._honest_packets[agent_id] = packets
        for agent_id, frame in frames.items():
            is_dropped = setting.drops_malicious and agent_id in attackers
            self._exchange.send(frame, [] if is_dropped else outgoing[agent_id], positions)
        latency_ns = round(setting.replay.latency_budget_s * 1e9)
        for agent_id in attackers & frames.keys():
            self._exchange.receive(agent_id, frames[agent_id].timestamp_ns + latency_ns, positions)
        ego = frames[roles.ego]
        step = self._perceive(ego, ego.timestamp_ns + latency_ns, tuple(sent.values()), positions)
        return DriveStep(step, claims)

    def _add_pseudonyms(self, frames: dict[int, AgentFrame]) -> frozenset[int]:
        """Add the frames of pseudonyms, who state positions of their own; return all malicious identities."""
        count = self.setting.num_pseudonyms if self._instant >= 0 else 0
        for agent_id in self.setting.roles.malicious:
            for place, name in enumerate(self.setting.roles.pseudonyms(agent_id, count), 1):
                real = frames[agent_id]
                shift = Transform.from_xyz_yaw(0.0, place * SPACING_M)
                frames[name] = replace(real, agent_id=name, world_from_agent=real.world_from_agent @ shift, body=None)
                source = self.feature_cache.get((agent_id, real.timestamp_ns))
                if source is not None:
                    self.feature_cache[name, real.timestamp_ns] = source
        return self.setting.roles.identities(count)

    def _share(self, frame: AgentFrame) -> tuple[list[bytes], float]:
        agent, config = self._agent(frame.agent_id), self.setting.replay
        requests = self._exchange.inbox(frame.agent_id).messages() if config.send_request_map else ()
        began = time.perf_counter()
        packets = agent.share(frame, None, requests)
        return packets, time.perf_counter() - began

    def _perceive(
        self,
        frame: AgentFrame,
        deadline_ns: int,
        sent: tuple[SentPackets, ...],
        positions: dict[int, tuple[float, float]],
    ) -> ReplayStep:
        agent, inbox = self._agent(frame.agent_id), self._exchange.receive(frame.agent_id, deadline_ns, positions)
        began = time.perf_counter()
        perception = agent.perceive(frame, inbox, deadline_ns)
        took, self._last_perception = time.perf_counter() - began, perception
        malicious = self.setting.roles.identities(self.setting.num_pseudonyms)
        for rejection in perception.rejected:
            # Honest content never raises an error.
            if rejection.cause is not None and rejection.agent_id not in malicious:
                raise rejection.cause
        ages = tuple(message.age_ns(deadline_ns) / 1e9 for message in perception.received)
        row = [f.agent_id for f in self._snapshot.frames].index(frame.agent_id)
        wait_s = self.setting.replay.latency_budget_s if agent.strategy.waits_for_messages else 0.0
        return ReplayStep(self.setting.method, self._snapshot, row, perception, sent, ages, took, wait_s)

    def _agent(self, agent_id: int) -> Agent:
        if agent_id not in self._agents:
            config, strategy = self.setting.replay, get_strategy(self.setting.method)
            if self.setting.attack is not None and agent_id in self.setting.roles.identities(
                self.setting.num_pseudonyms
            ):
                strategy = MaliciousStrategy(strategy, partial(self._alter, agent_id))
            cache = PerceptionCache(self.detector, feature_cache=self.feature_cache)
            self._agents[agent_id] = Agent(
                self.detector,
                strategy,
                config.token_encoding,
                config.budget_bytes,
                cache,
                config.pose_correction,
                config.send_request_map,
                # Only the ego perceives, and only it defends itself.
                misbehaviour=config.misbehaviour if agent_id == self.setting.roles.ego else None,
                send_sight=config.send_sight,
            )
        return self._agents[agent_id]

    def _make_inbox(self, agent_id: int) -> Inbox:
        return self._agent(agent_id).inbox(EXPIRE_NS)

    def _claims_of(self, agent_id: int) -> FalseClaims:
        strategy = self._agent(agent_id).strategy
        return strategy.claims if isinstance(strategy, MaliciousStrategy) else FalseClaims()

    def _alter(self, agent_id: int, cache: PerceptionCache, frame: AgentFrame, message: Message) -> AttackOutput:
        """Run the attack of one malicious identity; the honest message before the attack begins."""
        attack, roles = self.setting.attack, self.setting.roles
        if self.setting.replay.send_sight:
            message = replace(message, sight=measure_sight(frame.points.xyz, frame.sensor_height_m))
        if attack is None or self._instant < 0:
            return AttackOutput(message)
        if agent_id not in self._running:
            # Colluding agents and the pseudonyms of one agent draw the same places.
            owner = agent_id if agent_id in roles.malicious else self._owner(agent_id)
            group = 0 if self.setting.colluding else owner
            self._running[agent_id] = attack.begin(AttackKey(self.setting.replay.seed, self.scenario, group))
        knows_weights = attack.knowledge != "black-box"
        given = AttackInput(
            frame,
            message,
            self._received_by(agent_id),
            self._agent(roles.ego).perception_cache.level(self._frame_of(roles.ego)).levelled.world_from_agent,
            self._instant,
            partial(gather_tokens, cache, frame) if knows_weights else None,
            self.detector if knows_weights else None,
            self._make_victim(agent_id) if attack.knowledge == "white-box" else None,
        )
        return self._running[agent_id](given)

    def _owner(self, pseudonym: int) -> int:
        roles, count = self.setting.roles, self.setting.num_pseudonyms
        return next(agent for agent in roles.malicious if pseudonym in roles.pseudonyms(agent, count))

    def _frame_of(self, agent_id: int) -> AgentFrame:
        return next(frame for frame in self._snapshot.frames if frame.agent_id == agent_id)

    def _received_by(self, agent_id: int) -> tuple[Message, ...]:
        messages = self._decode(self._exchange.inbox(agent_id))
        return tuple(message for message in messages if message.agent_id != agent_id)

    def _decode(self, inbox: Inbox) -> tuple[Message, ...]:
        """Return the messages of an inbox with tokens as floats."""
        token_format = self._agent(self.setting.roles.ego).token_format
        received = inbox.received_messages()
        return tuple(decode_tokens(reception, self.detector, token_format)[0].message for reception in received)

    def _make_victim(self, agent_id: int) -> Victim:
        ego = self._agent(self.setting.roles.ego)
        frame = ego.perception_cache.level(self._frame_of(self.setting.roles.ego)).levelled
        inbox = ego.inbox()
        for packets in self._honest_packets.values():
            for packet in packets:
                inbox.push(packet)
        messages = self._decode(inbox)
        others = tuple(message for message in messages if message.agent_id != frame.agent_id)
        own = next((message for message in messages if message.agent_id == frame.agent_id), None)
        own = own or Message(frame.agent_id, frame.timestamp_ns, frame.world_from_agent, frame.pose_covariance)
        return Victim(
            frame, own, others, partial(gather_tokens, ego.perception_cache, frame), self._log_weight(agent_id)
        )

    def _log_weight(self, agent_id: int) -> float:
        """Return the logarithm of the weight that the ego last gave the content of a sender."""
        last = self._last_perception
        weights = {} if last is None or last.assessment is None else last.assessment.weights
        weight = weights.get(agent_id, 1.0)
        return math.log(weight) if weight > 0 else -math.inf


def _find_antennas(snapshot: Snapshot) -> dict[int, tuple[float, float]]:
    """Return the antenna of each agent: its true position, or the prior one without truth."""
    poses = (
        snapshot.truth.world_from_agent
        if snapshot.truth
        else Transform.stack([f.world_from_agent for f in snapshot.frames])
    )
    return {frame.agent_id: (xyz[0], xyz[1]) for frame, xyz in zip(snapshot.frames, poses.translation.tolist())}
