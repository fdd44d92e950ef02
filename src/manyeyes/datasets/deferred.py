# SPDX-License-Identifier: Apache-2.0
"""Snapshots whose clouds are read when they are first used: a training sample needs the poses of all agents but few clouds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import PointCloud, Snapshot


class DeferredCloud(PointCloud):
    """A cloud that is read once, at the first use of its points; errors of its file are raised there."""

    def __init__(self, read: Callable[[], PointCloud]) -> None:
        object.__setattr__(self, "_read", read)

    def __getattr__(self, name: str) -> Any:
        """Read the points; called only while they are absent."""
        if name not in ("xyz", "intensity", "time_s"):
            raise AttributeError(name)
        cloud = self._read()
        for field in ("xyz", "intensity", "time_s"):
            object.__setattr__(self, field, getattr(cloud, field))
        return getattr(self, name)


@runtime_checkable
class DeferredReader(Protocol):
    """A recording that can leave clouds unread."""

    def deferred_snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return all agents at one instant, without pictures; each cloud is a :class:`DeferredCloud`."""
        ...


def read_deferred(recording: Recording, scenario: str, index: int) -> Snapshot:
    """Return a snapshot whose clouds are read when needed, where the recording supports it; else the whole snapshot."""
    if isinstance(recording, DeferredReader):
        return recording.deferred_snapshot(scenario, index)
    return recording.snapshot(scenario, index)
