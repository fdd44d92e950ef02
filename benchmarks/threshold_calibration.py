# SPDX-License-Identifier: Apache-2.0
"""Calibrate the minimum score so that pairs of agents without common objects are accepted at most at a given rate.

Traffic stands in lanes and rows, so that agreement by chance is far more frequent than for independent positions. The limit
is therefore measured on representative scenes, not computed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import AcceptanceTest, CorrectorConfig, rank_candidates
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import find_candidates


def calibrate_acceptance(
    null_scenes: Iterable[tuple[Landmarks, Landmarks]],
    max_false_accept_rate: float,
    config: CorrectorConfig | None = None,
) -> AcceptanceTest:
    """Return the acceptance test whose rate of estimates on null scenes is at most ``max_false_accept_rate``, its other limits as
    configured.

    null_scenes: landmarks of two agents that have no object in common, without a prior. At least 2 / max_false_accept_rate scenes
    are needed.
    """
    config = config or CorrectorConfig()
    scores = sorted((_required_min_score(*pair, config) for pair in null_scenes), reverse=True)
    allowed = math.floor(max_false_accept_rate * len(scores))
    if not 0 < max_false_accept_rate < 1 or len(scores) * max_false_accept_rate < 2:
        raise ConfigError(
            f"A rate of {max_false_accept_rate} needs at least {math.ceil(2 / max(max_false_accept_rate, 1e-9))} null scenes; "
            f"got {len(scores)}. Give more scenes or allow more."
        )
    # Just above the best scene that must be rejected.
    min_score = scores[allowed] + 1e-9 if math.isfinite(scores[allowed]) else 0.0
    return replace(config.accept, min_score=min_score)


def _required_min_score(ego: Landmarks, other: Landmarks, config: CorrectorConfig) -> float:
    """Return the min_score above which this scene gets no estimate; minus infinity where other limits already reject it."""
    accept = config.accept
    ranked = rank_candidates(find_candidates(ego, other, config.vote), None, accept.prior_volume)
    if ranked is None:
        return -math.inf
    mean_pair_score = ranked.best.score / len(ranked.best.pairs)
    if ranked.margin < max(accept.min_margin, accept.runner_up_margin_pairs * mean_pair_score):
        return -math.inf
    extra_score = accept.required_score(ranked.best.num_compared, len(np.unique(ego.instant))) - accept.min_score
    return ranked.score - extra_score if len(ranked.best.pairs) >= config.accept.min_pairs else -math.inf
