# SPDX-License-Identifier: Apache-2.0
"""What the best map could be if one thing were known: rows of a study that no method may enter.

``oracle-cuts``: the truth, each line cut in the middle: what cutting alone costs. ``oracle-pose``: our own fusion, every
observation at its true pose. ``oracle-association``: the true associations are known, poses are the priors: every observed point is
laid onto its true element by the true pose, and each metre of that element moves across by the mean offset at the
prior poses; metres without observation are left out where they are more than 6 m. A crossing moves as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.maps.experiment import FleetExperiment, replace_poses
from manyeyes.evaluation.maps.matching import MatchingProtocol, make_lines, resample_lines
from manyeyes.evaluation.maps.observed_area import replace_geometry
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse

Floats = NDArray[np.float64]
ORACLES = ("oracle-cuts", "oracle-pose", "oracle-association")
_MAX_GAP_M = 6.0


def run_oracle(name: str, experiment: FleetExperiment, config: MapFusionConfig) -> MapElements:
    """Return the elements of an oracle's map, before the common cut."""
    if name == "oracle-cuts":
        return split_in_half(experiment.truth)
    if name == "oracle-pose":
        observations = replace_poses(experiment.observations, experiment.fleet.true_poses)
        return fuse(observations, config, experiment.place.frame).select_published().elements
    return fuse_with_true_association(experiment)


def split_in_half(elements: MapElements) -> MapElements:
    """Return every line as two of half its length; crossings as they are."""
    rows, parts = [], []
    for row in range(len(elements)):
        line = elements.polyline(row)
        if elements.kind[row] == CROSSING:
            rows.append(row)
            parts.append(line)
            continue
        arc_length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
        half = arc_length[-1] / 2
        middle = np.array([[np.interp(half, arc_length, line[:, axis]) for axis in (0, 1)]])
        rows += [row, row]
        parts += [np.vstack((line[arc_length < half], middle)), np.vstack((middle, line[arc_length > half]))]
    return replace_geometry(elements, rows, parts)


def fuse_with_true_association(experiment: FleetExperiment) -> MapElements:
    """Return every observed true element, moved by the mean offset of its observations at the prior poses."""
    truth = experiment.place.truth
    points_by_element: dict[int, list[Floats]] = {}
    for k, (observation, pose) in enumerate(zip(experiment.observations, experiment.fleet.true_poses)):
        true, reported = observation.elements_in_map(pose), observation.elements_in_map()
        origins = experiment.fleet.origin[experiment.fleet.origin_offsets[k] : experiment.fleet.origin_offsets[k + 1]]
        for row, origin in enumerate(origins.tolist()):
            if 0 <= origin < len(truth):
                points_by_element.setdefault(origin, []).append(np.hstack((true.polyline(row), reported.polyline(row))))
    rows: list[int] = []
    parts: list[Floats] = []
    for origin in sorted(points_by_element):
        point_pairs = np.concatenate(points_by_element[origin])
        line = truth.polyline(origin)
        shifted = (
            [line + (point_pairs[:, 2:] - point_pairs[:, :2]).mean(0)]
            if truth.kind[origin] == CROSSING
            else _shift_line(line, point_pairs)
        )
        rows += [origin] * len(shifted)
        parts += shifted
    return replace_geometry(truth, rows, parts)


def _shift_line(line: Floats, point_pairs: Floats) -> list[Floats]:
    """Return the seen parts of a line, at 1 m, across it at the mean of the claimed points (K, 4): true x, y, claimed x, y."""
    stations = resample_lines(make_lines([line]), MatchingProtocol("stations", spacing_m=1.0)).points
    step = np.gradient(stations, axis=0)
    normal = np.stack((-step[:, 1], step[:, 0]), 1) / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]
    nearest = np.hypot(
        point_pairs[:, None, 0] - stations[None, :, 0], point_pairs[:, None, 1] - stations[None, :, 1]
    ).argmin(1)
    lateral_m = ((point_pairs[:, 2:] - stations[nearest]) * normal[nearest]).sum(1)
    count = np.bincount(nearest, minlength=len(stations))
    mean = np.bincount(nearest, lateral_m, len(stations)) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    breaks = np.flatnonzero(np.diff(known) > _MAX_GAP_M) + 1
    return [stations[part] + mean[part, None] * normal[part] for part in np.split(known, breaks) if len(part) > 1]
