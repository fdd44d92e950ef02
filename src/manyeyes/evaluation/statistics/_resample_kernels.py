# SPDX-License-Identifier: Apache-2.0
"""AP of many resamples in one compiled call."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F64x1, I64x1, I64x2, njit


@njit(cache=True, nogil=True)
def resample_ap(
    tp: Boolx1, row: I64x1, last: I64x1, n_gt: I64x1, weights: I64x2, max_dropped: int
) -> F64x1:  # pragma: no cover
    """Return AP (R,) of weights (R, S); NaN without truth.

    tp, row: (D,) whether a detection is true, and its scenario. last: (K,) last detection of each step of the curve. max_dropped:
    at most so many true detections of the first step are left out.
    """
    ap = np.empty(len(weights))
    precision, gain = np.empty(len(last)), np.empty(len(last))
    for r in range(len(weights)):
        drawn = weights[r]
        total = (drawn * n_gt).sum()
        seen, hits, begin = 0, 0, 0
        for k in range(len(last)):
            before, had = seen, hits
            for d in range(begin, last[k] + 1):
                seen += drawn[row[d]]
                hits += drawn[row[d]] * tp[d]
            begin = last[k] + 1
            gain[k] = hits - had
            precision[k] = hits / max(seen, 1)
            if before == 0 and seen > 0:
                gain[k] -= min(gain[k], max_dropped)
        area, envelope = 0.0, 0.0
        for k in range(len(last) - 1, -1, -1):
            envelope = max(envelope, precision[k])
            area += gain[k] * envelope
        ap[r] = area / total if total > 0 else np.nan
    return ap
