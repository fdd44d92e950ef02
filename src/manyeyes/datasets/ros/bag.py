# SPDX-License-Identifier: Apache-2.0
"""What a bag holds of its agents: the time of every sweep, and a pose at any time; and one cloud when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.datasets.formats.pcd import PcdCloud
from manyeyes.datasets.lidar_frame import rotation_of_quaternion
from manyeyes.datasets.ros.messages import CLOUD_TYPE, POSE_TYPES, TF_TYPES, StampedPose, cloud_of, poses_of, read_stamp
from manyeyes.datasets.ros.settings import AgentTopics, RosSettings
from manyeyes.datatypes import RecordingError, Transform
from manyeyes.datatypes.extras import import_extra

_MAX_CHAIN = 32
_REMEDY = "record the bag again, or reindex it"


@dataclass(frozen=True)
class Track:
    """Poses in the order of time: timestamp_ns (N,), place (N, 3) metres, quaternion (N, 4) w, x, y, z, unit length."""

    timestamp_ns: np.ndarray
    place: np.ndarray
    quaternion: np.ndarray

    @classmethod
    def of(cls, poses: Sequence[StampedPose]) -> Track:
        """Build a track; of several poses of one time the last is kept."""
        by_time = {pose.timestamp_ns: pose for pose in poses}
        ordered = [by_time[time] for time in sorted(by_time)]
        turn = np.array([pose.quaternion for pose in ordered]).reshape(-1, 4)
        return cls(
            np.array([pose.timestamp_ns for pose in ordered], np.int64),
            np.array([pose.place for pose in ordered]).reshape(-1, 3),
            turn / np.linalg.norm(turn, axis=1, keepdims=True),
        )

    def at(self, timestamp_ns: int, max_gap_ns: int) -> Transform | None:
        """Return the pose at a time, float64, between the two around it; None where they are farther apart than max_gap_ns.

        Before the first and after the last pose, one within half of max_gap_ns holds. A track of one pose, such as a static
        transform, holds at all times.
        """
        after = int(np.searchsorted(self.timestamp_ns, timestamp_ns))
        if len(self.timestamp_ns) == 1:
            return self._pose(0)
        if after < len(self.timestamp_ns) and self.timestamp_ns[after] == timestamp_ns:
            return self._pose(after)
        if after in (0, len(self.timestamp_ns)):
            nearest = min(after, len(self.timestamp_ns) - 1)
            return (
                self._pose(nearest) if abs(int(self.timestamp_ns[nearest]) - timestamp_ns) <= max_gap_ns // 2 else None
            )
        first, last = int(self.timestamp_ns[after - 1]), int(self.timestamp_ns[after])
        return self._between(after, (timestamp_ns - first) / (last - first)) if last - first <= max_gap_ns else None

    def _pose(self, row: int) -> Transform:
        return _motion(self.place[row], self.quaternion[row])

    def _between(self, after: int, fraction: float) -> Transform:
        """Interpolate places linearly and rotations on the great circle (slerp)."""
        one, other = self.quaternion[after - 1], self.quaternion[after]
        cosine = float(one @ other)
        other, cosine = (-other, -cosine) if cosine < 0 else (other, cosine)
        angle = np.arccos(min(cosine, 1.0))
        if angle < 1e-6:
            turn = (1 - fraction) * one + fraction * other
        else:
            turn = (np.sin((1 - fraction) * angle) * one + np.sin(fraction * angle) * other) / np.sin(angle)
        return _motion((1 - fraction) * self.place[after - 1] + fraction * self.place[after], turn)


@dataclass(frozen=True)
class Sweeps:
    """The sweeps of one agent whose pose is known, in the order of time, (N,): stamps of headers, and times in the bag."""

    timestamp_ns: np.ndarray
    logged_ns: np.ndarray


@dataclass(frozen=True)
class BagIndex:
    """Sweeps of each agent, and the tracks that lead from the world's frame to its LiDAR's, outermost first."""

    sweeps: tuple[Sweeps, ...]
    chains: tuple[tuple[Track, ...], ...]

    def world_from_body(self, agent: int, timestamp_ns: int, max_gap_ns: int) -> Transform | None:
        """Return the pose of an agent, by its row; None where it is not known."""
        return _compose(self.chains[agent], timestamp_ns, max_gap_ns)


def read_index(settings: RosSettings) -> BagIndex:
    """Read all poses, and the headers of all sweeps; those without a pose are left out.

    Raises:
        RecordingError: a topic is absent or of another type, frames are not joined, or a message is damaged.
    """
    with open_bags(settings) as reader:
        stamps = [_stamps(settings, reader, agent) for agent in settings.agents]
        chains = tuple(_chain(settings, reader, agent) for agent in settings.agents)
    sweeps = []
    for found, chain in zip(stamps, chains):
        has_pose = [_compose(chain, stamp, settings.max_pose_gap_ns) is not None for stamp, _ in found]
        kept = np.array([pair for pair, known in zip(found, has_pose) if known], np.int64).reshape(-1, 2)
        sweeps.append(Sweeps(kept[:, 0], kept[:, 1]))
    return BagIndex(tuple(sweeps), chains)


def read_sweep(settings: RosSettings, agent: AgentTopics, timestamp_ns: int, logged_ns: int) -> PcdCloud:
    """Read the cloud of a sweep by its two times."""
    with open_bags(settings) as reader:
        for connection, _, data in reader.messages(
            _connections(settings, reader, agent.points), logged_ns, logged_ns + 1
        ):
            if read_stamp(data, reader.is2) == timestamp_ns:
                with _named(settings, agent.points):
                    return cloud_of(reader.deserialize(data, connection.msgtype), agent.intensity_max)
    raise RecordingError(
        f"{settings.path}: no cloud of the time {timestamp_ns} in {agent.points}; open the recording again."
    )


@contextmanager
def open_bags(settings: RosSettings) -> Iterator[Any]:
    """Open the bags of a recording; those without definitions of messages are read as ROS 2 Humble or ROS 1 Noetic wrote them."""
    highlevel = import_extra("rosbags.highlevel", "ros", "Reading ROS bags")
    typesys = import_extra("rosbags.typesys", "ros", "Reading ROS bags")
    is_ros1 = all(bag.suffix == ".bag" for bag in settings.bags)
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE)
    with _named(settings, ", ".join(bag.name for bag in settings.bags)):
        reader = highlevel.AnyReader(list(settings.bags), default_typestore=store)
        reader.open()
    try:
        yield reader
    finally:
        reader.close()


@contextmanager
def _named(settings: RosSettings, what: str) -> Iterator[None]:
    """Turn the errors of rosbags, which are many, into one that names the file and the topic."""
    try:
        yield
    except (RecordingError, ImportError):
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise RecordingError(f"{settings.path}: {what} cannot be read ({reason}); {_REMEDY}.") from None


def _connections(settings: RosSettings, reader: Any, topic: str) -> list[Any]:
    found = [connection for connection in reader.connections if connection.topic == topic]
    if not found:
        known = ", ".join(sorted({f"{c.topic} ({c.msgtype.split('/')[-1]})" for c in reader.connections}))[:600]
        raise RecordingError(
            f"{settings.path}: no topic {topic} in the bag, which has {known or 'none'}; choose one of them."
        )
    return found


def _require_type(settings: RosSettings, connections: list[Any], types: Sequence[str]) -> None:
    for connection in connections:
        if connection.msgtype not in types:
            names = ", ".join(name.split("/")[-1] for name in types)
            raise RecordingError(
                f"{settings.path}: topic {connection.topic} is of the type {connection.msgtype}, expected {names}; choose another."
            )


def _stamps(settings: RosSettings, reader: Any, agent: AgentTopics) -> list[tuple[int, int]]:
    """Return (stamp of the header, time in the bag) of the sweeps of an agent, in the order of stamps, each once."""
    connections = _connections(settings, reader, agent.points)
    _require_type(settings, connections, (CLOUD_TYPE,))
    with _named(settings, agent.points):
        found = {read_stamp(data, reader.is2): logged for _, logged, data in reader.messages(connections)}
    return sorted(found.items())


def _chain(settings: RosSettings, reader: Any, agent: AgentTopics) -> tuple[Track, ...]:
    """Return the tracks from the world to the frame of the agent's poses."""
    if agent.pose is not None:
        connections = _connections(settings, reader, agent.pose)
        _require_type(settings, connections, (*POSE_TYPES, *TF_TYPES))
        poses = _read_poses(settings, reader, connections)
        if not poses:
            raise RecordingError(f"{settings.path}: no message in {agent.pose}; choose another topic.")
        return (Track.of(poses),)
    assert agent.tf is not None
    world, child = (name.lstrip("/") for name in agent.tf)
    connections = [c for c in reader.connections if c.topic in ("/tf", "/tf_static")]
    _require_type(settings, connections, TF_TYPES)
    by_child: dict[str, list[StampedPose]] = {}
    for pose in _read_poses(settings, reader, connections):
        by_child.setdefault(pose.child, []).append(pose)
    chain: list[Track] = []
    frame = child
    while frame != world:
        if frame not in by_child or len(chain) >= _MAX_CHAIN:
            known = ", ".join(sorted({p.parent for poses in by_child.values() for p in poses} | set(by_child)))[:300]
            raise RecordingError(
                f"{settings.path}: /tf does not lead from '{world}' to '{child}': '{frame}' has no parent there; it has "
                f"{known or 'none'}: choose two frames that are joined."
            )
        chain.append(Track.of(by_child[frame]))
        frame = by_child[frame][-1].parent
    return tuple(reversed(chain))


def _read_poses(settings: RosSettings, reader: Any, connections: list[Any]) -> list[StampedPose]:
    poses: list[StampedPose] = []
    if connections:
        with _named(settings, connections[0].topic):
            for connection, _, data in reader.messages(connections):
                poses += poses_of(reader.deserialize(data, connection.msgtype))
    return poses


def _compose(chain: Sequence[Track], timestamp_ns: int, max_gap_ns: int) -> Transform | None:
    pose = Transform.identity()
    for track in chain:
        step = track.at(timestamp_ns, max_gap_ns)
        if step is None:
            return None
        pose = pose @ step
    return pose


def _motion(place: np.ndarray, quaternion: np.ndarray) -> Transform:
    return Transform(rotation_of_quaternion(torch.from_numpy(quaternion)), torch.from_numpy(np.array(place)))


def find_settings(path: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder, or in those below it: its scenarios."""
    return [path / name] if (path / name).is_file() else sorted(path.glob(f"*/{name}"))
