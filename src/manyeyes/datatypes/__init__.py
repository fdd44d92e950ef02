# SPDX-License-Identifier: Apache-2.0
"""Data types: frozen dataclasses of tensors, without drawing, loading or logging."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.datatypes.body import AgentBody as AgentBody
    from manyeyes.datatypes.boxes import (
        CLASSES as CLASSES,
        LABELS as LABELS,
        VEHICLE_LABELS as VEHICLE_LABELS,
        VEHICLES as VEHICLES,
        Boxes as Boxes,
        wrap_angle as wrap_angle,
    )
    from manyeyes.datatypes.camera import Camera as Camera, CameraImage as CameraImage
    from manyeyes.datatypes.errors import (
        CheckpointError as CheckpointError,
        ConfigError as ConfigError,
        ManyeyesError as ManyeyesError,
        MissingExtraError as MissingExtraError,
        RecordingError as RecordingError,
        ShapeError as ShapeError,
        WireError as WireError,
    )
    from manyeyes.datatypes.grid import BevGrid as BevGrid
    from manyeyes.datatypes.map_element import (
        KINDS as KINDS,
        STYLES as STYLES,
        MapElements as MapElements,
        Polygons as Polygons,
    )
    from manyeyes.datatypes.message import Message as Message
    from manyeyes.datatypes.point_cloud import PointCloud as PointCloud
    from manyeyes.datatypes.sight import Sight as Sight
    from manyeyes.datatypes.snapshot import AgentFrame as AgentFrame, GroundTruth as GroundTruth, Snapshot as Snapshot
    from manyeyes.datatypes.sparse_bev import Sites as Sites, SparseBev as SparseBev
    from manyeyes.datatypes.transform import Transform as Transform

__getattr__, __dir__ = attach(__name__)
