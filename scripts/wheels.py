# SPDX-License-Identifier: Apache-2.0
"""Build sdist and wheel, install them as users do, outside the repository, and run commands in every environment.

python scripts/wheels.py [--pythons 3.11 3.12] [--extras '' sim,view map all] [--allow-cuda] [--no-readme]

Prints one row a Python version and set of extras. The exit code is 1 where something failed. A version without an interpreter,
or for which pip would install CUDA libraries, is reported as not run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
EXTRAS = ("sim,view", "", "map", "all")
"""The first one simulates the recording that the others read."""
TIMEOUT_S = 3600.0
HIDDEN = ("PYTHONPATH", "PYTHONHOME", "MANYEYES_MAPS", "MANYEYES_TOWNS", "CARLA_ROOT", "VIRTUAL_ENV", "PIP_CONSTRAINT")
"""Variables that an environment outside the repository does not have."""


@dataclass(frozen=True)
class Check:
    """A command of the matrix.

    needed: sets of extras, any one of which suffices. refusal: the extras as the error names them, and as its pip line does.
    """

    name: str
    words: tuple[str, ...]
    needed: tuple[frozenset[str], ...] = (frozenset(),)
    refusal: tuple[str, str] = ("", "")

    def runs_with(self, extras: str) -> bool:
        """Return whether it runs, and is not refused, with these extras."""
        return extras == "all" or any(needed <= set(extras.split(",")) for needed in self.needed)


CHECKS = (
    Check("--help", ("manyeyes", "--help")),
    Check("doctor", ("manyeyes", "doctor")),
    Check("example", ("python", "{sources}/examples/01_two_agents.py")),
    Check(
        "demo",
        ("manyeyes", "demo", "--frames", "6"),
        (frozenset({"sim", "view"}),),
        ("'sim' and 'view' extras", "sim,view"),
    ),
    Check(
        "pose",
        ("manyeyes", "pose", "{drive}/recording/seed-0", "--split", "test", "--frames", "3", "--noise-xy-m", "0.4"),
    ),
    Check(
        "map fuse",
        ("manyeyes", "map", "fuse", "{drive}/map", "--out", "out/fused"),
        (frozenset({"map"}), frozenset({"sim"}), frozenset({"av2"})),
        ("'map' extra", "map"),
    ),
)
MADE = {
    "demo": ("out/demo/report.html", "out/demo/results.json", "out/demo/map/map.png", "out/demo/map/map.html"),
    "pose": ("out/pose/pose.json",),
    "map fuse": ("out/fused/fuse.json", "out/fused/lines.parquet"),
}
"""Files that a command leaves in its working directory."""


@dataclass
class Row:
    """Results of one environment; install: how it went, or why it was not made."""

    python: str
    extras: str
    install: str
    results: dict[str, str] = field(default_factory=dict)

    @property
    def failed(self) -> bool:
        """Whether something did not go as expected."""
        return any(text.startswith("FAILED") for text in (self.install, *self.results.values()))


class CommandError(Exception):
    """A command that did not end as expected; the text has the end of its output."""


def run(words: list[str], cwd: Path, env: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a command and capture its output."""
    return subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)


def call(words: list[str], cwd: Path, env: dict[str, str]) -> str:
    """Run a command that must succeed; return its standard output."""
    done = run(words, cwd, env)
    if done.returncode != 0:
        tail = "\n".join((done.stdout + done.stderr).splitlines()[-25:])
        raise CommandError(f"{' '.join(words)}: exit code {done.returncode}\n{tail}")
    return done.stdout


def make_environment_variables(place: Path, binaries: Path | None = None) -> dict[str, str]:
    """Make the variables of an environment without the repository; its programs come first in PATH."""
    env = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    env |= {
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PIP_ROOT_USER_ACTION": "ignore",
        "MANYEYES_CACHE": str(place / "cache"),
        "NUMBA_CACHE_DIR": str(place / "numba"),
    }
    env.setdefault("OMP_NUM_THREADS", "1")
    if binaries is not None:
        env["PATH"] = f"{binaries}{os.pathsep}{env['PATH']}"
    return env


