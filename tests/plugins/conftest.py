# SPDX-License-Identifier: Apache-2.0
"""A small recording, and packages of third parties installed into a folder of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parent
Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with a test split and a train split."""
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    from manyeyes.simulator.presets import simulate

    folder = tmp_path_factory.mktemp("recording") / "drive"
    simulate("smoke-opv2v", folder)
    return folder


@pytest.fixture(scope="session")
def install(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Install a package of this folder by pip, without network, and return the folder with its modules."""

    def install_package(name: str) -> Path:
        target = tmp_path_factory.mktemp("site") / name
        options = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(target))
        # A copy, since setuptools builds beside the source.
        source = tmp_path_factory.mktemp("source") / name
        source.mkdir()
        for file in (PLUGINS / name).iterdir():
            if file.is_file():
                (source / file.name).write_bytes(file.read_bytes())
        done = subprocess.run(
            [sys.executable, "-m", "pip", "install", *options, str(source)], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return target

    return install_package


@pytest.fixture
def manyeyes() -> Run:
    """Run a command of manyeyes in a process that finds the packages of one more folder."""

    def run(site: Path | None, *words: str) -> subprocess.CompletedProcess[str]:
        folders = [str(site)] if site else []
        path = os.pathsep.join((*folders, *filter(None, [os.environ.get("PYTHONPATH")])))
        return subprocess.run(
            [sys.executable, "-m", "manyeyes.cli.main", *words],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
            timeout=300,
        )

    return run
