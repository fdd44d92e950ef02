# SPDX-License-Identifier: Apache-2.0
"""Plausibility of a sender's stated pose, relative to the receiver and to the sender's earlier messages.

An implausible pose is treated as unknown: a message with infinite pose covariance, whose content is fused only after an accepted
pose estimate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import mul

import torch

from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import AgentFrame, Message

MAX_GAP_NS = 2_000_000_000
"""An accepted pose of a sender is forgotten after a longer time."""
JUMP_SIGMAS = 6.0
"""Standard deviations of both stated positions by which the displacement of a sender may exceed its speed."""


@dataclass(frozen=True)
class AcceptedPose:
    """The last plausible pose of a sender: position (m) in the world, and its standard deviation (m)."""

    timestamp_ns: int
    position: tuple[float, float, float]
    sigma_m: float

    @classmethod
    def of(cls, message: Message) -> AcceptedPose:
        """Return the pose of a message."""
        x, y, z = message.world_from_agent.translation.tolist()
        return cls(message.timestamp_ns, (x, y, z), _sigma_xy_m(message))


AcceptedPoses = Mapping[int, AcceptedPose]
"""Last plausible poses by agent id."""


def accept_poses(poses: AcceptedPoses, messages: Sequence[Message], now_ns: int) -> AcceptedPoses:
    """Return the poses with those of messages whose pose is known, without those older than MAX_GAP_NS."""
    stated = {message.agent_id: AcceptedPose.of(message) for message in messages if has_known_pose(message)}
    return {a: pose for a, pose in {**poses, **stated}.items() if abs(now_ns - pose.timestamp_ns) <= MAX_GAP_NS}


def find_pose_fault(
    frame: AgentFrame, message: Message, last: AcceptedPose | None, limits: ReceiverLimits
) -> str | None:
    """Return why the stated pose of a message is implausible for the receiver of a frame, or None if it is plausible."""
    ego, sender = frame.world_from_agent, message.world_from_agent
    offset = [there - here for there, here in zip(sender.translation.tolist(), ego.translation.tolist())]
    # The columns of a rotation are the axes of the agent in the world.
    x, y, height = (sum(map(mul, axis, offset)) for axis in zip(*ego.rotation.tolist()))
    distance = math.hypot(x, y)
    cosine = sum(ego_row[2] * row[2] for ego_row, row in zip(ego.rotation.tolist(), sender.rotation.tolist()))
    tilt = math.acos(max(-1.0, min(1.0, cosine)))
    sigma_xy, variance_yaw = _sigma_xy_m(message), float(message.pose_covariance[2, 2])
    # A comparison with NaN is false, so each check states what is plausible.
    if not distance <= limits.max_distance_m:
        return f"the sender is {distance:.4g} m away; at most {limits.max_distance_m:g} m"
    if not abs(height) <= limits.max_height_difference_m:
        return f"the sender is {height:.4g} m above the receiver; at most {limits.max_height_difference_m:g} m"
    if not tilt <= limits.max_tilt_rad:
        bound = math.degrees(limits.max_tilt_rad)
        return f"the sender is tilted by {math.degrees(tilt):.3g} degrees; at most {bound:.3g} degrees"
    if not (sigma_xy <= limits.max_sigma_xy_m and variance_yaw <= limits.max_sigma_yaw_rad**2):
        bounds = f"{limits.max_sigma_xy_m:g} m and {limits.max_sigma_yaw_rad:g} rad"
        return f"the stated standard deviations of the pose are larger than {bounds}"
    return None if last is None else _find_jump(message, last, limits)


def _find_jump(message: Message, last: AcceptedPose, limits: ReceiverLimits) -> str | None:
    pose = AcceptedPose.of(message)
    moved = math.dist(pose.position, last.position)
    seconds = abs(pose.timestamp_ns - last.timestamp_ns) * 1e-9
    slack = limits.max_pose_jump_m + JUMP_SIGMAS * math.hypot(pose.sigma_m, last.sigma_m)
    bound = limits.max_speed_mps * seconds + slack
    if moved <= bound:
        return None
    return f"the sender moved by {moved:.4g} m in {seconds:.3g} s; at most {bound:.3g} m"


def with_unknown_pose(message: Message) -> Message:
    """Return the message with infinite pose covariance."""
    return replace(message, pose_covariance=torch.full((3, 3), torch.inf, dtype=torch.float64))


def has_known_pose(agent: AgentFrame | Message) -> bool:
    """Return whether the pose covariance of an agent is finite."""
    return all(math.isfinite(value) for row in agent.pose_covariance.tolist() for value in row)


def _sigma_xy_m(message: Message) -> float:
    """Return the larger standard deviation of x and y; infinite for an unknown pose."""
    (xx, _, _), (_, yy, _), _ = message.pose_covariance.tolist()
    return math.sqrt(max(xx, yy, 0.0)) if xx < math.inf and yy < math.inf else math.inf
