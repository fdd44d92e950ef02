# SPDX-License-Identifier: Apache-2.0
"""The keyed process has the moments and the autocorrelation of a first-order autoregressive one, and no state."""

import math

import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_autoregressive import keyed_autoregressive

STEP_NS = 100_000_000


def sample(times_ns, tau_s=10.0, *key):
    return torch.stack([keyed_autoregressive(2, t, tau_s, 4, *key) for t in times_ns])


def test_autocorrelation_falls_exponentially_with_the_lag():
    """Values of many keys at six times: correlation of each pair, and variance 1 at each."""
    lags = (0, 1, 10, 50, 100, 300)
    values = torch.stack([keyed_autoregressive(400, k * STEP_NS, 10.0, seed) for seed in range(4) for k in lags])
    values = values.view(4, len(lags), 400).transpose(1, 2).reshape(1600, len(lags))
    assert values.mean(0).abs().max() < 0.08 and values.var(0).tolist() == pytest.approx([1] * len(lags), abs=0.12)
    found = (values[:, :1] * values).mean(0) / values.var(0).mean()
    assert found.tolist() == pytest.approx([math.exp(-lag / 100) for lag in lags], abs=0.06)


def test_steps_at_equal_lags_are_independent_innovations():
    """First-order: what is left of a value after rho times the one before does not correlate with the past."""
    tau_s, rho = 0.5, math.exp(-0.2)
    values = sample([k * STEP_NS for k in range(1500)], tau_s)
    innovation = (values[1:] - rho * values[:-1]) / math.sqrt(1 - rho**2)
    assert innovation.var(0).tolist() == pytest.approx([1, 1], abs=0.12)
    assert abs(float((innovation[1:] * innovation[:-1]).mean())) < 0.05
    assert abs(float((innovation * values[:-1]).mean())) < 0.05


def test_the_covariance_across_the_ends_of_intervals_is_the_same():
    """Steps over a boundary of the bisection are not larger than others: 2 (1 - rho) is their mean square."""
    tau_s, end_ns = 0.1, 4_096_000_000
    steps = [
        keyed_autoregressive(3, end_ns + h, tau_s, s) - keyed_autoregressive(3, end_ns - h, tau_s, s)
        for s in range(300)
        for h in (10_000_000,)
    ]
    assert float(torch.stack(steps).square().mean()) == pytest.approx(2 * (1 - math.exp(-0.2)), rel=0.15)


def test_values_depend_on_key_and_time_alone():
    times = [5 * STEP_NS, 17 * STEP_NS, -3 * STEP_NS, 1_700_000_000_000_000_000]
    forward, backward = sample(times), sample(times[::-1]).flip(0)
    assert torch.equal(forward, backward) and len(forward.unique()) == forward.numel()
    assert torch.equal(sample(times)[1], keyed_autoregressive(2, times[1], 10.0, 4))
    assert not torch.equal(sample(times, 10.0, "other"), forward)


@pytest.mark.parametrize("tau_s", [0.0, -1.0, math.inf, math.nan])
def test_an_impossible_correlation_time_is_refused(tau_s):
    with pytest.raises(ConfigError, match="above 0"):
        keyed_autoregressive(1, 0, tau_s)
