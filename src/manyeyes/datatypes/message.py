# SPDX-License-Identifier: Apache-2.0
"""Message of one agent to all others at one instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes.body import AgentBody
from manyeyes.datatypes.boxes import Boxes
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.grid import BevGrid
from manyeyes.datatypes.map_element import MapElements, Polygons, freeze
from manyeyes.datatypes.point_cloud import PointCloud
from manyeyes.datatypes.sight import Sight
from manyeyes.datatypes.sparse_bev import SparseBev
from manyeyes.datatypes.transform import Transform

DESCRIPTOR_DIM = 32
"""Channels of an object's descriptor."""


@dataclass(frozen=True, eq=False)
class RequestMap:
    """Confidence (rows, columns) in [0, 1] of an agent's own objects, one value a cell of a coarse grid.

    0 where it detects nothing: tokens of others have the highest value there.
    """

    grid: BevGrid
    confidence: Tensor

    def __post_init__(self) -> None:
        if tuple(self.confidence.shape) != self.grid.shape:
            raise ShapeError(
                f"RequestMap.confidence needs shape {self.grid.shape}; got {tuple(self.confidence.shape)}."
            )


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Map elements that an agent observes, in its own frame, metres, and the area in which it observes.

    view: (K, 2), an open ring; occluders: open rings that hide parts of it. No element in a visible part of the view means that
    there is none.
    """

    elements: MapElements
    view: NDArray[np.float64]
    occluders: Polygons = field(default_factory=Polygons.of)

    def __post_init__(self) -> None:
        object.__setattr__(self, "view", freeze(self.view, np.float64))
        if self.view.ndim != 2 or self.view.shape[1] != 2 or len(self.view) < 3:
            raise ShapeError(f"LocalMap.view needs shape (K, 2), K >= 3; got {self.view.shape}.")


@dataclass(frozen=True)
class Message:
    """Header and up to six sections; a section that is not sent is None.

    world_from_agent: the prior pose at timestamp_ns, the time of capture; pose_covariance: (3, 3), x, y, yaw.
    fingerprint: 8 bytes that name the weights which made the tokens; tokens of other weights are refused.
    tokens: one grid, in the sender's frame; features float, or uint8 rows of the weights' codebook. token_score: (N,), which
    cells matter most. objects and points: sender's frame. descriptors: (objects, DESCRIPTOR) in [-1, 1], of each object, for
    matching. request: the sender's confidence. local_map: the map elements that it observes. body: of the sender's vehicle, in its
    frame; None is unknown, and of infrastructure. sight: its free space at timestamp_ns, in its frame.
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
    descriptors: Tensor | None = None
    request: RequestMap | None = None
    local_map: LocalMap | None = None
    body: AgentBody | None = None
    sight: Sight | None = None
