# SPDX-License-Identifier: Apache-2.0
"""Limits of FeaKM's acceptance: views of different scenes, and a network that matches rows in order."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from benchmarks.feakm_acceptance import LIMITS, draw_null_views, match, sweep_limits

from manyeyes.datatypes import Transform
from manyeyes.evaluation.pose.accuracy import LandmarkPair
from manyeyes.models.pose.matcher import KeypointBatch
from manyeyes.pose.feakm import FeakmCorrector, solve_with_consensus
from manyeyes.pose.landmarks import Landmarks

NUM_OBJECTS = 7
EGO_FROM_OTHER = Transform.from_xyz_yaw(12.0, -3.0, 0.0, 2.0)


def make_pair(scenario: str, seed: int) -> LandmarkPair:
    rng = np.random.default_rng(seed)
    rows = np.column_stack(
        (
            rng.uniform(-40, 40, (NUM_OBJECTS, 2)),
            rng.uniform(-3, 3, NUM_OBJECTS),
            np.full((NUM_OBJECTS, 3), (4.5, 1.9, 1)),
        )
    )
    ego = Landmarks(
        *(getattr(Landmarks.of(rows), n) for n in ("xy", "yaw", "size", "score", "sigma_xy", "sigma_yaw", "p_flip")),
        np.zeros(NUM_OBJECTS, np.int64),
        np.zeros((NUM_OBJECTS, 4)),
    )
    back = EGO_FROM_OTHER.inverse()
    other = ego.transform(np.array([*back.translation[:2].tolist(), float(back.yaw)]))
    return LandmarkPair(scenario, 0, 7, ego, other, EGO_FROM_OTHER, ego.xy, 100, Transform.identity())


def match_in_order(a: KeypointBatch, b: KeypointBatch) -> SimpleNamespace:
    rows = torch.arange(a.xy.shape[1])
    return SimpleNamespace(pairs=torch.stack((rows, rows), 1))


CORRECTOR = FeakmCorrector(cast(Any, SimpleNamespace(match=match_in_order)), solve_with_consensus)
PAIRS = [make_pair(name, n) for n, name in enumerate(("a", "a", "b", "c"))]


def test_null_views_are_of_different_scenes() -> None:
    scenario = {id(landmarks): p.scenario for p in PAIRS for landmarks in (p.ego, p.other)}
    views = list(draw_null_views(PAIRS, 50))
    assert len(views) == 50 and all(scenario[id(ego)] != scenario[id(other)] for ego, other in views)
    ego, other, rows = match(CORRECTOR, PAIRS[0].ego, PAIRS[0].other)
    assert ego is PAIRS[0].ego and other is PAIRS[0].other and len(rows) == NUM_OBJECTS


def test_true_pairs_are_answered_at_every_limit_below_their_score_and_nulls_at_none() -> None:
    lines = {line.what: line for line in sweep_limits(PAIRS, CORRECTOR, 20)}
    assert len(lines) == 3 * len(LIMITS)
    for limit in LIMITS:
        assert lines[f"limit {limit:g}: different scenes answered"].value == 0.0
        assert lines[f"limit {limit:g}: different scenes answered"].count == 20
        assert lines[f"limit {limit:g}: true pairs answered"].value == 1.0
        assert lines[f"limit {limit:g}: within 1 m, 1 deg"].value == 1.0
