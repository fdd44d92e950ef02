# SPDX-License-Identifier: Apache-2.0
"""A detector that is given one sweep at a time: for sensors, or evaluations, without the sweep before."""

from __future__ import annotations

from typing import Any

from manyeyes.datatypes import Boxes, PointCloud, SparseBev
from manyeyes.models.detector.box_head import RawBoxes
from manyeyes.models.detector.protocols import BoxDetector, has_tokens


class _SingleSweepBoxes:
    """Boxes of one sweep; all else is that of the detector."""

    def __init__(self, detector: Any) -> None:
        self._detector = detector

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the detector."""
        if name == "_detector":
            raise AttributeError(name)
        return getattr(self._detector, name)

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        """Detect the boxes of a point cloud; previous is not used."""
        return self._detector.detect(points, None)


class _SingleSweepTokens(_SingleSweepBoxes):
    """Tokens of one sweep, too."""

    def extract_tokens(self, points: PointCloud, previous: PointCloud | None = None) -> tuple[SparseBev, RawBoxes]:
        """Encode a point cloud; previous is not used."""
        return self._detector.extract_tokens(points, None)


def with_single_sweep(detector: BoxDetector) -> BoxDetector:
    """Return the detector without the sweeps before; its messages can be fused by the given one, and the other way."""
    wrapped: Any = _SingleSweepTokens(detector) if has_tokens(detector) else _SingleSweepBoxes(detector)
    return wrapped
