# SPDX-License-Identifier: Apache-2.0
"""When to answer: the least score at which pairs of agents that share no object are answered no more often than asked.

Traffic stands in lanes and rows, so that chance agreement is far more frequent than independent places would make it:
the limit is measured on scenes like those of use, never computed (specs/pose.md 4.3).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import Acceptance, CorrectorConfig, rank
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import candidates


def calibrated(
    nulls: Iterable[tuple[Landmarks, Landmarks]], wrong_accepts: float, config: CorrectorConfig | None = None
) -> Acceptance:
    """The acceptance whose rate of answers on null scenes is at most ``wrong_accepts``, its other limits as
    configured.

    nulls: what two agents see that have no object in common, without a claim. At least 2 / wrong_accepts scenes are
    needed.
    """
    config = config or CorrectorConfig()
    scores = sorted((_accepted_from(*pair, config) for pair in nulls), reverse=True)
    allowed = math.floor(wrong_accepts * len(scores))
    if not 0 < wrong_accepts < 1 or len(scores) * wrong_accepts < 2:
        raise ConfigError(
            f"A rate of {wrong_accepts} needs at least {math.ceil(2 / max(wrong_accepts, 1e-9))} null scenes; "
            f"got {len(scores)}. Give more scenes or allow more."
        )
    # Just above the best scene that may no longer be answered.
    least = math.nextafter(max(scores[allowed], 0.0), math.inf)
    return replace(config.accept, least_score=least)


def _accepted_from(ego: Landmarks, other: Landmarks, config: CorrectorConfig) -> float:
    """The least_score above which this scene gets no answer; minus infinity where other limits already refuse it."""
    more = config.accept.per_instant * max(len(np.unique(ego.instant)) - 1, 0)
    ranked = rank(candidates(ego, other, config.vote), None, config.accept.anywhere)
    if ranked is None or ranked.margin < config.accept.least_margin:
        return -math.inf
    return ranked.score - more if len(ranked.best.pairs) >= config.accept.least_pairs else -math.inf
