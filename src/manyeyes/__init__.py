# SPDX-License-Identifier: Apache-2.0
"""manyeyes: cooperative perception of many agents within a byte budget."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent, Perception
    from manyeyes.comms.inbox import Inbox
    from manyeyes.datasets.argoverse2 import Argoverse2Recording
    from manyeyes.datasets.dair_v2x import DairRecording
    from manyeyes.datasets.opv2v import Opv2vRecording
    from manyeyes.datatypes import (
        AgentFrame,
        BevGrid,
        Boxes,
        ManyeyesError,
        Message,
        PointCloud,
        Snapshot,
        SparseBev,
        Transform,
    )
    from manyeyes.models.pretrained import load as load_detector

_HOME = {
    "Agent": "manyeyes.agents.agent",
    "AgentFrame": "manyeyes.datatypes",
    "Argoverse2Recording": "manyeyes.datasets.argoverse2",
    "BevGrid": "manyeyes.datatypes",
    "Boxes": "manyeyes.datatypes",
    "DairRecording": "manyeyes.datasets.dair_v2x",
    "Inbox": "manyeyes.comms.inbox",
    "ManyeyesError": "manyeyes.datatypes",
    "Message": "manyeyes.datatypes",
    "Opv2vRecording": "manyeyes.datasets.opv2v",
    "Perception": "manyeyes.agents.agent",
    "PointCloud": "manyeyes.datatypes",
    "Snapshot": "manyeyes.datatypes",
    "SparseBev": "manyeyes.datatypes",
    "Transform": "manyeyes.datatypes",
    "load_detector": "manyeyes.models.pretrained",
}

__all__ = [
    "Agent",
    "AgentFrame",
    "Argoverse2Recording",
    "BevGrid",
    "Boxes",
    "DairRecording",
    "Inbox",
    "ManyeyesError",
    "Message",
    "Opv2vRecording",
    "Perception",
    "PointCloud",
    "Snapshot",
    "SparseBev",
    "Transform",
    "load_detector",
]


def __getattr__(name: str) -> Any:
    """Load a name at its first use, so that importing manyeyes takes milliseconds."""
    if name not in _HOME:
        raise AttributeError(f"module 'manyeyes' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), "load" if name == "load_detector" else name)
