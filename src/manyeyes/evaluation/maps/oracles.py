# SPDX-License-Identifier: Apache-2.0
"""What the best map could be if one thing were known: rows of a study that no method may enter.

``oracle-cuts``: the truth, each line cut in the middle: what cutting alone costs. ``oracle-pose``: our own fusion, every
observation at its true pose. ``oracle-association``: the true associations are known, poses are the priors: every observed point is
laid onto its true element by the true pose, and each metre of that element moves across by the mean offset at the prior poses;
metres without observation are left out where they are more than 6 m. A crossing moves as a whole. ``oracle-joint``: the same at
poses by joint least squares with the true associations (``evaluation.maps.association_oracle``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.maps.association_oracle import (
    estimate_poses_with_true_association,
    fuse_with_true_association,
)
from manyeyes.evaluation.maps.experiment import FleetExperiment, replace_poses
from manyeyes.evaluation.maps.observed_area import replace_geometry
from manyeyes.maps.fusion.fuse import MapFusionConfig, fuse

Floats = NDArray[np.float64]
ORACLES = ("oracle-cuts", "oracle-pose", "oracle-association", "oracle-joint")


def run_oracle(name: str, experiment: FleetExperiment, config: MapFusionConfig) -> MapElements:
    """Return the elements of an oracle's map, before the common cut."""
    if name == "oracle-cuts":
        return split_in_half(experiment.truth)
    if name == "oracle-pose":
        observations = replace_poses(experiment.observations, experiment.fleet.true_poses)
        return fuse(observations, config, experiment.place.frame).select_published().elements
    poses = estimate_poses_with_true_association(experiment) if name == "oracle-joint" else None
    return fuse_with_true_association(experiment, poses)


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
