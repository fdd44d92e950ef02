# SPDX-License-Identifier: Apache-2.0
"""ERMVP's sampling (Zhang et al., CVPR 2024): a byte budget keeps the clusters of the tokens of highest learned score.

It needs weights of the fusion ``ermvp``, whose tokens every strategy sends as clusters; only the order under a budget differs.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, ConfigError
from manyeyes.models.detector.detector import Detector


def sampling_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return the learned score (N,) of the shared tokens."""
    detector = cache.detector
    if not isinstance(detector, Detector):
        raise ConfigError("intermediate-ermvp needs weights of the fusion ermvp.")
    with torch.inference_mode():
        return detector.score_for_sampling(cache.process_tokens(frame).shared_tokens)


for name, uses_history in (("intermediate-ermvp", False), ("intermediate-ermvp-temporal", True)):
    register_strategy(name)(partial(IntermediateFusion, sampling_score, uses_history))
