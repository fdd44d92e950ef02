# SPDX-License-Identifier: Apache-2.0
"""Bounds of a receiver."""

import dataclasses

import pytest

from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import ConfigError


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(ReceiverLimits)])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_a_bound_is_above_0(name: str, value: float) -> None:
    if (name, value) == ("max_points", 0):
        assert ReceiverLimits(max_points=0).max_points == 0
        return
    with pytest.raises(ConfigError, match=f"ReceiverLimits.{name} is a number above 0"):
        ReceiverLimits(**{name: value})
