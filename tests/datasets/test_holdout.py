# SPDX-License-Identifier: Apache-2.0
"""Parts of a recording share nothing: scenarios are held out, or the end of a single one after a gap."""

import pytest
from tests.training.conftest import ToyRecording

from manyeyes.datasets.holdout import GAP_FRAMES, split_holdout
from manyeyes.datatypes import ConfigError


@pytest.mark.parametrize(
    ("count", "fraction", "held"), [(2, 0.25, 1), (4, 0.25, 1), (8, 0.25, 2), (10, 0.5, 5), (3, 0.9, 2)]
)
def test_scenarios_are_held_out(count, fraction, held):
    recording = ToyRecording(scenarios=tuple(f"toy_{k}" for k in range(count)), frames=3)
    training, holdout = split_holdout(recording, fraction)
    assert len(holdout.scenarios) == held
    assert sorted(training.scenarios + holdout.scenarios) == sorted(recording.scenarios)
    for part in (training, holdout):
        assert all(part.length(name) == 3 and part.eval_indices(name) == range(3) for name in part.scenarios)
    assert holdout.snapshot(holdout.scenarios[0], 1).scenario == holdout.scenarios[0]


def test_of_a_single_scenario_the_end_is_held_out():
    recording = ToyRecording(scenarios=("only",), frames=40)
    training, holdout = split_holdout(recording, 0.25)
    assert training.length("only") == 30 - GAP_FRAMES and training.eval_indices("only") == range(25)
    assert holdout.length("only") == 40 and holdout.eval_indices("only") == range(30, 40)
    assert holdout.agents("only") == (0, 1, 2)


def test_what_cannot_be_divided_is_refused():
    short = ToyRecording(scenarios=("only",), frames=6)
    with pytest.raises(ConfigError, match="'only' has 6 frames, too few"):
        split_holdout(short, 0.25)
    for fraction in (0.0, 1.0):
        with pytest.raises(ConfigError, match="between 0 and 1"):
            split_holdout(short, fraction)
