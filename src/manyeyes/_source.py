# SPDX-License-Identifier: Apache-2.0
"""A hash of the code that a result follows from, found from the code: kept results of other code are not taken for its own."""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from manyeyes._lazy import Definition, find_public_names

PACKAGE = Path(__file__).resolve().parent


@lru_cache(maxsize=64)
def source_digest(*modules: str, package: Path = PACKAGE) -> str:
    """Hash the import closure of modules of the package, as it was when first asked for.

    Comments, docstrings and layout do not count, statements do. Imports inside functions count, those for type checkers do not;
    what is imported by a computed name is to be given as a module of its own; all modules of a Registry count.

    Args:
        modules: full names, such as ``manyeyes.evaluation.detection.benchmark``. package: the folder of ``manyeyes``.

    Returns:
        16 hexadecimal digits.
    """
    digest = hashlib.blake2b(digest_size=8)
    for file in import_closure(*modules, package=package):
        digest.update(file.relative_to(package).as_posix().encode() + _parse(file.read_text(encoding="utf-8")).digest)
    return digest.hexdigest()


def import_closure(*roots: str, package: Path = PACKAGE) -> list[Path]:
    """Return the files that run when these modules, and all that they import of the package, are used; sorted."""
    modules = _list_modules(package)
    found: set[Path] = set()
    resolved: set[str] = set()
    left = [file for module in roots for file in _files_of(module, modules, required=True)]
    while left:
        file = left.pop()
        if file not in found:
            found.add(file)
            names = set(_parse(file.read_text(encoding="utf-8")).imports) - resolved
            resolved |= names
            left += [other for name in names for other in _files_of(name, modules)]
    return sorted(found)


class _Parsed:
    """What counts of one file: a digest of its statements, and the names in the package that it imports."""

    def __init__(self, text: str) -> None:
        tree = ast.parse(text)
        self.imports = tuple(sorted(set(_imports(tree))))
        self.public_names = find_public_names(tree)
        self.digest = hashlib.blake2b(ast.dump(_Statements().visit(tree)).encode(), digest_size=16).digest()


@lru_cache(maxsize=1024)
def _parse(text: str) -> _Parsed:
    return _Parsed(text)


class _Statements(ast.NodeTransformer):
    """Leaves out strings that stand alone: docstrings of modules, classes, functions and constants."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return None
        return node


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield names that are imported at run time; of ``from a import b`` both a and a.b, since b may be a module."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and getattr(child.test, "id", "") == "TYPE_CHECKING":
            for other in child.orelse:
                yield from _imports(other)
        elif isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            if child.level:
                raise ValueError("Relative imports are not followed; write the full name.")
            yield str(child.module)
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        else:
            if isinstance(child, ast.Call) and ast.unparse(child.func).startswith("Registry"):
                yield from (f"{argument.value}.*" for argument in child.args if isinstance(argument, ast.Constant))
            yield from _imports(child)


def _list_modules(package: Path) -> dict[str, Path]:
    """Return the files of all modules by their full names; that of a package is its ``__init__.py``."""
    modules = {}
    for folder, _, names in os.walk(package):
        parts = (package.name, *Path(folder).relative_to(package).parts)
        for name in names:
            if name.endswith(".py"):
                own = () if name == "__init__.py" else (name.removesuffix(".py"),)
                modules[".".join((*parts, *own))] = Path(folder, name)
    return modules


def _public_names(init: Path) -> dict[str, Definition]:
    return _parse(init.read_text(encoding="utf-8")).public_names


def _files_of(name: str, modules: dict[str, Path], required: bool = False) -> list[Path]:
    """Return the file of a module, or of the one that defines a public name of a package, and those of the packages that hold it,
    without the outermost; none of another package's names. A last part * stands for all modules of a package.
    """
    first, *parts = name.split(".")
    if first not in modules:
        return []
    files: list[Path] = []
    within = first
    for part in parts:
        inner = f"{within}.{part}"
        if part == "*":
            folder = modules[within].parent
            return [*files, *sorted(file for file in modules.values() if file.parent == folder)]
        if inner not in modules:
            if required:
                break
            home = _public_names(modules[within]).get(part)
            return [*files, *(_files_of(home.module, modules) if home else ())]
        files.append(modules[inner])
        within = inner
        if modules[inner].name != "__init__.py":
            return files
    if required and len(files) < max(len(parts), 1):
        raise ValueError(f"There is no module {name} below {modules[first].parent}.")
    return files
