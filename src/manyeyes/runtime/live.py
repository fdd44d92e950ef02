# SPDX-License-Identifier: Apache-2.0
"""The loop of one live agent: share, receive, perceive, by deadlines that count from the time of each frame.

```python
clock = LiveClock()
network = ZenohNetwork(ZenohConfig(connect=("tcp/10.0.0.5:7447",)), agent_id, clock.now_ns)
for tick in live(frames, Agent(load_detector()), network, clock):
    print(len(tick.perception.boxes.score), tick.latency_ns)
```
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from manyeyes.agents.agent import Agent, Perception
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.network.interface import Network
from manyeyes.comms.signatures.envelope import UNSIGNED
from manyeyes.datatypes import AgentFrame, ConfigError
from manyeyes.runtime.clock import Clock
from manyeyes.runtime.engine import Engine, digest_packets, digest_perception
from manyeyes.runtime.overload import OverloadLadder
from manyeyes.runtime.recorder import ClockStep, FrameEvent, Recorder, TickEvent
from manyeyes.runtime.security import Security, TrustWatcher
from manyeyes.runtime.signing import PacketSigner
from manyeyes.runtime.sources import NewestFrame

MS = 1_000_000
_POLL_NS = 5 * MS


@dataclass(frozen=True)
class LiveConfig:
    """Deadlines count from the time of the frame, the end of the sweep, nanoseconds.

    perceive_after_ns: an ego waits so long for messages of the same instant, unless all senders of its last frame are complete.
    deadline_ns: boxes that come later are counted as missed, and overload reduces the work (``runtime.overload``), unless ladder is
    False.
    """

    perceive_after_ns: int = 70 * MS
    deadline_ns: int = 100 * MS
    ladder: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.perceive_after_ns < self.deadline_ns:
            raise ConfigError(f"LiveConfig needs 0 < perceive_after_ns < deadline_ns; got {self}.")


@dataclass(frozen=True)
class LiveTick:
    """One frame of a live agent. Times are those of the clock, nanoseconds.

    sent_bytes, sent_packets: with signatures. ages_ns: of each fused message, when the boxes were there. latency_ns: from the time
    of the frame to the boxes. share_ns, wait_ns, perceive_ns: its parts, besides the delay of the source. missed: beyond the
    deadline. level: of overload. skipped: frames of the source that were skipped so far. dropped, overflows: received packets so
    far that were refused, or gave way before they were read. note: an event, such as a recording that stopped. received_packets,
    received_bytes: so far, refused ones too. unsynchronised: the clock stepped shortly before. clock_offset_ns: the median clock of
    others less the own one, by two-way queries, 0 without any.
    """

    frame: AgentFrame
    perception: Perception
    sent_bytes: int
    sent_packets: int
    ages_ns: tuple[int, ...]
    latency_ns: int
    share_ns: int
    wait_ns: int
    perceive_ns: int
    missed: bool
    level: int
    skipped: int
    dropped: DropCounts
    overflows: int
    note: str = ""
    received_packets: int = 0
    received_bytes: int = 0
    unsynchronised: bool = False
    clock_offset_ns: int = 0


class _Shared(NamedTuple):
    """A frame whose packets are sent, and when that began and ended."""

    frame: AgentFrame
    sent: list[bytes]
    level: int
    begin_ns: int
    shared_ns: int
    note: str


@dataclass
class _Loop:
    engine: Engine
    network: Network
    clock: Clock
    config: LiveConfig
    security: Security
    recorder: Recorder | None
    ladder: OverloadLadder = field(default_factory=OverloadLadder)
    signer: PacketSigner | None = None
    watcher: TrustWatcher | None = None
    fused: frozenset[int] = frozenset()
    known: frozenset[str] = frozenset()

    def share(self, frame: AgentFrame) -> _Shared:
        """Begin a frame: send its packets."""
        note, level = self._follow_clock(), self.ladder.level
        begin_ns = self.clock.now_ns()
        note = self._reload_trust(begin_ns) or note
        frame, sent = self._send(frame, level, begin_ns)
        return _Shared(frame, sent, level, begin_ns, self.clock.now_ns(), note)

    def perceive(self, shared: _Shared, skipped: int) -> LiveTick:
        """End a frame: receive, and perceive."""
        frame, sent, level, begin_ns, shared_ns, note = shared
        self._wait(frame)
        now_ns = self.clock.now_ns()
        perception = self.engine.perceive(frame, now_ns)
        done_ns = self.clock.now_ns()
        latency_ns = done_ns - frame.timestamp_ns
        missed = latency_ns > self.config.deadline_ns
        if self.config.ladder:
            self.ladder.update(missed)
        self.fused = frozenset(one.message.agent_id for one in perception.received)
        if self.recorder is not None:
            self.recorder.add(TickEvent(now_ns, digest_perception(perception)))
            note = self.recorder.flush() or note
        return LiveTick(
            frame,
            perception,
            sum(map(len, sent)),
            len(sent),
            tuple(done_ns - one.message.timestamp_ns for one in perception.received),
            latency_ns,
            shared_ns - begin_ns,
            now_ns - shared_ns,
            done_ns - now_ns,
            missed,
            level,
            skipped,
            self.engine.dropped,
            getattr(self.network, "overflows", 0),
            note,
            self.engine.received_packets,
            self.engine.received_bytes,
            self.engine.is_unsynchronised(now_ns),
            self._clock_offset_ns(),
        )

    def _send(self, frame: AgentFrame, level: int, now_ns: int) -> tuple[AgentFrame, list[bytes]]:
        """Send the packets of a frame; return it, under the pseudonym of its time, and what was sent."""
        pool, is_silent = self.security.pool, False
        if pool is not None:
            identity = pool.identity(now_ns)
            is_silent = identity is None
            if identity is not None and (self.signer is None or self.signer.identity is not identity):
                self.signer = PacketSigner(identity)
                rename = getattr(self.network, "rename", None)
                if rename is not None:
                    rename(identity.agent_id)
        if self.signer is not None:
            frame = replace(frame, agent_id=self.signer.identity.agent_id)
            if self.network.neighbours() - self.known:
                self.signer.request_certificate()
            self.known = self.network.neighbours()
        envelope = UNSIGNED if self.signer is None else self.signer.envelope(frame.timestamp_ns)
        packets = self.engine.share(frame, level, envelope)
        if self.recorder is not None:
            self.recorder.add(FrameEvent(frame, level, envelope, digest_packets(packets)))
        if is_silent or level >= 4:
            return frame, []
        sent = packets if self.signer is None else self.signer.sign(packets, frame.timestamp_ns)
        x, y, _ = frame.world_from_agent.translation.tolist()
        self.network.send(sent, (x, y))
        return frame, sent

    def _wait(self, frame: AgentFrame) -> None:
        """Receive until the time of perception, or until the senders of the last frame are complete."""
        until_ns = frame.timestamp_ns + self.config.perceive_after_ns
        since_ns = frame.timestamp_ns - self.config.perceive_after_ns // 2
        while True:
            for received in self.network.poll():
                if self.recorder is not None:
                    self.recorder.add(received)
                self.engine.push(received)
            left_ns = until_ns - self.clock.now_ns()
            is_complete = bool(self.fused) and self.fused <= self.engine.inbox.complete_senders(since_ns)
            if left_ns <= 0 or is_complete:
                return
            self.clock.sleep(min(left_ns, _POLL_NS))

    def _follow_clock(self) -> str:
        """Follow the system clock; after a step of it, begin anew."""
        step_ns = self.clock.discipline()
        if not step_ns:
            return ""
        now_ns = self.clock.now_ns()
        self.engine.step_clock(now_ns)
        self.fused = frozenset()
        if self.recorder is not None:
            self.recorder.add(ClockStep(now_ns, step_ns))
        return f"clock_step: {step_ns / 1e9:+.3f} s; nothing is fused for a second"

    def _clock_offset_ns(self) -> int:
        offsets = getattr(self.network, "clock_offsets", None)
        found = [] if offsets is None else sorted(one.offset_ns for one in offsets().values())
        return found[len(found) // 2] if found else 0

    def _reload_trust(self, now_ns: int) -> str:
        verifier = self.engine.verifier
        if self.watcher is None or verifier is None:
            return ""
        before = self.watcher.error
        trust = self.watcher.poll(now_ns)
        if trust is not None:
            verifier.replace_trust(trust)
            if self.recorder is not None:
                self.recorder.add(trust)
            return "the trust file was read again"
        error = self.watcher.error
        return f"the trust file cannot be used, the last one stays: {error}" if error and error != before else ""


class LiveRun:
    """A run of one agent; iterate over it once. :meth:`stop` ends it after the current frame."""

    def __init__(
        self,
        frames: Iterable[AgentFrame],
        agent: Agent,
        network: Network,
        clock: Clock,
        config: LiveConfig | None = None,
        security: Security | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        security = security or Security()
        engine = Engine(agent, security.make_verifier())
        self._loop = _Loop(engine, network, clock, config or LiveConfig(), security, recorder)
        if security.trust_file is not None and engine.verifier is not None:
            self._loop.watcher = TrustWatcher(security.trust_file)
            if recorder is not None:
                recorder.add(engine.verifier.trust)
        self.recorder = recorder
        self._source = NewestFrame(frames, clock)
        self._network = network

    def neighbours(self) -> frozenset[str]:
        """Return the links of the network from which something arrived lately."""
        return self._network.neighbours()

    def __iter__(self) -> Iterator[LiveTick]:
        try:
            for frame in self._source:
                yield self.step(frame)
        finally:
            self._source.stop()

    def step(self, frame: AgentFrame) -> LiveTick:
        """Work on one frame, outside of an iteration."""
        return self.perceive(self.share(frame))

    def share(self, frame: AgentFrame) -> _Shared:
        """Begin a frame, outside of an iteration: send its packets."""
        return self._loop.share(frame)

    def perceive(self, shared: _Shared) -> LiveTick:
        """End a frame that was begun: receive, and perceive."""
        return self._loop.perceive(shared, self._source.num_skipped)

    def stop(self) -> None:
        """End after the current frame; may be called from another thread or a signal handler."""
        self._source.stop()


def live(
    frames: Iterable[AgentFrame],
    agent: Agent,
    network: Network,
    clock: Clock,
    config: LiveConfig | None = None,
    security: Security | None = None,
) -> LiveRun:
    """Run an agent on a network; iterate over the result for its ticks.

    Args:
        frames: of the agent's sensors, as they come; of several that wait, the newest is used. Their times are those of the clock.
        agent: detector, strategy and byte budget.
        network: that of the agent; the caller closes it.
        clock: shared with the network.
        config: deadlines.
        security: keys and trust file; by default nothing is signed.
    """
    return LiveRun(frames, agent, network, clock, config, security)
