# SPDX-License-Identifier: Apache-2.0
"""What the best map could be if one thing were known: rows of a study that no method may enter.

``oracle-cuts``: the truth, each line cut in the middle: what cutting alone costs. ``oracle-pose``: our own fusion, every
observation at its true pose. ``oracle-association``: who shows what is known, poses are as claimed: every observed point is
laid onto its true element by the true pose, and each metre of that element moves across by the mean of what the claimed poses
say; metres that nobody saw are left out where they are more than 6 m. A crossing moves as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.maps.experiment import Scene, at_poses
from manyeyes.evaluation.maps.matching import Way, lines_of, spaced
from manyeyes.evaluation.maps.observed_area import with_geometry
from manyeyes.maps.fusion.fuse import FuseConfig, fuse

Floats = NDArray[np.float64]
ORACLES = ("oracle-cuts", "oracle-pose", "oracle-association")
_WIDEST_GAP_M = 6.0


def oracle(name: str, scene: Scene, config: FuseConfig) -> MapElements:
    """The elements of an oracle's map, before the common cut."""
    if name == "oracle-cuts":
        return halves(scene.truth)
    if name == "oracle-pose":
        observations = at_poses(scene.observations, scene.crowd.true_poses)
        return fuse(observations, config, scene.place.frame).published().elements
    return associated(scene)


def halves(elements: MapElements) -> MapElements:
    """Every line as two of half its length; crossings as they are."""
    rows, parts = [], []
    for row in range(len(elements)):
        line = elements.polyline(row)
        if elements.kind[row] == CROSSING:
            rows.append(row)
            parts.append(line)
            continue
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
        half = along[-1] / 2
        middle = np.array([[np.interp(half, along, line[:, axis]) for axis in (0, 1)]])
        rows += [row, row]
        parts += [np.vstack((line[along < half], middle)), np.vstack((middle, line[along > half]))]
    return with_geometry(elements, rows, parts)


def associated(scene: Scene) -> MapElements:
    """Every true element that somebody saw, moved by the mean of what the claimed poses say about it."""
    truth = scene.place.truth
    seen: dict[int, list[Floats]] = {}
    for k, (observation, pose) in enumerate(zip(scene.observations, scene.crowd.true_poses)):
        true, claimed = observation.in_map(pose), observation.in_map()
        origins = scene.crowd.origin[scene.crowd.origin_first[k] : scene.crowd.origin_first[k + 1]]
        for row, origin in enumerate(origins.tolist()):
            if 0 <= origin < len(truth):
                seen.setdefault(origin, []).append(np.hstack((true.polyline(row), claimed.polyline(row))))
    rows: list[int] = []
    parts: list[Floats] = []
    for origin in sorted(seen):
        both = np.concatenate(seen[origin])
        line = truth.polyline(origin)
        moved = [line + (both[:, 2:] - both[:, :2]).mean(0)] if truth.kind[origin] == CROSSING else _moved(line, both)
        rows += [origin] * len(moved)
        parts += moved
    return with_geometry(truth, rows, parts)


def _moved(line: Floats, both: Floats) -> list[Floats]:
    """The seen parts of a line, at 1 m, across it at the mean of the claimed points (K, 4): true x, y, claimed x, y."""
    stations = spaced(lines_of([line]), Way("stations", spacing_m=1.0)).points
    step = np.gradient(stations, axis=0)
    normal = np.stack((-step[:, 1], step[:, 0]), 1) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    nearest = np.hypot(both[:, None, 0] - stations[None, :, 0], both[:, None, 1] - stations[None, :, 1]).argmin(1)
    across = ((both[:, 2:] - stations[nearest]) * normal[nearest]).sum(1)
    count = np.bincount(nearest, minlength=len(stations))
    mean = np.bincount(nearest, across, len(stations)) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    breaks = np.flatnonzero(np.diff(known) > _WIDEST_GAP_M) + 1
    return [stations[part] + mean[part, None] * normal[part] for part in np.split(known, breaks) if len(part) > 1]
