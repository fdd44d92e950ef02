# SPDX-License-Identifier: Apache-2.0
"""Every strategy has two forms, and names of stored results are still read."""

import pytest

from manyeyes.agents.strategies.names import TEMPORAL, current_name, has_memory
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datatypes import ConfigError
from manyeyes.studies.replay_options import ReplayOptions

OURS = [name for name in list_strategies() if type(get_strategy(name)).__module__.startswith("manyeyes.")]


def test_every_strategy_is_there_without_and_with_memory() -> None:
    forms = [{name for name in OURS if has_memory(name) == form} for form in (False, True)]
    assert {name + TEMPORAL for name in forms[0]} == forms[1]
    assert {"no-fusion", "early", "late", "late-weighted", "intermediate"} <= forms[0]


def test_without_memory_no_older_messages_are_fused() -> None:
    assert not any(get_strategy(name).uses_history for name in OURS if not has_memory(name))


def test_only_an_ego_without_messages_does_not_wait() -> None:
    assert {name for name in OURS if not get_strategy(name).waits_for_messages} == {"no-fusion", "no-fusion-temporal"}


def test_former_names_are_read_and_written_as_todays() -> None:
    assert current_name("none") == "no-fusion" and current_name("late") == "late"
    assert type(get_strategy("none")) is type(get_strategy("no-fusion")) and "none" not in list_strategies()
    assert ReplayOptions(methods=("none", "late")).methods == ("no-fusion", "late")
    with pytest.raises(ConfigError, match="once"):
        ReplayOptions(methods=("none", "no-fusion")).make_replay_config(0)
