# SPDX-License-Identifier: Apache-2.0
"""Small changes of the source, each of which a test should detect, and a seeded draw of them.

Not mutated: docstrings, annotations, decorators, ``__all__``, error and log texts, strings, blocks under ``TYPE_CHECKING``, numbers
of drawings (`viz`), and keywords of speed and safety (`UNOBSERVED`).
"""

from __future__ import annotations

import ast
import hashlib
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import unified_diff

UNOBSERVED = {
    "cache",
    "chunksize",
    "indent",
    "max_workers",
    "maxsize",
    "non_blocking",
    "stacklevel",
    "strict",
    "timeout",
}
LOG_CALLS = {"print", "warn", "debug", "info", "warning", "error"}
COMPARISONS: dict[type[ast.cmpop], list[type[ast.cmpop]]] = {
    ast.Lt: [ast.LtE, ast.GtE],
    ast.LtE: [ast.Lt, ast.Gt],
    ast.Gt: [ast.GtE, ast.LtE],
    ast.GtE: [ast.Gt, ast.Lt],
    ast.Eq: [ast.NotEq],
    ast.NotEq: [ast.Eq],
    ast.Is: [ast.IsNot],
    ast.IsNot: [ast.Is],
    ast.In: [ast.NotIn],
    ast.NotIn: [ast.In],
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}
EXTREMA = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}


@dataclass(frozen=True)
class Mutation:
    """Replace the bytes [start, end) of a file.

    Attributes:
        path: of the file, from the root of the repository.
        lines: first line of the statement, and the line of the replaced text.
    """

    path: str
    lines: tuple[int, int]
    start: int
    end: int
    operator: str
    replacement: str

    def apply(self, source: bytes) -> bytes:
        """The mutated file."""
        return source[: self.start] + self.replacement.encode() + source[self.end :]

    def diff(self, source: bytes) -> str:
        """The changed lines, without context."""
        old, new = source.decode().splitlines(), self.apply(source).decode().splitlines()
        return "\n".join(unified_diff(old, new, lineterm="", n=0)).split("\n", 2)[-1]


