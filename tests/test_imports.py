# SPDX-License-Identifier: Apache-2.0
"""No two modules of the package import each other, directly or by way of others; imports for type checkers count."""

from __future__ import annotations

from collections.abc import Mapping, Set
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest


def check_acyclic(imports: Mapping[str, Set[str]]) -> None:
    """Raise CycleError with the modules of one cycle."""
    TopologicalSorter(imports).prepare()


def test_no_two_modules_import_each_other() -> None:
    graph = grimp.build_graph("manyeyes", cache_dir=None)
    assert len(graph.modules) > 300
    check_acyclic({module: graph.find_modules_directly_imported_by(module) for module in graph.modules})


def test_a_cycle_is_found() -> None:
    with pytest.raises(CycleError, match="cycle"):
        check_acyclic({"a": {"b"}, "b": {"c"}, "c": {"a"}})
