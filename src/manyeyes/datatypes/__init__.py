# SPDX-License-Identifier: Apache-2.0
"""Data types: frozen dataclasses of tensors, without drawing, loading or logging."""

from manyeyes.datatypes.boxes import LABELS, Boxes, wrap_angle
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.datatypes.errors import (
    CheckpointError,
    ConfigError,
    ManyeyesError,
    MissingExtraError,
    RecordingError,
    ShapeError,
    WireError,
)
from manyeyes.datatypes.grid import BevGrid
from manyeyes.datatypes.map_element import KINDS, STYLES, MapElements, Polygons
from manyeyes.datatypes.message import Message
from manyeyes.datatypes.point_cloud import PointCloud
from manyeyes.datatypes.snapshot import AgentFrame, GroundTruth, Snapshot
from manyeyes.datatypes.sparse_bev import Sites, SparseBev
from manyeyes.datatypes.transform import Transform

__all__ = [
    "KINDS",
    "LABELS",
    "STYLES",
    "AgentFrame",
    "BevGrid",
    "Boxes",
    "Camera",
    "CameraImage",
    "CheckpointError",
    "ConfigError",
    "GroundTruth",
    "ManyeyesError",
    "MapElements",
    "Message",
    "MissingExtraError",
    "PointCloud",
    "Polygons",
    "RecordingError",
    "ShapeError",
    "Sites",
    "Snapshot",
    "SparseBev",
    "Transform",
    "WireError",
    "wrap_angle",
]
