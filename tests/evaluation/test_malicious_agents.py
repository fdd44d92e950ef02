# SPDX-License-Identifier: Apache-2.0
"""Errors of agents in a fleet with malicious ones, and the rows that are made of them."""

from dataclasses import replace

import pytest

from manyeyes.evaluation.maps.adversarial import make_attacks
from manyeyes.evaluation.maps.malicious_agents import AgentErrors, measure_agent_errors, summarize_agents
from manyeyes.evaluation.maps.registry import make_tuned_settings
from manyeyes.evaluation.statistics.proportion import Proportion


@pytest.mark.slow
def test_agents_that_displace_by_four_metres_have_larger_errors_than_honest_ones() -> None:
    (trial,) = make_attacks(("cross",), (3000,), (4.0,), 0.2)[:1]
    result = measure_agent_errors(replace(trial, num_observations=100), make_tuned_settings())
    assert (result.attack, result.fraction, result.offset_m) == ("independent", 0.2, 4.0)
    (row,) = summarize_agents([result])
    assert row.roc.area > 0.85 and row.found.value >= 0.85 and row.found.total == len(result.malicious) >= 5
    assert row.low_weight.total > 60 and row.low_weight.value < 0.05


def test_rows_pool_the_agents_of_all_trials_of_one_attack() -> None:
    def make(seed: int, offset: float, honest: tuple[float, ...], malicious: tuple[float, ...]) -> AgentErrors:
        return AgentErrors("cross", seed, "colluding", 0.2, offset, honest, malicious, (1, 10))

    trials = [make(0, 1.0, (0.1, 0.2), (3.0,)), make(1, 1.0, (2.0, 0.3), (1.0,)), make(0, 4.0, (0.1,), ())]
    (row,) = summarize_agents(trials)
    assert (row.offset_m, row.roc.num_negative, row.roc.num_positive) == (1.0, 4, 2)
    assert row.roc.area == pytest.approx(7 / 8), "one honest agent is above one malicious agent"
    assert row.found == Proportion.of(1, 2) and row.low_weight == Proportion.of(2, 20)