class _Finder(ast.NodeVisitor):
    """Collect the mutations of one file."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source, self.found, self.statement = path, source, list[Mutation](), 1
        lengths = [len(line) for line in source.splitlines(keepends=True)]
        self.starts = [sum(lengths[:n]) for n in range(len(lengths))]
        self.assigned: set[str] = set()
        self.visit(ast.parse(source))

    def add(self, node: ast.expr | ast.stmt, operator: str, replacement: str | ast.expr) -> None:
        assert node.end_lineno is not None and node.end_col_offset is not None
        text = replacement if isinstance(replacement, str) else f"({ast.unparse(replacement)})"
        start = self.starts[node.lineno - 1] + node.col_offset
        end = self.starts[node.end_lineno - 1] + node.end_col_offset
        self.found.append(Mutation(self.path, (self.statement, node.lineno), start, end, operator, text))

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.stmt):
            self.statement = node.lineno
        super().visit(node)

    def visit_nothing(self, node: ast.AST) -> None:
        """Leave a node as it is."""

    visit_JoinedStr = visit_Raise = visit_Assert = visit_Import = visit_ImportFrom = visit_nothing  # noqa: N815

    def visit_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        outer, self.assigned = self.assigned, {a.arg for a in (*node.args.args, *node.args.kwonlyargs)}
        for part in (*node.args.defaults, *(d for d in node.args.kw_defaults if d), *node.body):
            self.visit(part)
        self.assigned = outer

    visit_FunctionDef = visit_AsyncFunctionDef = visit_function  # noqa: N815

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for part in node.body:
            self.visit(part)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call):
            if _called_name(node.value) in LOG_CALLS:
                return
            self.add(node, "deleted call", "pass")
        self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        names = {
            n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
        if names & {"__all__", "__slots__"}:
            return
        # Deleting the only assignment of a name would always end in NameError.
        if names <= self.assigned:
            self.add(node, "deleted assignment", "pass")
        self.assigned |= names
        self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add(node, "deleted assignment", "pass")
        self.visit(node.value)

    def visit_Return(self, node: ast.Return) -> None:
        # None for False is the same condition.
        if node.value is not None and ast.unparse(node.value) not in ("None", "False"):
            self.add(node.value, "return None", "None")
        if node.value is not None:
            self.visit(node.value)

    def visit_condition(self, node: ast.If | ast.While | ast.IfExp) -> None:
        if ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'"):
            return
        if not isinstance(node.test, (ast.Compare, ast.UnaryOp)):
            self.add(node.test, "negated condition", ast.UnaryOp(ast.Not(), node.test))
        self.generic_visit(node)

    visit_If = visit_While = visit_IfExp = visit_condition  # noqa: N815

    def visit_Compare(self, node: ast.Compare) -> None:
        for n, old in enumerate(node.ops):
            for new in COMPARISONS[type(old)]:
                operators = [*node.ops[:n], new(), *node.ops[n + 1 :]]
                self.add(node, "comparison", ast.Compare(node.left, operators, node.comparators))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.add(node, "and/or", ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        value = getattr(node.operand, "value", None)
        if isinstance(node.op, ast.USub) and isinstance(value, int):
            # No other sign and no -2 for -1: the same axis, size or element, where there are two.
            self.add(node.operand, "constant", str(value - 1))
            return
        if isinstance(node.op, ast.Not):
            self.add(node, "removed not", node.operand)
        elif isinstance(node.op, ast.USub):
            self.add(node, "sign", node.operand)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        text = any(isinstance(n, ast.JoinedStr) or _is_string(n) for n in ast.walk(node))
        if type(node.op) in ARITHMETIC and not text:
            self.add(node, "arithmetic", ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right))
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = _called_name(node)
        if name in EXTREMA and not isinstance(node.func, ast.Call):
            func = (
                ast.Attribute(node.func.value, EXTREMA[name])
                if isinstance(node.func, ast.Attribute)
                else ast.Name(EXTREMA[name])
            )
            self.add(node.func, "min/max", ast.unparse(func))
        self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in UNOBSERVED:
            self.visit(node.value)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add(node, "constant", str(not value))
        elif isinstance(value, (int, float)) and not self.path.startswith("src/manyeyes/viz/"):
            if isinstance(value, int):
                # No -1 for 0, which is the same axis or element where there is one.
                for other in (value + 1, value - 1)[: 2 if value else 1]:
                    self.add(node, "constant", str(other))
            else:
                self.add(node, "constant", str(value * 2 if value else 1.0))


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (str, bytes))


def _called_name(node: ast.Call) -> str:
    return ast.unparse(node.func).rpartition(".")[2]


def find_mutations(path: str, source: bytes) -> list[Mutation]:
    """All mutations of a file, in order of its lines."""
    return sorted(_Finder(path, source).found, key=lambda m: (m.lines, m.start, m.end, m.operator, m.replacement))


def draw_mutations(sources: Mapping[str, bytes], count: int, seed: int) -> list[Mutation]:
    """Draw mutations: files in proportion to their statements, in a file each statement alike, in a statement each mutation.

    A mutation is drawn by a hash of the seed, its path and its line, so that other changes of the source leave most of a draw as
    it is (weighted sampling without replacement, Efraimidis and Spirakis, 2006).
    """
    keyed: list[tuple[float, Mutation]] = []
    for path, source in sorted(sources.items()):
        found, lines = find_mutations(path, source), source.splitlines()
        num_statements = sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(source)))
        per_statement, seen = Counter(m.lines[0] for m in found), Counter[str]()
        for mutation in found:
            name = repr((seed, path, mutation.operator, mutation.replacement, lines[mutation.lines[1] - 1].strip()))
            seen[name] += 1
            digest = hashlib.sha256(f"{name}{seen[name]}".encode()).digest()
            uniform = (int.from_bytes(digest[:8], "big") + 1) / 2**64
            weight = num_statements / len(per_statement) / per_statement[mutation.lines[0]]
            keyed.append((math.log(uniform) / weight, mutation))
    return [mutation for _, mutation in sorted(keyed, key=lambda pair: -pair[0])[:count]]
