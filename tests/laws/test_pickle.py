# SPDX-License-Identifier: Apache-2.0
"""Every frozen dataclass survives pickling: worker processes receive data and configurations so."""

from __future__ import annotations

import dataclasses
import importlib
import pickle
import pkgutil

import pytest
from hypothesis import given, strategies as st

import manyeyes
import manyeyes.datatypes

DATA_TYPES = [
    value
    for module in pkgutil.iter_modules(manyeyes.datatypes.__path__, "manyeyes.datatypes.")
    for value in vars(importlib.import_module(module.name)).values()
    if dataclasses.is_dataclass(value) and value.__module__ == module.name
]


def find_default_instances() -> dict[str, object]:
    """An instance of every frozen dataclass of the package that can be made without arguments, by name."""
    found = {}
    for module in pkgutil.walk_packages(manyeyes.__path__, "manyeyes."):
        for value in vars(importlib.import_module(module.name)).values():
            if dataclasses.is_dataclass(value) and value.__module__ == module.name and isinstance(value, type):
                required = [f for f in dataclasses.fields(value) if f.default is f.default_factory and f.init]
                if value.__dataclass_params__.frozen and not required:
                    found[f"{module.name}.{value.__qualname__}"] = value()
    return found


@pytest.mark.parametrize("kind", DATA_TYPES, ids=lambda kind: kind.__name__)
@given(st.data())
def test_data_types(assert_same, kind, data) -> None:
    item = data.draw(st.from_type(kind))
    assert_same(pickle.loads(pickle.dumps(item)), item)


@pytest.mark.slow
def test_configurations(assert_same) -> None:
    instances = find_default_instances()
    assert len(instances) > 50
    for name, item in instances.items():
        back = pickle.loads(pickle.dumps(item))
        assert type(back) is type(item), name
        assert_same(back, item)
