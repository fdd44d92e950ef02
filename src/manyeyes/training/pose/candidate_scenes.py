# SPDX-License-Identifier: Apache-2.0
"""Endless generated scenes with the candidates of the vote, on which the learned matcher is trained.

Half of the scenes have few objects in common; the others are of agents at two places, and at one place minutes apart. Streets,
numbers of boxes, errors of boxes, false boxes and placements vary from scene to scene; a scene is a pure function of seed and
number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.candidate_batch import CandidateSet
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES, BoxNoise, MeasuredBoxErrors
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, Placement, SensorClutter, make_landmark_scene
from manyeyes.simulator.fleet.street_layouts import draw_layout

SCENES_PER_DENSITY = 16
"""Scenes with similar numbers of boxes, so that little of a batch is padding."""
MAX_TRAINING_CANDIDATES = 3
RIGHT = 2.0
"""Metres and degrees within which a candidate is right."""
UNCLEAR = 4.0, 5.0
"""Metres and degrees within which a candidate is neither right nor wrong."""
_COMMON = {2: 0.06, 3: 0.26, 4: 0.26, 5: 0.2, 6: 0.1, 7: 0.06, 8: 0.06}


@dataclass(frozen=True, eq=False)
class LabelledCandidates:
    """candidates: a scene. is_right, is_unclear: (K,) bool. is_match: (K, P) bool, pairs that are one object."""

    candidates: CandidateSet
    is_right: NDArray[np.bool_]
    is_unclear: NDArray[np.bool_]
    is_match: NDArray[np.bool_]


def draw_spec(rng: np.random.Generator, density: float) -> LandmarkSpec:
    """Draw the specification of a scene; density: in [0, 1), the logarithm of the number of boxes."""
    ego = round(5 * 8 ** (density**1.4) * rng.uniform(0.85, 1.15))
    other = round(ego * rng.uniform(0.95, 1.35))
    common = int(rng.choice(list(_COMMON), p=list(_COMMON.values())))
    noise, kind = _draw_noise(rng), rng.random()
    clutter = SensorClutter(int(rng.integers(1, 5)), 0.0) if rng.random() < 0.15 else SensorClutter()
    layout = draw_layout(rng) if rng.random() < 0.75 else None
    placement: Placement = "near" if rng.random() < 0.2 else "roadside"
    if kind < 0.33:
        # As many boxes as where some are in common, so that their number says nothing.
        numbers = ego + common, other + common
        elsewhere = layout if rng.random() < 0.3 else draw_layout(rng)
        return LandmarkSpec(0, *numbers, noise, True, clutter=clutter, layout=layout, other_layout=elsewhere)
    if kind < 0.47:
        fraction = rng.uniform(0.2, 0.7)
        numbers = ego + common, other + common
        return LandmarkSpec(0, *numbers, noise, parked_fraction=fraction, clutter=clutter, layout=layout)
    return LandmarkSpec(common, ego, other, noise, clutter=clutter, placement=placement, layout=layout)


def _draw_noise(rng: np.random.Generator) -> BoxNoise | MeasuredBoxErrors:
    kind, scale = rng.random(), rng.uniform(0.6, 1.5)
    if kind < 0.6:
        return REAL_BOXES
    if kind < 0.9:
        return replace(
            REAL_BOXES,
            sigma_longitudinal_m=scale * REAL_BOXES.sigma_longitudinal_m,
            sigma_lateral_m=scale * REAL_BOXES.sigma_lateral_m,
            sigma_yaw_rad=rng.uniform(0.7, 1.4) * REAL_BOXES.sigma_yaw_rad,
            tail_fraction=rng.uniform(0.0, 0.15),
            p_flip=rng.uniform(0.0, 0.1),
            sigma_size_m=scale * REAL_BOXES.sigma_size_m,
        )
    return BoxNoise(0.25 * scale, math.radians(2.5 * scale), rng.uniform(0.0, 0.1))


def make_labelled_candidates(spec: LandmarkSpec, seed: int, number: int) -> LabelledCandidates:
    """Make a scene with the vote's candidates and their labels."""
    scene = make_landmark_scene(spec, seed, number)
    ego, other = (Landmarks.of_boxes(boxes[0]) for boxes in (scene.ego, scene.other))
    found = find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)[:MAX_TRAINING_CANDIDATES]
    candidates = CandidateSet.of(ego, other, found, MAX_TRAINING_CANDIDATES)
    error = candidates.pose.astype(np.float64) - scene.ego_from_other
    away, turn = (
        np.hypot(error[:, 0], error[:, 1]),
        np.degrees(np.abs(np.remainder(error[:, 2] + np.pi, 2 * np.pi) - np.pi)),
    )
    exists = np.arange(MAX_TRAINING_CANDIDATES) < len(found)
    is_right = exists & (away < RIGHT) & (turn < RIGHT)
    is_unclear = exists & (away < UNCLEAR[0]) & (turn < UNCLEAR[1]) & ~is_right
    true_pairs = {(int(i), int(k)) for i, k in scene.common_pairs}
    is_match = np.array([[(int(i), int(k)) in true_pairs for i, k in pairs] for pairs in candidates.pairs])
    return LabelledCandidates(candidates, is_right, is_unclear, is_match)


def draw_labelled_candidates(seed: int, number: int) -> LabelledCandidates:
    """Draw the scene of this number from an endless, keyed stream; consecutive ones have similar numbers of boxes."""
    density = keyed_generator(seed, "candidate density", number // SCENES_PER_DENSITY).random()
    return make_labelled_candidates(draw_spec(keyed_generator(seed, "candidate scene", number), density), seed, number)
