# SPDX-License-Identifier: Apache-2.0
"""Fractions of independent trials with the interval of Clopper and Pearson (Biometrika 1934)."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import beta

CONFIDENCE_LEVEL = 0.95


@dataclass(frozen=True)
class Proportion:
    """successes of total, with the Clopper-Pearson interval; NaN-free: 0 to 1 without trials."""

    successes: int
    total: int
    low: float
    high: float

    @classmethod
    def of(cls, successes: int, total: int) -> Proportion:
        """Return the proportion with its two-sided interval."""
        tail = (1 - CONFIDENCE_LEVEL) / 2
        low = float(beta.ppf(tail, successes, total - successes + 1)) if successes else 0.0
        high = float(beta.ppf(1 - tail, successes + 1, total - successes)) if successes < total else 1.0
        return cls(successes, total, low, high)

    @property
    def value(self) -> float:
        """The observed fraction; NaN without trials."""
        return self.successes / self.total if self.total else float("nan")
