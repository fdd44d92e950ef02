# SPDX-License-Identifier: Apache-2.0
"""Trust in one sender: the mean of a Beta distribution over the probability that its claims are true, which forgets.

Source: Bayesian trust of cooperative perception by pseudo-measurements (arXiv 2403.16956), with Jøsang's Beta reputation.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrustConfig:
    """Constants of trust.

    prior: alpha and beta of an unknown sender, to which both decay with half_life_s. max_support, max_fault: the most that one
    frame adds. refuted, omitted, track_fault: weights of faults, relative to a supported claim. min_trust: below it a sender is
    excluded. neutral_trust: of an unknown sender, from which on content has its full weight. returned: after an exclusion.
    """

    prior: tuple[float, float] = (2.0, 1.0)
    half_life_s: float = 5.0
    max_support: float = 3.0
    max_fault: float = 12.0
    refuted: float = 8.0
    omitted: float = 2.0
    track_fault: float = 1.0
    min_trust: float = 0.3
    neutral_trust: float = 0.67
    returned: tuple[float, float] = (1.5, 1.5)


@dataclass(frozen=True)
class BetaTrust:
    """Pseudo-counts of true (alpha) and of false claims (beta)."""

    alpha: float
    beta: float

    @property
    def mean(self) -> float:
        """The trust, in [0, 1]."""
        return self.alpha / (self.alpha + self.beta)


def decay(trust: BetaTrust, seconds: float, config: TrustConfig) -> BetaTrust:
    """Return the trust after a time without evidence; a clock that was set back changes nothing."""
    kept = 0.5 ** (max(seconds, 0.0) / config.half_life_s)
    alpha, beta = config.prior
    return BetaTrust(alpha + (trust.alpha - alpha) * kept, beta + (trust.beta - beta) * kept)


def update(trust: BetaTrust, support: float, fault: float, config: TrustConfig) -> BetaTrust:
    """Return the trust after the evidence of one frame: the weighted sums of support and of faults."""
    return BetaTrust(
        trust.alpha + min(support, config.max_support),
        trust.beta + min(fault, config.max_fault),
    )


def fusion_weight(trust: float, config: TrustConfig) -> float:
    """Return the weight of content in fusion: 1 from neutral_trust on, falling with the square of trust; 0 below min_trust."""
    return 0.0 if trust < config.min_trust else min(1.0, (trust / config.neutral_trust) ** 2)
