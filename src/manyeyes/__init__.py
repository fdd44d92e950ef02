# SPDX-License-Identifier: Apache-2.0
"""manyeyes: cooperative perception of many agents within a byte budget."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

__version__ = "0.1.0"

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent as Agent, Perception as Perception
    from manyeyes.comms.inbox import Inbox as Inbox
    from manyeyes.datasets.argoverse2 import Argoverse2Recording as Argoverse2Recording
    from manyeyes.datasets.dair_v2x import DairRecording as DairRecording
    from manyeyes.datasets.opv2v import Opv2vRecording as Opv2vRecording
    from manyeyes.datatypes.boxes import Boxes as Boxes
    from manyeyes.datatypes.errors import ManyeyesError as ManyeyesError
    from manyeyes.datatypes.grid import BevGrid as BevGrid
    from manyeyes.datatypes.message import Message as Message
    from manyeyes.datatypes.point_cloud import PointCloud as PointCloud
    from manyeyes.datatypes.snapshot import AgentFrame as AgentFrame, Snapshot as Snapshot
    from manyeyes.datatypes.sparse_bev import SparseBev as SparseBev
    from manyeyes.datatypes.transform import Transform as Transform
    from manyeyes.models.pretrained import load as load_detector  # noqa: F401

__getattr__, __dir__ = attach(__name__)
