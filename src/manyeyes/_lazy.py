# SPDX-License-Identifier: Apache-2.0
"""Public names of packages, imported at their first use (PEP 562), so that importing a package takes milliseconds.

A package lists its public names once, as imports ``from module import Name as Name`` under ``if TYPE_CHECKING``: type checkers
read them there, and so does `attach`.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple


class Definition(NamedTuple):
    """Where a public name is defined: the module, and the name there."""

    module: str
    name: str


def attach(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the functions ``__getattr__``, which serves ``__all__`` too, and ``__dir__`` of a package.

    Args:
        package: the ``__name__`` of the package that calls this.
    """

    @lru_cache(maxsize=1)
    def definitions() -> dict[str, Definition]:
        loader: Any = sys.modules[package].__loader__
        return find_public_names(ast.parse(loader.get_source(package)))

    def import_name(name: str) -> Any:
        if name == "__all__":
            return sorted(definitions())
        if name.startswith("__") or name not in definitions():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        definition = definitions()[name]
        value = getattr(importlib.import_module(definition.module), definition.name)
        setattr(sys.modules[package], name, value)
        return value

    return import_name, lambda: sorted({*vars(sys.modules[package]), *definitions()})


def find_public_names(tree: ast.Module) -> dict[str, Definition]:
    """Find the names that a package imports under ``if TYPE_CHECKING``; none of a package that imports them at once."""
    return {
        alias.asname or alias.name: Definition(str(node.module), alias.name)
        for block in tree.body
        if isinstance(block, ast.If) and getattr(block.test, "id", "") == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
