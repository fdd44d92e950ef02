# SPDX-License-Identifier: Apache-2.0
"""ERMVP's sampling (Zhang et al., CVPR 2024): a byte budget keeps the clusters of the tokens of highest learned score.

Weights of the fusion ``ermvp`` have that score, and send clusters with every strategy; others use the order of ``intermediate``.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.redundancy import distinct_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame
from manyeyes.models.detector.detector import Detector


def sampling_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return the learned score (N,) of the shared tokens; without one, that of ``intermediate``."""
    detector = cache.detector
    if not isinstance(detector, Detector) or detector.cluster_form is None:
        return distinct_score(cache, frame)
    with torch.inference_mode():
        return detector.score_for_sampling(cache.process_tokens(frame).shared_tokens)


for name, uses_history in (("intermediate-ermvp", False), ("intermediate-ermvp-temporal", True)):
    register_strategy(name)(partial(IntermediateFusion, sampling_score, uses_history))
