# SPDX-License-Identifier: Apache-2.0
"""Curvature of the dividers of a map: how much of their length bends with a radius below a limit."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.ops.polyline import resample_spaced

Floats = NDArray[np.float64]

CURVED_RADIUS_M = 100.0
"""Radius below which a divider counts as curved."""
MIN_CURVED_LENGTH_M = 10.0
"""Length of curved dividers from which a tile counts as curved."""
_SPACING_M, _WINDOW = 1.0, 10


def measure_curved_length(elements: MapElements, max_radius_m: float = CURVED_RADIUS_M) -> float:
    """Return the length of all dividers that bends with a radius of at most max_radius_m.

    Boundaries bend at the corners of every junction and do not count. Curvature is the change of heading over 10 m; shorter
    dividers are straight.
    """
    lines = elements.take(elements.kind == DIVIDER)
    points, offsets = resample_spaced(lines.points, lines.offsets, _SPACING_M)
    return sum(_curved_length(points[a:b], max_radius_m) for a, b in pairwise(offsets.tolist()))


def is_curved(elements: MapElements) -> bool:
    """Return whether a tile counts as curved."""
    return measure_curved_length(elements) >= MIN_CURVED_LENGTH_M


def _curved_length(line: Floats, max_radius_m: float) -> float:
    edges = np.diff(line, axis=0)
    step = np.hypot(*edges.T)
    if len(edges) <= _WINDOW:
        return 0.0
    heading = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
    turn = np.abs(heading[_WINDOW:] - heading[:-_WINDOW])
    bends = turn >= step[_WINDOW:] * _WINDOW / max_radius_m
    return float(step[_WINDOW:][bends].sum())
