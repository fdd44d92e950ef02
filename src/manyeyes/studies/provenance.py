# SPDX-License-Identifier: Apache-2.0
"""Where numbers come from: configuration, seed, versions and commit, written beside every result."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any

from manyeyes import __version__
from manyeyes._io import atomic_write_text

RECORDED_PACKAGES = (
    "torch", "numpy", "numba", "safetensors", "tyro", "rich", "PyYAML", "zstandard", "eclipse-sumo", "libsumo",
    "shapely", "pyarrow", "matplotlib", "pillow",
)  # fmt: skip


def installed_versions() -> dict[str, str | None]:
    """Installed versions of everything that may change a number; None for what is absent."""
    found: dict[str, str | None] = {"manyeyes": __version__, "python": platform.python_version()}
    for name in RECORDED_PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def git_commit() -> str | None:
    """Return the commit of the sources that run, with ``+changes`` if tracked files differ.

    An installed package has one if pip installed it from a repository (``pip install git+URL``); else None.
    """
    package = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str | None:
        command = ["git", "-C", str(package), *words]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # A package installed inside another project's repository must not report that repository's commit.
    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return _find_installed_commit(package)
    commit = git("rev-parse", "HEAD")
    return commit and commit + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")


def _find_installed_commit(package: Path) -> str | None:
    """Return the commit that pip recorded beside an installed package (PEP 610), if it is this one."""
    try:
        installed = importlib.metadata.distribution("manyeyes")
        origin = json.loads(installed.read_text("direct_url.json") or "{}")
    except (importlib.metadata.PackageNotFoundError, OSError, ValueError):
        return None
    if Path(str(installed.locate_file("manyeyes"))).resolve() != package.resolve():
        return None
    source = origin.get("vcs_info") if isinstance(origin, dict) else None
    return source.get("commit_id") if isinstance(source, dict) else None


def cpu_name() -> str:
    """Return the processor's name as the system reports it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def collect_provenance(config: object, seed: int | None) -> dict[str, Any]:
    """What a reader needs to get the same numbers again. config: a dataclass or plain values."""
    from manyeyes.models.pretrained import product_type  # brings torch, which 'doctor --help' need not import

    return {
        "command": shlex.join([*_program(sys.argv[0]), *sys.argv[1:]]),
        "config": to_plain(config),
        "seed": seed,
        "versions": installed_versions(),
        "git_commit": git_commit(),
        "machine": {
            "system": platform.platform(),
            "cpu": cpu_name(),
            "cores": os.cpu_count(),
            "products": product_type(),
        },
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _program(path: str) -> list[str]:
    """Return the words that start the program: a script that was named by a relative path, else the command manyeyes."""
    is_script = path.endswith(".py") and not Path(path).is_absolute()
    return ["python", path] if is_script else ["manyeyes"]


def to_plain(value: object) -> Any:
    """Return a value as JSON can hold it: dataclasses become objects, paths text, NaN and infinity null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_plain(v) for v in value]
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if hasattr(value, "tolist"):
        return to_plain(value.tolist())  # type: ignore[union-attr]
    return str(value)


def write_json(path: Path, payload: object, config: object, seed: int | None) -> dict[str, Any]:
    """Writes ``{"provenance": …, "result": payload}``, whole or not at all, and returns the provenance."""
    origin, text = render_json(payload, config, seed)
    atomic_write_text(path, text)
    return origin


def render_json(payload: object, config: object, seed: int | None) -> tuple[dict[str, Any], str]:
    """Return the provenance, and the text that :func:`write_json` writes."""
    origin = collect_provenance(config, seed)
    text = json.dumps({"provenance": origin, "result": to_plain(payload)}, indent=2, ensure_ascii=False)
    return origin, text + "\n"
