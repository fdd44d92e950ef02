# SPDX-License-Identifier: Apache-2.0
"""Registries: what users choose by name, ours and third parties' alike.

Each module of the registry's package registers what it defines, with a decorator. A third party does the same in a
module of its own distribution and names that module as an entry point of the group of the registry::

    [project.entry-points."manyeyes.fusion"]
    v2vnet = "my_package.v2vnet"

Nothing is imported before a name is asked for.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar, cast

from manyeyes.datatypes.errors import ConfigError

T = TypeVar("T")
Item = TypeVar("Item")


class Registry(Generic[T]):
    """Items of one kind by name.

    Args:
        kind: what an item is called in error texts, such as "fusion module".
        group: the group of entry points, such as "manyeyes.fusion".
        packages: what registers our own items: modules, or packages such as "manyeyes.models.fusion" with all their modules but
            those whose names begin with an underscore.
    """

    def __init__(self, kind: str, group: str, *packages: str) -> None:
        self.kind, self.group, self.packages = kind, group, packages
        self._items: dict[str, T] = {}
        self._entry_points: dict[str, EntryPoint] | None = None
        self._has_own = False

    def register(self, name: str) -> Callable[[Item], Item]:
        """Return a decorator that registers an item under a name.

        Raises:
            ConfigError: another item has the name.
        """

        def decorate(item: Item) -> Item:
            if name in self._items and not _is_same(self._items[name], item):
                raise ConfigError(
                    f"A {self.kind} called {name!r} is registered already, by {_origin(self._items[name])}; choose another name."
                )
            self._items[name] = cast(T, item)
            return item

        return decorate

    def get(self, name: str) -> T:
        """Return the item of a name.

        Raises:
            ConfigError: there is none, or the distribution that offers it cannot be imported.
        """
        self._import_own()
        if name not in self._items and name in self._offered():
            self._load(self._offered()[name])
        if name not in self._items:
            raise ConfigError(f"No {self.kind} is called {name!r}; known: {', '.join(self.names())}.")
        return self._items[name]

    def names(self) -> tuple[str, ...]:
        """Return all names: ours, then those of third parties, each in alphabetical order."""
        self._import_own()
        return (*sorted(self._items.keys() - self._offered().keys()), *sorted(self._offered()))

    def __contains__(self, name: str) -> bool:
        return name in self.names()

    def load_all(self) -> dict[str, T]:
        """Import everything and return all items by name.

        Raises:
            ConfigError: a distribution cannot be imported.
        """
        return {name: self.get(name) for name in self.names()}

    def _import_own(self) -> None:
        if self._has_own:
            return
        self._has_own = True
        for name in self.packages:
            for module in pkgutil.iter_modules(getattr(importlib.import_module(name), "__path__", ())):
                if not module.name.startswith("_"):
                    importlib.import_module(f"{name}.{module.name}")

    def _offered(self) -> dict[str, EntryPoint]:
        if self._entry_points is None:
            self._entry_points = {point.name: point for point in entry_points(group=self.group)}
        return self._entry_points

    def _load(self, point: EntryPoint) -> None:
        """Import the module that an entry point names; its decorators register its items."""
        try:
            point.load()
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            raise ConfigError(
                f"The {self.kind} {point.name!r} of {_distribution(point)} cannot be imported: {text}"
            ) from error
        if point.name not in self._items:
            raise ConfigError(
                f"The entry point {point.name!r} of {_distribution(point)} names {point.value}, which registers no {self.kind} of "
                "that name; register it there with the decorator."
            )


def _is_same(a: object, b: object) -> bool:
    """Return whether two objects are one definition; a module may be imported again."""
    return a is b or (_origin(a) == _origin(b) and getattr(a, "__qualname__", a) == getattr(b, "__qualname__", b))


def _origin(item: object) -> str:
    return str(getattr(item, "__module__", type(item).__module__))


def _distribution(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown distribution"
