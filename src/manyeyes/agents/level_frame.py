# SPDX-License-Identifier: Apache-2.0
"""Frames as perception takes them: z = 0 is the road as far as it is seen, and no return is from the agent's own vehicle.

An agent levels its frame once, at the start of ``share`` and of ``perceive``. Points, pose, odometry, cameras and the agent's body
move together, so everything that is measured in the levelled frame, and every message, agrees with the pose that is sent with it.
A frame whose road is at z = 0 within the noise of the fit is unchanged, and so is one whose road cannot be fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.datatypes import AgentFrame, Snapshot, Transform
from manyeyes.ops.lidar.ground_plane import DEFAULT_GROUND_CONFIG, GroundPlaneConfig, GroundStatus, fit_ground_plane
from manyeyes.ops.lidar.own_returns import remove_own_returns

MAX_CACHED_FRAMES = 8
"""Number of frames of one agent whose levelled frames are kept."""


def clean_frame(frame: AgentFrame) -> AgentFrame:
    """Return the frame without returns from the agent's own vehicle; the same object if there are none."""
    points = remove_own_returns(frame.points, frame.body)
    return frame if points is frame.points else replace(frame, points=points)


def find_levelling(frame: AgentFrame, config: GroundPlaneConfig = DEFAULT_GROUND_CONFIG) -> Transform | None:
    """Return the motion from an agent's frame to its levelled frame; None if the frame stays as it is."""
    fit = fit_ground_plane(frame.points.xyz, config)
    return fit.plane.levelled_from_points() if fit.status is GroundStatus.FOUND and fit.plane is not None else None


@dataclass(frozen=True)
class LevelledFrame:
    """A frame, and its levelled frame without own returns; the same object if nothing changes.

    levelled_from_agent: None if the frame is not moved.
    """

    own: AgentFrame
    levelled: AgentFrame
    levelled_from_agent: Transform | None

    @classmethod
    def of(cls, frame: AgentFrame, config: GroundPlaneConfig = DEFAULT_GROUND_CONFIG) -> LevelledFrame:
        """Remove the own returns of a frame, and level it."""
        cleaned = clean_frame(frame)
        motion = find_levelling(cleaned, config)
        return cls(frame, cleaned if motion is None else cleaned.moved(motion), motion)


class FrameLeveller:
    """Levels the frames of one agent, each once: frames are compared by identity, and a levelled frame is not levelled again.

    config: of the fit; None changes no frame.
    """

    def __init__(self, config: GroundPlaneConfig | None = DEFAULT_GROUND_CONFIG) -> None:
        self.config = config
        self._frames: list[LevelledFrame] = []

    def __call__(self, frame: AgentFrame) -> LevelledFrame:
        """Return the levelled frame."""
        for cached in self._frames:
            if cached.own is frame:
                return cached
            if cached.levelled is frame:
                return LevelledFrame(frame, frame, None)
        if self.config is None:
            return LevelledFrame(frame, frame, None)
        found = LevelledFrame.of(frame, self.config)
        self._frames = [*self._frames, found][-MAX_CACHED_FRAMES:]
        return found


class SnapshotLeveller:
    """Levels the snapshots of one recording; each frame is fitted once, and its motion kept by scenario, index and agent."""

    def __init__(self, config: GroundPlaneConfig = DEFAULT_GROUND_CONFIG) -> None:
        self.config = config
        self._motions: dict[tuple[str, int, int], Transform | None] = {}

    def __call__(self, snapshot: Snapshot) -> Snapshot:
        """Return the snapshot with cleaned and levelled frames and true poses; the same object if nothing changes."""
        frames = tuple(map(clean_frame, snapshot.frames))
        if any(cleaned is not frame for cleaned, frame in zip(frames, snapshot.frames)):
            snapshot = replace(snapshot, frames=frames)
        motions = [self.find(snapshot, frame) for frame in snapshot.frames]
        return snapshot if all(m is None for m in motions) else move_frames(snapshot, motions)

    def find(self, snapshot: Snapshot, frame: AgentFrame) -> Transform | None:
        """Return the motion from a frame of the snapshot to its levelled frame; None if the frame stays as it is."""
        key = snapshot.scenario, snapshot.index, frame.agent_id
        if key not in self._motions:
            self._motions[key] = find_levelling(clean_frame(frame), self.config)
        return self._motions[key]


def move_frames(snapshot: Snapshot, new_from_agent: Sequence[Transform | None]) -> Snapshot:
    """Return the snapshot with each agent's frame, and its true pose, moved by its motion; None leaves them as they are."""
    frames = tuple(f if m is None else f.moved(m) for f, m in zip(snapshot.frames, new_from_agent))
    truth = snapshot.truth
    if truth is not None:
        poses = [truth.world_from_agent[row] for row in range(len(frames))]
        moved = [pose if m is None else pose @ m.inverse() for pose, m in zip(poses, new_from_agent)]
        truth = replace(truth, world_from_agent=Transform.stack(moved))
    return replace(snapshot, frames=frames, truth=truth)
