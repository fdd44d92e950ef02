# SPDX-License-Identifier: Apache-2.0
"""Recording of a live run as MCAP (https://mcap.dev): every event that its engine is a function of, in order.

| topic | content |
|---|---|
| `/config` | JSON: weights, strategy, budget, security, versions, threads |
| `/trust` | text of the trust file, at the start and when it was read again |
| `/rx` | i64 arrival, u16 and u16 lengths of link and tile, both, the packet |
| `/frame` | safetensors: cloud and poses; JSON in their metadata: level of overload, envelope, digest of the packets |
| `/tick` | JSON: time of perception, digest of the result |
| `/event` | JSON: a step of the agent's clock: its time after it, and by how much it stepped |

Keys are never recorded. Events of a frame are written after its boxes. A file is whole, or it does not exist under its name: where
the disk is full, what was recorded is lost, and the run goes on.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from safetensors import SafetensorError
from safetensors.torch import load, save

from manyeyes._io import atomic_replace
from manyeyes.comms.network.interface import Origin, ReceivedPacket
from manyeyes.comms.signatures.envelope import EnvelopeSize
from manyeyes.datatypes import AgentFrame, PointCloud, RecordingError, Transform
from manyeyes.datatypes.body import AgentBody
from manyeyes.datatypes.extras import import_extra
from manyeyes.runtime.trust_file import Trust

_RX = struct.Struct("<qHH")
_PURPOSE = "Recording a live run"
_ENCODINGS = {
    "/config": "json",
    "/trust": "toml",
    "/rx": "manyeyes",
    "/frame": "safetensors",
    "/tick": "json",
    "/event": "json",
}


@dataclass(frozen=True)
class RunConfig:
    """Settings that a replay needs to make the same agent. versions, num_threads: where it ran.

    utc_offset_ns: UTC less the time of stamps and arrivals.
    """

    weights: str
    fingerprint: str
    strategy: str
    budget_bytes: int | None
    pose_correction: str | None
    security: str
    versions: dict[str, str | None]
    num_threads: int
    misbehaviour: str | None = None
    send_sight: bool = False
    map_weights: str | None = None
    map_period_s: float = 1.0
    utc_offset_ns: int = 0


@dataclass(frozen=True)
class FrameEvent:
    """A frame that was shared. sent_digest: of its packets, before they were signed."""

    frame: AgentFrame
    level: int
    envelope: EnvelopeSize
    sent_digest: str


@dataclass(frozen=True)
class TickEvent:
    """A perception at a time, and the digest of its result."""

    now_ns: int
    digest: str


@dataclass(frozen=True)
class ClockStep:
    """The agent's clock stepped; now_ns: after the step."""

    now_ns: int
    step_ns: int


Event = RunConfig | Trust | ReceivedPacket | FrameEvent | TickEvent | ClockStep


class Recorder:
    """Writes events to a file. Events wait in memory until :meth:`flush`.

    Raises:
        MissingExtraError: mcap is not installed.
    """

    def __init__(self, path: Path, config: RunConfig) -> None:
        writer = import_extra("mcap.writer", "live", _PURPOSE)
        self.path, self._pending, self._num = path, list[Event](), 0
        self._files = ExitStack()
        temporary = self._files.enter_context(atomic_replace(path))
        self._stream: IO[bytes] | None = self._files.enter_context(temporary.open("wb"))
        self._writer: Any = writer.Writer(self._stream, compression=writer.CompressionType.ZSTD)
        self._writer.start(profile="", library="manyeyes")
        self._channels = {
            topic: self._writer.register_channel(topic=topic, message_encoding=encoding, schema_id=0)
            for topic, encoding in _ENCODINGS.items()
        }
        self.add(config)

    def add(self, event: Event) -> None:
        """Record an event; its place among the others is its order in a replay."""
        if self._stream is not None:
            self._pending.append(event)

    def flush(self) -> str:
        """Write what waits; return why recording stopped, if it did just now."""
        pending, self._pending = self._pending, []
        if self._stream is None:
            return ""
        try:
            for event in pending:
                topic, data = _pack_event(event)
                self._num += 1
                self._writer.add_message(self._channels[topic], self._num, data, self._num, self._num)
            self._stream.flush()
        except OSError as error:
            return self._abandon(error)
        return ""

    def close(self) -> str:
        """Finish the file; return why it could not be written, or nothing."""
        reason = self.flush()
        if self._stream is None:
            return reason
        try:
            self._writer.finish()
            self._stream = None
            self._files.close()
        except OSError as error:
            return self._abandon(error)
        return ""

    def _abandon(self, error: OSError) -> str:
        """Stop recording and remove the file."""
        self._stream = None
        try:
            self._files.__exit__(type(error), error, error.__traceback__)
        except OSError as named:
            error = named
        return f"recording stopped: {error}"


