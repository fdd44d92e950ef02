# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded live run: the same events, hence the same packets and boxes, bit for bit on the same build and machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from manyeyes.agents.agent import Agent, Perception
from manyeyes.comms.network.interface import ReceivedPacket
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.signatures.envelope import is_signed, split_signed
from manyeyes.comms.wire import open_packet
from manyeyes.datatypes import AgentFrame, RecordingError, Transform
from manyeyes.runtime.authentication import PacketVerifier
from manyeyes.runtime.engine import Engine, digest_packets, digest_perception
from manyeyes.runtime.recorder import ClockStep, FrameEvent, RunConfig, TickEvent, read_events
from manyeyes.runtime.trust_file import Trust


@dataclass(frozen=True)
class ReplayedTick:
    """One frame of a replay. same_packets, same_result: as recorded, bit for bit.

    now_ns: time of perception. level: of overload. received_bytes: that came since the last frame, by the agent id that packets
    state. stated_poses: the poses in the newest messages, by agent id, before any correction.
    """

    frame: AgentFrame
    perception: Perception
    same_packets: bool
    same_result: bool
    now_ns: int = 0
    level: int = 0
    received_bytes: Mapping[int, int] = field(default_factory=dict)
    stated_poses: Mapping[int, Transform] = field(default_factory=dict)


def read_config(path: Path) -> RunConfig:
    """Return the settings of a recorded run.

    Raises:
        RecordingError: the file is no recording of a live run.
    """
    for event in read_events(path):
        if isinstance(event, RunConfig):
            return event
        break
    raise RecordingError(f"{path}: a recording of a live run begins with its configuration; this one does not.")


def replay_run(
    path: Path,
    make_agent: Callable[[RunConfig], Agent],
    change: Callable[[RunConfig], RunConfig] = lambda config: config,
) -> Iterator[ReplayedTick]:
    """Yield the ticks of a recorded run, computed again.

    Args:
        path: a recording of ``runtime.recorder``.
        make_agent: makes the agent of its settings.
        change: returns other settings than those of the run (``runtime.what_if``): what would have been perceived then.

    Raises:
        RecordingError: the file is no whole recording of a live run.
    """
    config = change(read_config(path))
    engine = Engine(make_agent(config))
    frame: FrameEvent | None = None
    same_packets, num_bytes = True, Counter[int]()
    for event in read_events(path):
        if isinstance(event, Trust) and config.security != "off":
            if engine.verifier is None:
                mode = "require" if config.security == "require" else "warn"
                engine = Engine(engine.agent, PacketVerifier(event, mode, utc_offset_ns=config.utc_offset_ns))
            else:
                engine.verifier.replace_trust(event)
        elif isinstance(event, ReceivedPacket):
            engine.push(event)
            num_bytes[_stated_agent(event.packet)] += len(event.packet)
        elif isinstance(event, ClockStep):
            engine.step_clock(event.now_ns)
        elif isinstance(event, FrameEvent):
            frame = event
            packets = engine.share(event.frame, event.level, event.envelope)
            same_packets = digest_packets(packets) == event.sent_digest
        elif isinstance(event, TickEvent) and frame is not None:
            poses = {one.agent_id: one.world_from_agent for one in engine.inbox.peek()}
            perception = engine.perceive(frame.frame, event.now_ns)
            yield ReplayedTick(
                frame.frame,
                perception,
                same_packets,
                digest_perception(perception) == event.digest,
                event.now_ns,
                frame.level,
                dict(num_bytes),
                poses,
            )
            num_bytes.clear()


def _stated_agent(packet: bytes) -> int:
    """Return the agent id in the header of a packet; 0 where it is none."""
    try:
        return open_packet(split_signed(packet).packet if is_signed(packet) else packet).header.agent_id
    except PacketError:
        return 0
