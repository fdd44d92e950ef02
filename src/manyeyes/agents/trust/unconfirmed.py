# SPDX-License-Identifier: Apache-2.0
"""Messages with far more unconfirmed objects than honest detectors state, of which nothing is fused.

A single unconfirmed claim is no evidence, since agents see what others do not. Dozens of them in one message, each of a high score,
are: an honest agent in the same place shares most of what it sees with the ego or with other senders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.agents.trust.interface import AssessedClaims


@dataclass(frozen=True)
class UnconfirmedConfig:
    """Numbers of unconfirmed claims of a message.

    limits: pairs of a score and how many claims of at least that score may be unconfirmed; per_confirmed: how many more for each
    confirmed one. num_messages: a sender is left out while one of its last so many messages exceeds a limit. Chosen on Town07 and
    the training towns, where the limits concern none and 4 in 1,000 of the honest messages of late fusion.
    """

    limits: Sequence[tuple[float, int]] = ((0.8, 6), (0.5, 20))
    per_confirmed: float = 0.5
    num_messages: int = 5


def has_excess(claims: AssessedClaims, config: UnconfirmedConfig) -> bool:
    """Return whether more claims of a message are unconfirmed than the limits allow."""
    score, is_confirmed = claims.claims.score, claims.is_confirmed
    for min_score, max_claims in config.limits:
        is_likely = score >= min_score
        num_confirmed = np.count_nonzero(is_likely & is_confirmed)
        if np.count_nonzero(is_likely) - num_confirmed > max_claims + config.per_confirmed * num_confirmed:
            return True
    return False
