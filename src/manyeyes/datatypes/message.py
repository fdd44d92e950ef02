# SPDX-License-Identifier: Apache-2.0
"""What one agent says to all others at one instant, before it is bytes and after."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from manyeyes.datatypes.boxes import Boxes
from manyeyes.datatypes.point_cloud import PointCloud
from manyeyes.datatypes.sparse_bev import SparseBev
from manyeyes.datatypes.transform import Transform


@dataclass(frozen=True)
class Message:
    """Header and up to three sections; a section that is not sent is None.

    world_from_agent: the claimed pose at timestamp_ns, the time of capture; pose_covariance: (3, 3), x, y, yaw.
    fingerprint: 8 bytes that name the weights which made the tokens; tokens of other weights are refused.
    tokens: one grid, in the sender's frame. token_score: (N,), which cells matter most. objects and points: sender's frame.
    """

    agent_id: int
    timestamp_ns: int
    world_from_agent: Transform
    pose_covariance: Tensor
    fingerprint: bytes = bytes(8)
    is_infrastructure: bool = False
    tokens: SparseBev | None = None
    token_score: Tensor | None = None
    objects: Boxes | None = None
    points: PointCloud | None = None
