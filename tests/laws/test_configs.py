# SPDX-License-Identifier: Apache-2.0
"""A configuration and its JSON are one: reading inverts writing, and equal configurations have equal texts."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import pytest
from hypothesis import assume, given, strategies as st

from manyeyes.datatypes import BevGrid
from manyeyes.models.checkpoint import config_from_json, config_to_json
from manyeyes.models.detector.presets import DETECTORS
from manyeyes.models.maps.presets import MAP_MODELS
from manyeyes.models.pose.feakm import FEAKM

PRESETS = {**DETECTORS, **{f"map-{name}": config for name, config in MAP_MODELS.items()}, **FEAKM}
EDGES = st.floats(-1e3, 1e3)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_its_json(name: str) -> None:
    config = PRESETS[name]
    text = config_to_json(config)
    back = config_from_json(type(config), text)
    assert back == config and config_to_json(back) == text
    assert hash(back) == hash(config) and find_lists(back) == []


def find_lists(config: Any) -> list[str]:
    """Names of fields that JSON left as lists or dictionaries."""
    values = {f.name: getattr(config, f.name) for f in fields(config)}
    nested = [name for value in values.values() if is_dataclass(value) for name in find_lists(value)]
    return nested + [name for name, value in values.items() if isinstance(value, (list, dict))]


@given(st.tuples(EDGES, EDGES, EDGES), st.tuples(EDGES, EDGES, EDGES), st.floats(0.5, 9), st.sampled_from((1, 2, 8)))
def test_numbers_keep_every_digit(first, second, pillar, stride) -> None:
    low, high = tuple(map(min, first, second)), tuple(map(max, first, second))
    assume(all(a < b for a, b in zip(low, high)))
    assume((high[0] - low[0]) * (high[1] - low[1]) <= 2**23 * pillar**2)
    grid = BevGrid(*low, *high, pillar, stride)
    assert config_from_json(BevGrid, config_to_json(grid)) == grid
