# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded live run: the same events, hence the same packets and boxes, bit for bit on the same build and machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from manyeyes.agents.agent import Agent, Perception
from manyeyes.comms.network.interface import ReceivedPacket
from manyeyes.datatypes import AgentFrame, RecordingError
from manyeyes.runtime.authentication import PacketVerifier, SecurityMode
from manyeyes.runtime.engine import Engine, digest_packets, digest_perception
from manyeyes.runtime.recorder import ClockStep, FrameEvent, RunConfig, TickEvent, read_events
from manyeyes.runtime.trust_file import Trust


@dataclass(frozen=True)
class ReplayedTick:
    """One frame of a replay. same_packets, same_result: as recorded, bit for bit."""

    frame: AgentFrame
    perception: Perception
    same_packets: bool
    same_result: bool


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
    path: Path, make_agent: Callable[[RunConfig], Agent], security: SecurityMode | None = None
) -> Iterator[ReplayedTick]:
    """Yield the ticks of a recorded run, computed again.

    Args:
        path: a recording of ``runtime.recorder``.
        make_agent: makes the agent of its settings.
        security: another mode than that of the run: what would have been perceived then.

    Raises:
        RecordingError: the file is no whole recording of a live run.
    """
    config = read_config(path)
    config = config if security is None else replace(config, security=security)
    engine = Engine(make_agent(config))
    frame: FrameEvent | None = None
    same_packets = True
    for event in read_events(path):
        if isinstance(event, Trust) and config.security != "off":
            if engine.verifier is None:
                mode = "require" if config.security == "require" else "warn"
                engine = Engine(engine.agent, PacketVerifier(event, mode, utc_offset_ns=config.utc_offset_ns))
            else:
                engine.verifier.replace_trust(event)
        elif isinstance(event, ReceivedPacket):
            engine.push(event)
        elif isinstance(event, ClockStep):
            engine.step_clock(event.now_ns)
        elif isinstance(event, FrameEvent):
            frame = event
            packets = engine.share(event.frame, event.level, event.envelope)
            same_packets = digest_packets(packets) == event.sent_digest
        elif isinstance(event, TickEvent) and frame is not None:
            perception = engine.perceive(frame.frame, event.now_ns)
            yield ReplayedTick(frame.frame, perception, same_packets, digest_perception(perception) == event.digest)