def read_events(path: Path) -> Iterator[Event]:
    """Yield the events of a recording in their order.

    Raises:
        RecordingError: the file is no recording of a live run, or is damaged.
    """
    reader = import_extra("mcap.reader", "live", _PURPOSE)
    with path.open("rb") as stream, _name_damage(path):
        messages = reader.make_reader(stream, validate_crcs=True).iter_messages(log_time_order=True)
        for _, channel, message in messages:
            yield _read_event(channel.topic, message.data)


@contextmanager
def _name_damage(path: Path) -> Iterator[None]:
    """Raise RecordingError for what the reader raises on a file that is damaged, cut, or another one."""
    errors = import_extra("mcap.exceptions", "live", _PURPOSE)
    try:
        yield
    except (errors.McapError, OSError, ValueError, KeyError, TypeError, struct.error, SafetensorError) as error:
        raise RecordingError(f"{path}: no whole recording of a live run ({error}); record it again.") from error


def count_ticks(path: Path) -> int | None:
    """Return the number of perceptions of a recording, as its summary states it; None without one.

    Raises:
        RecordingError: the file is no recording of a live run, or is damaged.
    """
    reader = import_extra("mcap.reader", "live", _PURPOSE)
    with path.open("rb") as stream, _name_damage(path):
        summary = reader.make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        return None
    topics = {key: channel.topic for key, channel in summary.channels.items()}
    counts = summary.statistics.channel_message_counts
    return sum(count for key, count in counts.items() if topics.get(key) == "/tick")


def _pack_event(event: Event) -> tuple[str, bytes]:
    if isinstance(event, RunConfig):
        return "/config", json.dumps(asdict(event)).encode()
    if isinstance(event, Trust):
        return "/trust", event.to_toml().encode()
    if isinstance(event, ReceivedPacket):
        link, tile = event.origin.link.encode(), event.origin.tile.encode()
        return "/rx", _RX.pack(event.arrival_ns, len(link), len(tile)) + link + tile + event.packet
    if isinstance(event, FrameEvent):
        return "/frame", _pack_frame(event)
    return "/event" if isinstance(event, ClockStep) else "/tick", json.dumps(asdict(event)).encode()


def _read_event(topic: str, data: bytes) -> Event:
    if topic == "/config":
        return RunConfig(**json.loads(data))
    if topic == "/trust":
        return Trust.parse(data.decode())
    if topic == "/rx":
        arrival_ns, link, tile = _RX.unpack_from(data)
        begin, middle, end = _RX.size, _RX.size + link, _RX.size + link + tile
        return ReceivedPacket(data[end:], arrival_ns, Origin(data[begin:middle].decode(), data[middle:end].decode()))
    if topic == "/frame":
        return _read_frame(data)
    if topic == "/tick":
        return TickEvent(**json.loads(data))
    if topic == "/event":
        return ClockStep(**json.loads(data))
    raise ValueError(f"unknown topic {topic}")


def _pack_frame(event: FrameEvent) -> bytes:
    frame = event.frame
    tensors = {
        "xyz": frame.points.xyz,
        "intensity": frame.points.intensity,
        "time_s": frame.points.time_s,
        "rotation": frame.world_from_agent.rotation,
        "translation": frame.world_from_agent.translation,
        "pose_covariance": frame.pose_covariance,
    }
    if frame.odometry is not None:
        tensors |= {
            "odometry_rotation": frame.odometry.rotation,
            "odometry_translation": frame.odometry.translation,
        }
    values = {
        "agent_id": frame.agent_id,
        "timestamp_ns": frame.timestamp_ns,
        "sensor_height_m": frame.sensor_height_m,
        "speed_mps": frame.speed_mps,
        "is_infrastructure": frame.is_infrastructure,
        "body": None if frame.body is None else asdict(frame.body),
        "level": event.level,
        "envelope": asdict(event.envelope),
        "sent_digest": event.sent_digest,
    }
    contiguous = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    return save(contiguous, {"event": json.dumps(values)})


def _read_frame(data: bytes) -> FrameEvent:
    (length,) = struct.unpack_from("<Q", data)
    values = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["event"])
    tensors, body = load(data), values["body"]
    odometry = None
    if "odometry_rotation" in tensors:
        odometry = Transform(tensors["odometry_rotation"], tensors["odometry_translation"])
    if body is not None:
        body = AgentBody(tuple(body["center"]), tuple(body["size"]), body["yaw_rad"])
    frame = AgentFrame(
        values["agent_id"],
        values["timestamp_ns"],
        PointCloud(tensors["xyz"], tensors["intensity"], tensors["time_s"]),
        Transform(tensors["rotation"], tensors["translation"]),
        tensors["pose_covariance"],
        values["sensor_height_m"],
        values["speed_mps"],
        is_infrastructure=values["is_infrastructure"],
        odometry=odometry,
        body=body,
    )
    return FrameEvent(frame, values["level"], EnvelopeSize(**values["envelope"]), values["sent_digest"])
