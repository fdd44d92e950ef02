# SPDX-License-Identifier: Apache-2.0
"""Agreement of the ego's own boxes with boxes of a fusion, for baselines that compare whole results."""

from __future__ import annotations

import numpy as np

from manyeyes.agents.trust.association import Floats, associate
from manyeyes.datatypes import Boxes

SAME_OBJECT_M = 2.0


def jaccard(own: Boxes, fused: Boxes) -> float:
    """Return the number of objects in both over that in either, in [0, 1]; 1 of two empty sets."""
    num_pairs = int((_partners(own, fused) >= 0).sum())
    total = len(own) + len(fused) - num_pairs
    return num_pairs / total if total else 1.0


def consistency_loss(own: Boxes, fused: Boxes, min_score: float) -> float:
    """Return one minus the Jaccard index of scores: sum of the smaller over sum of the larger score of each object, in [0, 1].

    Of boxes below min_score nothing is compared, but an object of which one set has a higher score counts with both.
    """
    partner = _partners(own, fused)
    mine, theirs = own.score.double().numpy(), fused.score.double().numpy()
    other = np.append(theirs, 0.0)[partner]
    is_single = np.ones(len(theirs), np.bool_)
    is_single[partner[partner >= 0]] = False
    low = np.concatenate((np.minimum(mine, other), np.zeros(is_single.sum())))
    high = np.concatenate((np.maximum(mine, other), theirs[is_single]))
    is_compared = high >= min_score
    total = float(high[is_compared].sum())
    return 1.0 - float(low[is_compared].sum()) / total if total else 0.0


def _partners(one: Boxes, other: Boxes) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    places: list[Floats] = [boxes.center[:, :2].double().numpy() for boxes in (one, other)]
    return associate(places[0], places[1], SAME_OBJECT_M)