def read_python_versions() -> list[str]:
    """Read the Python versions of the classifiers, such as 3.11."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = (re.search(r":: (3\.\d+)$", line) for line in project["classifiers"])
    return [match[1] for match in found if match]


def find_interpreter(version: str) -> str | None:
    """Find an interpreter of a version that can make environments: this one, one in PATH, or one of pyenv."""
    name = f"python{version}"
    folders = [Path(folder) for folder in os.environ["PATH"].split(os.pathsep) if folder]
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [
        sys.executable,
        *(str(f / name) for f in folders),
        *map(str, sorted(pyenv.glob(f"{version}.*/bin/{name}"))),
    ]
    code = f"import ensurepip, sys, venv; sys.exit('%d.%d' % sys.version_info[:2] != '{version}')"
    for candidate in candidates:
        if Path(candidate).is_file() and subprocess.run([candidate, "-c", code], capture_output=True).returncode == 0:
            return candidate
    return None


def make_venv(interpreter: str, folder: Path) -> Path:
    """Make an empty environment; return the folder of its programs."""
    call([interpreter, "-m", "venv", str(folder)], folder.parent, make_environment_variables(folder.parent))
    return folder / "bin"


def build(place: Path) -> tuple[Path, Path]:
    """Build sdist and wheel of the repository, and the wheel of the sdist alone; return the wheel and the unpacked sdist.

    Raises:
        CommandError: the two wheels differ, or a wheel lacks a file or holds one that it should not.
    """
    binaries = make_venv(sys.executable, place / "build")
    env, python = make_environment_variables(place), str(binaries / "python")
    constraints = str(REPOSITORY / "constraints.txt")
    call([python, "-m", "pip", "install", "-qq", "-c", constraints, "hatchling"], place, env)
    for target in ("sdist", "wheel"):
        call([python, "-m", "hatchling", "build", "-t", target, "-d", str(place / "dist")], REPOSITORY, env)
    (sdist,), (wheel,) = (place / "dist").glob("*.tar.gz"), (place / "dist").glob("*.whl")
    with tarfile.open(sdist) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # in Python 3.11.4 and later
        archive.extractall(place / "sdist")
    (sources,) = (place / "sdist").iterdir()
    call([python, "-m", "hatchling", "build", "-t", "wheel", "-d", str(place / "again")], sources, env)
    (again,) = (place / "again").glob("*.whl")
    check_wheel(wheel, again)
    shutil.rmtree(place / "build")
    return wheel, sources


def check_wheel(wheel: Path, again: Path) -> None:
    """Check that the wheel of the sdist equals that of the repository, and that it holds the package and nothing else."""
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as two:
        names = set(one.namelist())
        differing = sorted(names ^ set(two.namelist())) or [n for n in names if one.read(n) != two.read(n)]
    if differing:
        raise CommandError(f"the wheel of the sdist differs from that of the repository: {', '.join(differing[:5])}")
    weights = {f"manyeyes/models/weights/{f.name}" for f in (REPOSITORY / "src/manyeyes/models/weights").iterdir()}
    if missing := sorted({"manyeyes/py.typed", *weights} - names):
        raise CommandError(f"the wheel lacks {', '.join(missing)}")
    unexpected = [
        n for n in names if not re.match(r"manyeyes(-[^/]+\.dist-info)?/", n) or "__pycache__" in n or "/tests/" in n
    ]
    if unexpected:
        raise CommandError(f"the wheel holds {', '.join(sorted(unexpected)[:5])}")


def find_reason_against(python: str, wheel: Path, place: Path) -> str | None:
    """Resolve all extras without installing; return why this version cannot be run, None where it can."""
    env, report = make_environment_variables(place), place / "report.json"
    words = [python, "-m", "pip", "install", "-qq", "--dry-run", "--only-binary", ":all:", "--report", str(report)]
    done = run([*words, "-c", str(REPOSITORY / "constraints.txt"), f"{wheel}[all]"], place, env)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        return f"FAILED: not resolved: {lines[-1] if lines else done.stderr[-200:]}"
    names = {str(item["metadata"]["name"]).lower() for item in json.loads(report.read_text())["install"]}
    cuda = any(name.startswith("nvidia-") for name in names)
    return "not run: no CPU build of torch (all pins resolve)" if cuda else None


def check_command(check: Check, extras: str, folder: Path, env: dict[str, str], names: dict[str, str]) -> str:
    """Run one command in an empty folder, and compare with what these extras let expect."""
    folder.mkdir(parents=True)
    words = [word.format(**names) for word in check.words]
    started = time.monotonic()
    done = run(words, folder, env)
    seconds = time.monotonic() - started
    output = (done.stdout + done.stderr).strip()
    if check.runs_with(extras):
        lacking = [made for made in MADE.get(check.name, ()) if not (folder / made).is_file()]
        if done.returncode == 0 and not lacking:
            return f"ok, {seconds:.0f} s"
        tail = "\n".join(output.splitlines()[-25:])
        print(f"{' '.join(words)}: exit code {done.returncode}, missing {lacking}\n{tail}", file=sys.stderr, flush=True)
        return f"FAILED: exit code {done.returncode}"
    names, extra = check.refusal
    line = f"pip install 'manyeyes[{extra}]' (in a checkout: pip install -e '.[{extra}]')"
    expected = f"manyeyes: {check.name} needs the {names}: {line}"
    if done.returncode == 1 and output == expected and not any(folder.iterdir()):
        return "refused"
    print(f"{' '.join(words)}: expected the refusal\n{expected}\ngot\n{output[-2000:]}", file=sys.stderr, flush=True)
    return "FAILED: not refused"


def set_times(package: Path) -> None:
    """Set one time for every source: numba compiles a file again whose time differs from that in its cache."""
    for source in package.rglob("*.py"):
        os.utime(source, (1_000_000_000, 1_000_000_000))


def check_environment(row: Row, interpreter: str, wheel: Path, sources: Path, place: Path) -> None:
    """Install the wheel with a row's extras in a new environment and run all commands there."""
    home = place / "environment"  # the same path for all, so that they share the cache of compiled loops
    home.mkdir()
    binaries = make_venv(interpreter, home / "venv")
    env, started = make_environment_variables(place, binaries), time.monotonic()
    requirement = f"{wheel}[{row.extras}]" if row.extras else str(wheel)
    constraints = str(sources / "constraints.txt")
    try:
        call([str(binaries / "python"), "-m", "pip", "install", "-qq", "-c", constraints, requirement], home, env)
        where = call([str(binaries / "python"), "-c", "import manyeyes; print(manyeyes.__file__)"], home, env).strip()
        if not where.startswith(str(home)):
            raise CommandError(f"manyeyes is imported from {where}")
        set_times(Path(where).parent)
        call([str(binaries / "python"), "-m", "compileall", "-qq", str(Path(where).parent)], home, env)
    except CommandError as error:
        print(error, file=sys.stderr, flush=True)
        row.install = "FAILED"
        return
    row.install = f"ok, {time.monotonic() - started:.0f} s"
    drive = place / "drive"
    for check in CHECKS:
        if "{drive}" in " ".join(check.words) and not drive.exists():
            row.results[check.name] = "not run: no recording"
            continue
        folder = home / check.name.strip("-").replace(" ", "-")
        names = {"sources": str(sources), "drive": str(drive)}
        row.results[check.name] = check_command(check, row.extras, folder, env, names)
        print(f"{row.python} [{row.extras}] {check.name}: {row.results[check.name]}", flush=True)
        made = folder / "out" / "demo"
        if check.name == "demo" and made.exists() and not drive.exists():
            made.rename(drive)
    shutil.rmtree(home)


