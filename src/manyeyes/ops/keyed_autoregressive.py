# SPDX-License-Identifier: Apache-2.0
"""A first-order autoregressive process as a pure function of a key and a time: no state, no order of calls.

The process is the stationary Gaussian one of autocorrelation exp(-|lag| / correlation_time_s) and variance 1 (Uhlenbeck and
Ornstein, Physical Review 36, 1930); sampled at equal steps it is the first-order autoregressive process of that step. Time
is divided into intervals whose ends are independent draws, since they are INDEPENDENT_TIMES correlation times apart. An
interval is bisected down to the millisecond asked for; each middle is drawn given both ends, with the key of its own time.
"""

from __future__ import annotations

import math

from torch import Tensor

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_normal

RESOLUTION_NS = 1_000_000
"""Times are rounded to it."""
INDEPENDENT_TIMES = 32
"""Minimum length of an interval in correlation times; its ends have a correlation of at most exp(-32), below rounding."""


def keyed_autoregressive(size: int, time_ns: int, correlation_time_s: float, *key: int | str) -> Tensor:
    """Return the values (size,) float64 of independent processes of unit variance at a time; those of a key are one process.

    Raises:
        ConfigError: the correlation time is not a finite number above 0.
    """
    if not 0 < correlation_time_s < math.inf:
        raise ConfigError(f"A correlation time is a finite number of seconds above 0; got {correlation_time_s}.")
    tick, step_s = round(time_ns / RESOLUTION_NS), RESOLUTION_NS / 1e9
    span = 1 << max(0, math.ceil(math.log2(INDEPENDENT_TIMES * correlation_time_s / step_s)))
    left = tick // span * span
    value, right = (keyed_normal((size,), *key, end) for end in (left, left + span))
    while left != tick:
        span //= 2
        half = span * step_s / correlation_time_s
        rho, middle = math.exp(-half), left + span
        drawn = keyed_normal((size,), *key, middle)
        centre = (value + right) * (rho / (1 + rho**2)) + math.sqrt(-math.expm1(-2 * half) / (1 + rho**2)) * drawn
        if tick < middle:
            right = centre
        else:
            left, value = middle, centre
    return value
