# SPDX-License-Identifier: Apache-2.0
"""Endless generated scenes with the candidates of the vote, on which their verification is trained.

Half of the scenes have few objects in common; the others are of agents at two places, and at one place minutes apart. Streets,
numbers of boxes, errors of boxes, false boxes and placements vary from scene to scene; a scene is a pure function of seed and
number.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.candidate_features import compute_features
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES, BoxNoise, MeasuredBoxErrors
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, Placement, SensorClutter, make_landmark_scene
from manyeyes.simulator.fleet.street_layouts import draw_layout

MAX_TRAINING_CANDIDATES = 3
SCENES_PER_FILE = 500
RIGHT = 2.0
"""Metres and degrees within which a candidate is right."""
UNCLEAR = 4.0, 5.0
"""Metres and degrees within which a candidate is neither right nor wrong."""
_COMMON = {2: 0.06, 3: 0.26, 4: 0.26, 5: 0.2, 6: 0.1, 7: 0.06, 8: 0.06}


@dataclass(frozen=True, eq=False)
class LabelledCandidates:
    """Candidates of S scenes. features: (S, K, NUM_FEATURES); exists, is_right, is_unclear: (S, K) bool."""

    features: NDArray[np.float32]
    exists: NDArray[np.bool_]
    is_right: NDArray[np.bool_]
    is_unclear: NDArray[np.bool_]

    @classmethod
    def cat(cls, many: Sequence[LabelledCandidates]) -> LabelledCandidates:
        """Concatenate several sets of scenes."""
        return cls(*(np.concatenate([getattr(m, f.name) for m in many]) for f in fields(cls)))


def draw_spec(rng: np.random.Generator) -> LandmarkSpec:
    """Draw the specification of a scene."""
    ego = round(5 * 7 ** rng.random())
    other = round(ego * rng.uniform(0.9, 1.4))
    common = int(rng.choice(list(_COMMON), p=list(_COMMON.values())))
    noise, kind = _draw_noise(rng), rng.random()
    clutter = SensorClutter(int(rng.integers(1, 5)), 0.0) if rng.random() < 0.15 else SensorClutter()
    layout = draw_layout(rng) if rng.random() < 0.8 else None
    placement: Placement = "near" if rng.random() < 0.2 else "roadside"
    if kind < 0.33:
        # As many boxes as where some are in common, so that their number is no evidence.
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
    """Make one scene with the vote's best candidates and their labels."""
    scene = make_landmark_scene(spec, seed, number)
    ego, other = (Landmarks.of_boxes(boxes[0]) for boxes in (scene.ego, scene.other))
    found = find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)
    features, exists = compute_features(ego, other, found, MAX_TRAINING_CANDIDATES)
    pose = np.zeros((MAX_TRAINING_CANDIDATES, 3))
    for k, one in enumerate(found[:MAX_TRAINING_CANDIDATES]):
        pose[k] = one.pose
    error = pose - scene.ego_from_other
    away, turn = np.hypot(error[:, 0], error[:, 1]), np.abs(np.remainder(error[:, 2] + np.pi, 2 * np.pi) - np.pi)
    is_right = exists & (away < RIGHT) & (turn < math.radians(RIGHT))
    is_unclear = exists & (away < UNCLEAR[0]) & (turn < math.radians(UNCLEAR[1])) & ~is_right
    return LabelledCandidates(features[None], exists[None], is_right[None], is_unclear[None])


def build_scenes(folder: Path, seed: int, count: int) -> Iterator[LabelledCandidates]:
    """Yield count scenes of a seed in parts; parts that are in the folder are read, so that an interrupted build continues."""
    folder.mkdir(parents=True, exist_ok=True)
    for first in range(0, count, SCENES_PER_FILE):
        path = folder / f"{first:07d}.npz"
        if not path.exists():
            numbers = range(first, first + SCENES_PER_FILE)
            specs = [draw_spec(keyed_generator(seed, "candidate scene", n)) for n in numbers]
            part = LabelledCandidates.cat([make_labelled_candidates(s, seed, n) for s, n in zip(specs, numbers)])
            content = io.BytesIO()
            np.savez(content, **{f.name: getattr(part, f.name) for f in fields(part)})
            atomic_write(path, content.getvalue(), durable=False)
        with np.load(path) as stored:
            yield LabelledCandidates(*(stored[f.name] for f in fields(LabelledCandidates)))
