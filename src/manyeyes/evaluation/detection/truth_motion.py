# SPDX-License-Identifier: Apache-2.0
"""Truth between two annotated frames: objects and agents move uniformly from one to the next.

Positions are interpolated linearly, headings of boxes along the shorter arc modulo pi (annotations turn boxes around), rotations of
agents about a fixed axis. What the next frame lacks goes on at its annotated velocity. After the last frame of a recording, or of
an agent's presence in it, objects go on at their velocity and agents as they moved since the frame before. Which objects count, and
who lists them, is that of the last frame before.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import Boxes, GroundTruth, RecordingError, Snapshot, Transform


def move_truth(recording: Recording, snapshot: Snapshot, agent_id: int, time_ns: int) -> Snapshot:
    """Return the snapshot whose truth is that of a time of an agent's clock, not before that of its frame in the snapshot.

    The frames are those of the last instant before; their clouds and prior poses are not moved.

    Raises:
        RecordingError: a snapshot has no truth.
    """
    earlier, before, after = None, snapshot, None
    for index in range(snapshot.index + 1, recording.length(snapshot.scenario)):
        after = recording.snapshot(snapshot.scenario, index)
        if _time_ns(after, agent_id) is None:
            after = None
            break
        if _require_time_ns(after, agent_id) > time_ns:
            break
        earlier, before, after = before, after, None
    if after is None and earlier is None and before.index > 0:
        earlier = recording.snapshot(snapshot.scenario, before.index - 1)
    start_ns = _require_time_ns(before, agent_id)
    truth, seconds = _require_truth(before), (time_ns - start_ns) / 1e9
    boxes = _extrapolate_boxes(truth.boxes, seconds)
    if after is not None:
        fraction = (time_ns - start_ns) / (_require_time_ns(after, agent_id) - start_ns)
        boxes = _interpolate_boxes(truth.boxes, boxes, _require_truth(after).boxes, fraction)
        poses = _interpolate_agents(before, before, after, fraction)
    elif earlier is not None and _time_ns(earlier, agent_id) is not None:
        past_s = (start_ns - _require_time_ns(earlier, agent_id)) / 1e9
        poses = _interpolate_agents(before, earlier, before, 1 + seconds / past_s if past_s > 0 else 1.0)
    else:
        poses = truth.world_from_agent
    return replace(before, truth=replace(truth, boxes=boxes, world_from_agent=poses))


def interpolate_pose(start: Transform, end: Transform, fraction: float) -> Transform:
    """Return the pose at a fraction of the way from one pose to another, beyond 1 too: uniform motion, rotation about one axis."""
    relative = start.rotation.mT @ end.rotation
    cosine = ((torch.trace(relative) - 1) / 2).clamp(-1, 1)
    axis, angle = (relative - relative.mT) / 2, float(torch.acos(cosine))
    turn = torch.eye(3, dtype=relative.dtype)
    if angle > 1e-9:
        # Rodrigues' formula; the skew part of the rotation is the axis times the sine of the angle.
        axis = axis / math.sin(angle)
        turn = turn + math.sin(fraction * angle) * axis + (1 - math.cos(fraction * angle)) * (axis @ axis)
    moved = start.translation + fraction * (end.translation - start.translation)
    return Transform(start.rotation @ turn, moved)


def _interpolate_agents(rows: Snapshot, start: Snapshot, end: Snapshot, fraction: float) -> Transform:
    """Return poses of the agents of rows at a fraction between two snapshots; those that one of them lacks stay."""
    truth = _require_truth(rows)
    poses = [truth.world_from_agent[row] for row in range(truth.world_from_agent.translation.shape[0])]
    row_of = [{frame.agent_id: row for row, frame in enumerate(s.frames)} for s in (start, end)]
    for row, frame in enumerate(rows.frames):
        if all(frame.agent_id in found for found in row_of):
            a, b = (_require_truth(s).world_from_agent[found[frame.agent_id]] for s, found in zip((start, end), row_of))
            poses[row] = interpolate_pose(a, b, fraction)
    return Transform.stack(poses)


def _extrapolate_boxes(boxes: Boxes, seconds: float) -> Boxes:
    step = torch.cat((boxes.velocity, boxes.velocity.new_zeros(len(boxes), 1)), 1) * seconds
    return replace(boxes, center=boxes.center + step)


def _interpolate_boxes(start: Boxes, fallback: Boxes, end: Boxes, fraction: float) -> Boxes:
    """Return boxes between two frames by their ids; fallback holds those that the second frame lacks."""
    row_of = {box_id: row for row, box_id in enumerate(end.id.tolist()) if box_id != -1}
    pairs = [(row, row_of[box_id]) for row, box_id in enumerate(start.id.tolist()) if box_id in row_of]
    if not pairs:
        return fallback
    here, there = torch.tensor(pairs).unbind(1)
    return replace(
        fallback,
        center=_put(fallback.center, here, torch.lerp(start.center[here], end.center[there], fraction)),
        yaw=_put(fallback.yaw, here, start.yaw[here] + fraction * _shorter_arc(end.yaw[there] - start.yaw[here])),
    )


def _shorter_arc(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi / 2, math.pi) - math.pi / 2


def _put(values: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    return values.index_put((rows,), new)


def _time_ns(snapshot: Snapshot, agent_id: int) -> int | None:
    return next((frame.timestamp_ns for frame in snapshot.frames if frame.agent_id == agent_id), None)


def _require_time_ns(snapshot: Snapshot, agent_id: int) -> int:
    time_ns = _time_ns(snapshot, agent_id)
    assert time_ns is not None, "the caller has checked that the agent is there"
    return time_ns


def _require_truth(snapshot: Snapshot) -> GroundTruth:
    if snapshot.truth is None:
        raise RecordingError(f"{snapshot.scenario} #{snapshot.index} has no truth; judge recordings with labels only.")
    return snapshot.truth
