# SPDX-License-Identifier: Apache-2.0
"""Mutate the source in a seeded draw and list the mutants that no test detects: ``python tests/probes/mutants.py``.

Modules are drawn in proportion to their statements, in a module a statement, in a statement a mutation. Each mutant runs in a copy
of the repository against the test files mapped to its module: those named after it, then those that import it, directly, through
other modules or by names in tables of modules; fast tests first, slow ones only where the fast ones pass. Tests that fail on a
mutant run once more without it at the end, and do not count where they fail there too. A mutant that behaves as the original
counts as a survivor. cosmic-ray and mutmut run one command over all tests for all mutants; neither draws by seed.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import signal
import subprocess
import sys
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from mutations import Mutation, draw_mutations, find_mutations as find_mutations
from numba.core import config as numba_config

from manyeyes._lazy import find_public_names

ROOT = Path(__file__).resolve().parents[2]
FAST, SLOW = "not slow and not training", "slow or training"


def read_sources(pattern: str) -> dict[str, bytes]:
    """Files of the repository by their paths in it."""
    return {path.relative_to(ROOT).as_posix(): path.read_bytes() for path in sorted(ROOT.glob(pattern))}


def module_name(path: str) -> str:
    """The module of a file under src."""
    return path.removeprefix("src/").removesuffix(".py").replace("/", ".").removesuffix(".__init__")


class ImportGraph:
    """Which modules of the package each file imports; public names of packages are followed to their modules."""

    def __init__(self, sources: Mapping[str, bytes], tests: Mapping[str, bytes]) -> None:
        trees = {module_name(path): ast.parse(source) for path, source in sources.items()}
        packages = {module_name(path) for path in sources if path.endswith("/__init__.py")}
        self.public = {name: find_public_names(tree) if name in packages else {} for name, tree in trees.items()}
        self.tests = {path: self._imports(ast.parse(source)) for path, source in tests.items()}
        self.importers: dict[str, set[str]] = defaultdict(set)
        for name, tree in trees.items():
            # A package with public names imports them only at their use.
            named = self._imports(tree) | self._named(tree, name.rpartition(".")[0])
            for imported in () if self.public[name] else named:
                self.importers[imported].add(name)

    def _imports(self, tree: ast.AST) -> set[str]:
        names = set[str]()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names |= {node.module, *(self._resolve(node.module, alias.name) for alias in node.names)}
        return names & self.public.keys()

    def _named(self, tree: ast.AST, package: str) -> set[str]:
        """Modules that strings name: in full or by their package, or word by word from the package of the file."""
        strings = {
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        words = {word for text in strings for word in re.split(r"[. ]", text.replace("-", "_"))}
        return {
            name
            for name in self.public
            if name in strings
            or name.rpartition(".")[0] in strings - {"manyeyes"}
            or (name.startswith(f"{package}.") and set(name.removeprefix(f"{package}.").split(".")) <= words)
        }

    def _resolve(self, module: str, name: str) -> str:
        if f"{module}.{name}" in self.public:
            return f"{module}.{name}"
        definition = self.public.get(module, {}).get(name)
        return self._resolve(definition.module, definition.name) if definition else module

    def find_importers(self, module: str) -> dict[str, int]:
        """Modules that import a module, by the number of imports between; the module itself is 0 away."""
        distance, front = {module: 0}, [module]
        for name in front:
            for importer in sorted(self.importers[name] - distance.keys()):
                distance[importer] = distance[name] + 1
                front.append(importer)
        return distance

    def rank_tests(self, module: str) -> list[str]:
        """Test files that reach a module: those named after it, then by imports between less shared words, the narrowest first."""
        distance = self.find_importers(module)
        parts = [part.removesuffix("s") for part in module.split(".")[1:]]

        def key(path: str) -> tuple[bool, int, int, str]:
            near = min(distance[name] for name in self.tests[path] & distance.keys())
            shared = sum(part in path for part in parts)
            return not _named_after(path, module), near - shared, len(self.tests[path]), path

        return sorted((path for path in self.tests if self.tests[path] & distance.keys()), key=key)


def _named_after(path: str, module: str) -> bool:
    """Whether a test file is named after a module, or after its package and it (test_map_metrics for maps.metrics)."""
    *folders, name = module.replace("._", ".").split(".")
    parents = {"", *(f"{folder.removesuffix('s')}_" for folder in folders), *(f"{folder}_" for folder in folders)}
    return Path(path).stem.removeprefix("test_") in {parent + name for parent in parents}


@dataclass(frozen=True)
class Outcome:
    """A mutant, the test files mapped to it, and the test that failed, empty where none did."""

    mutation: Mutation
    files: list[str]
    killer: str


class Copy:
    """A copy of the repository in which mutants run, with a cache of compiled loops of its own.

    Each run of pytest is a fork of this process, which has imported the large libraries once.
    """

    def __init__(self, root: Path, folder: Path, timeout_s: float, selections: Sequence[str] = (FAST, SLOW)) -> None:
        self.root, self.folder, self.timeout_s, self.selections = root, folder, timeout_s, selections
        self.passing, self.failing = set[str](), set[str]()
        (folder / ".caches" / "numba").mkdir(parents=True, exist_ok=True)
        words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        for name in subprocess.run(words, cwd=root, check=True, capture_output=True, text=True).stdout.split("\0"):
            if name and (root / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / name, folder / name)

    def run_tests(self, words: list[str], cache: str = "numba", limit: int = 1) -> tuple[int | None, str]:
        """Exit status of a run of pytest (None after the timeout), and what it printed."""
        process = get_context("fork").Process(
            target=_run_pytest, args=(self.folder, words, self.folder / ".caches" / cache)
        )
        process.start()
        try:
            process.join(limit * self.timeout_s)
            status = process.exitcode
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid or 0, signal.SIGKILL)
            process.join()
        return status, (self.folder / ".output").read_text()

    def find_killer(self, mutation: Mutation, files: list[str], importers: Collection[str] = ()) -> str:
        """The first test that fails on a mutant, or the file whose run does not end; empty where all pass.

        importers: of the mutated module. Loops of theirs may hold its own, and numba compares only the file of the outer loop.
        """
        compiled, cache = b"njit" in (self.root / mutation.path).read_bytes(), "numba"
        if compiled:
            stale, cache = {name.rpartition(".")[2] for name in importers}, f"mutant-{os.getpid()}"
            shutil.copytree(
                self.folder / ".caches" / "numba",
                self.folder / ".caches" / cache,
                ignore=lambda _, names: [name for name in names if name.partition(".")[0] in stale],
            )
        path = self.folder / mutation.path
        path.write_bytes(mutation.apply((self.root / mutation.path).read_bytes()))
        try:
            for selection in self.selections:
                for file in files:
                    words = ["-x", "-m", selection, file, *(f"--deselect={test}" for test in sorted(self.failing))]
                    status, output = self.run_tests(words, cache, limit=4 if compiled else 1)
                    if status not in (0, 5):
                        return next(iter(_find_failing(output)), file)
            return ""
        finally:
            shutil.copy2(self.root / mutation.path, path)
            for bytecode in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
                bytecode.unlink()
            if compiled:
                shutil.rmtree(self.folder / ".caches" / cache, ignore_errors=True)

    def find_broken(self, tests: set[str]) -> set[str]:
        """Those of the tests, or of the files whose run did not end, that do so without mutation; they are left out then."""
        files = {test for test in tests - self.passing if "::" not in test}
        named = sorted(tests - self.passing - files)
        broken = {file for file in files if self.run_tests([file])[0] not in (0, 1, 5)}
        if named:
            status, output = self.run_tests(named, limit=8)
            if status not in (0, 1):
                raise SystemExit(f"The tests do not end without mutation: exit status {status}.\n{output[-3000:]}")
            broken |= set(_find_failing(output))
        self.failing |= broken
        self.passing |= tests - broken
        return broken


def _run_pytest(folder: Path, words: list[str], cache: Path) -> None:
    os.setsid()
    os.chdir(folder)
    sys.stdout = sys.stderr = output = Path(".output").open("w", encoding="utf-8")  # noqa: SIM115
    os.dup2(output.fileno(), 1)
    os.dup2(output.fileno(), 2)
    sys.path[:0] = [str(folder), str(folder / "src")]
    os.environ["PYTHONPATH"] = os.pathsep.join([str(folder / "src"), os.environ.get("PYTHONPATH", "")])
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    numba_config.reload_config()
    for name in [name for name in sys.modules if name.partition(".")[0] == "manyeyes"]:
        del sys.modules[name]
    sys.exit(pytest.main(["--tb=no", "-rfE", "--no-header", *words]))


def _find_failing(output: str) -> list[str]:
    return re.findall(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", output, re.MULTILINE)


def run_mutants(copy: Copy, mutations: Iterable[Mutation], graph: ImportGraph, num_files: int) -> Iterator[Outcome]:
    """Run each mutant against its test files; afterwards the failing tests without mutation, and again where they fail there."""
    while mutations:
        killers: dict[Mutation, str] = {}
        for mutation in mutations:
            module = module_name(mutation.path)
            files = graph.rank_tests(module)[:num_files]
            killers[mutation] = copy.find_killer(mutation, files, graph.find_importers(module))
            yield Outcome(mutation, files, killers[mutation])
        broken = copy.find_broken({killer for killer in killers.values() if killer})
        mutations = [mutation for mutation, killer in killers.items() if killer in broken]


def main() -> int:
    """Draw, run, and list the survivors; 1 where fewer than the wanted fraction are killed."""
    parser = ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--files", type=int, default=8, help="most test files of a module")
    parser.add_argument("--timeout-s", type=float, default=300.0, help="of a test file on a mutant")
    parser.add_argument("--min-killed", type=float, default=0.95, help="fraction below which the exit status is 1")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of drawn mutants; the others do not run")
    parser.add_argument(
        "--work", type=Path, help="folder of the copy, kept with its compiled loops; default: temporary"
    )
    parser.add_argument("--fast", action="store_true", help="run no slow tests")
    parser.add_argument("--list", action="store_true", help="print the draw and run nothing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    os.environ.setdefault("HYPOTHESIS_PROFILE", "fast")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    read = read_sources("src/**/*.py")
    drawn = draw_mutations(read, options.count, options.seed)
    numbers = {mutation: number for number, mutation in enumerate(drawn, 1)}
    chosen = [m for m in drawn if not options.only or numbers[m] in options.only]

    def describe(mutation: Mutation) -> str:
        place = f"{mutation.path}:{mutation.lines[1]}"
        return f"{numbers[mutation]:3} {place} ({mutation.operator})\n{mutation.diff(read[mutation.path])}"

    if options.list:
        print("\n".join(describe(m) for m in chosen))
        return 0
    graph = ImportGraph(read, read_sources("tests/**/test_*.py"))
    outcomes: dict[Mutation, Outcome] = {}
    with TemporaryDirectory() as temporary:
        selections = (FAST,) if options.fast else (FAST, SLOW)
        copy = Copy(ROOT, options.work or Path(temporary), options.timeout_s, selections)
        for outcome in run_mutants(copy, chosen, graph, options.files):
            outcomes[outcome.mutation] = outcome
            print(f"{describe(outcome.mutation)}\n    {outcome.killer or 'SURVIVED'}", flush=True)
    survivors = [outcome for outcome in outcomes.values() if not outcome.killer]
    print(f"\nseed {options.seed}: {len(chosen) - len(survivors)} of {len(chosen)} killed; survivors:")
    for outcome in survivors:
        print(f"{describe(outcome.mutation)}\n    tests: {' '.join(outcome.files) or 'none imports the module'}")
    return int(len(chosen) - len(survivors) < options.min_killed * len(chosen))


if __name__ == "__main__":
    sys.exit(main())