def find_install_blocks(readme: str) -> list[str]:
    """Return the blocks of commands in the README's section Install."""
    section = readme.partition("\n## Install\n")[2].partition("\n## ")[0]
    return re.findall(r"^```\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)


def check_readme(wheel: Path, sources: Path, place: Path) -> Iterator[str]:
    """Run each block of the README's section Install, verbatim, in an empty environment and a copy of the sources."""
    blocks = find_install_blocks((sources / "README.md").read_text(encoding="utf-8"))
    if not blocks:
        yield "FAILED: README.md has no commands in its section Install"
    for number, block in enumerate(blocks):
        home = place / f"readme-{number}"
        shutil.copytree(sources, home / "manyeyes")
        binaries = make_venv(sys.executable, home / "venv")
        env = make_environment_variables(place, binaries)
        env["PIP_CONSTRAINT"] = str(sources / "constraints.txt")
        try:
            call(["bash", "-euo", "pipefail", "-c", block], home / "manyeyes", env)
            call([str(binaries / "manyeyes"), "--help"], home, env)
            call([str(binaries / "manyeyes"), "doctor"], home, env)
            yield f"ok: {' && '.join(block.split(chr(10))).strip(' &')}"
        except CommandError as error:
            print(error, file=sys.stderr, flush=True)
            yield f"FAILED: {block.strip()}"
        shutil.rmtree(home)


def print_table(rows: list[Row]) -> None:
    """Print one line a row."""
    headings = ["python", "extras", "install", *(check.name for check in CHECKS)]
    lines = [
        [row.python, f"[{row.extras}]", row.install, *(row.results.get(check.name, "-") for check in CHECKS)]
        for row in rows
    ]
    widths = [max(len(line[k]) for line in [headings, *lines]) for k in range(len(headings))]
    print()
    for line in [headings, ["-" * width for width in widths], *lines]:
        print("| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths)) + " |")


def check_version(
    version: str, extras: list[str], allow_cuda: bool, built: tuple[Path, Path], place: Path
) -> list[Row]:
    """Check all sets of extras on one version of Python."""
    interpreter = find_interpreter(version)
    if interpreter is None:
        return [Row(version, chosen, "not run: no interpreter") for chosen in extras]
    folder = place / f"resolve-{version}"
    reason = find_reason_against(str(make_venv(interpreter, folder) / "python"), built[0], place)
    shutil.rmtree(folder)
    if reason is not None and not (allow_cuda and reason.startswith("not run")):
        return [Row(version, chosen, reason) for chosen in extras]
    rows = [Row(version, chosen, "") for chosen in extras]
    for row in rows:
        check_environment(row, interpreter, *built, place)
    return rows


def main() -> int:
    """Build, install and run; print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", default=read_python_versions())
    parser.add_argument("--extras", nargs="+", default=list(EXTRAS))
    parser.add_argument("--allow-cuda", action="store_true", help="also where pip installs CUDA libraries, several GB")
    parser.add_argument("--no-readme", action="store_true", help="leave out the lines of the README")
    arguments = parser.parse_args()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="manyeyes-wheels-") as folder:
        place = Path(folder)
        wheel, sources = build(place)
        print(
            f"{wheel.name}: equals the wheel of {sources.name}.tar.gz; with weights and py.typed, without tests",
            flush=True,
        )
        rows: list[Row] = []
        for version in arguments.pythons:
            rows += check_version(version, arguments.extras, arguments.allow_cuda, (wheel, sources), place)
        readme = [] if arguments.no_readme else list(check_readme(wheel, sources, place))
    print_table(rows)
    print("".join(f"\nREADME: {line}" for line in readme))
    print(f"{time.monotonic() - started:.0f} s")
    return int(any(row.failed for row in rows) or any(line.startswith("FAILED") for line in readme))


if __name__ == "__main__":
    raise SystemExit(main())
