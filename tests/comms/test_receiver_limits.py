# SPDX-License-Identifier: Apache-2.0
"""Bounds of a receiver."""

import dataclasses

import pytest

from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import ConfigError

NAMES = [f.name for f in dataclasses.fields(ReceiverLimits)]


def test_no_points_may_be_accepted() -> None:
    assert ReceiverLimits(max_points=0).max_points == 0


@pytest.mark.parametrize(
    ("name", "value"), [(n, v) for n in NAMES for v in (0, -1, float("nan")) if (n, v) != ("max_points", 0)]
)
def test_a_bound_is_above_0(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"ReceiverLimits.{name} is a number above 0"):
        ReceiverLimits(**{name: value})
