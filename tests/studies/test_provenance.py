# SPDX-License-Identifier: Apache-2.0
"""What stands beside every number."""

import json
import math
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.studies import provenance
from manyeyes.studies.provenance import git_commit, to_plain, write_json


@dataclass(frozen=True)
class Settings:
    folder: Path = Path("a/b")
    widths: tuple[int, ...] = (1, 2)
    share: float = math.inf


def test_the_file_holds_configuration_seed_versions_commit_and_result(tmp_path) -> None:
    path = tmp_path / "new" / "result.json"
    write_json(path, {"ap": np.float64(0.5), "curve": torch.tensor([1.0, math.nan])}, Settings(), 7)
    held = json.loads(path.read_text())
    origin = held["provenance"]
    assert held["result"] == {"ap": 0.5, "curve": [1.0, None]}
    assert set(origin) == {"command", "config", "seed", "versions", "git_commit", "machine", "written"}
    assert origin["machine"]["products"] == "float32"  # conftest.py switches bfloat16 off
    assert origin["config"] == {"folder": "a/b", "widths": [1, 2], "share": None} and origin["seed"] == 7
    assert origin["versions"]["torch"] == torch.__version__ and origin["versions"]["python"].startswith("3.")
    assert [p.name for p in path.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("benchmarks/loading.py", "python benchmarks/loading.py data/a"),
        ("/usr/bin/manyeyes", "manyeyes data/a"),
        ("/home/a/manyeyes/cli/main.py", "manyeyes data/a"),
    ],
)
def test_the_command_names_a_script_and_no_folder_of_the_machine(
    tmp_path, monkeypatch, program: str, expected: str
) -> None:
    monkeypatch.setattr("sys.argv", [program, "data/a"])
    assert write_json(tmp_path / "result.json", 1, None, 0)["command"] == expected


def test_a_failed_write_leaves_the_old_file(tmp_path) -> None:
    path = tmp_path / "result.json"
    write_json(path, 1, None, 0)

    class Bad:
        def __str__(self) -> str:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_json(path, Bad(), None, 0)
    assert json.loads(path.read_text())["result"] == 1


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "core.hooksPath=/dev/null"]
    return subprocess.run(
        ["git", "-C", str(folder), *identity, *words], check=True, capture_output=True, text=True
    ).stdout


def test_the_commit_is_that_of_the_package_and_marks_changed_files(tmp_path, monkeypatch) -> None:
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    package = tmp_path / "manyeyes"
    (package / "apps").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "apps" / "provenance.py").write_text("")
    monkeypatch.setattr(provenance, "__file__", str(package / "apps" / "provenance.py"))
    git(tmp_path, "init", "-q")
    git(tmp_path, "commit", "-q", "--allow-empty", "-m", "another project's")
    assert git_commit() is None
    git(tmp_path, "add", "manyeyes")
    git(tmp_path, "commit", "-q", "-m", "ours")
    commit = git(tmp_path, "rev-parse", "HEAD").strip()
    assert git_commit() == commit
    (package / "__init__.py").write_text("changed = True")
    assert git_commit() == commit + "+changes"


def test_an_installed_package_has_the_commit_that_pip_recorded(tmp_path, monkeypatch) -> None:
    package, about = tmp_path / "manyeyes", tmp_path / "manyeyes-0.1.0.dist-info"
    (package / "studies").mkdir(parents=True)
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: manyeyes\nVersion: 0.1.0\n")
    monkeypatch.setattr(provenance, "__file__", str(package / "studies" / "provenance.py"))
    monkeypatch.setattr("sys.path", [str(tmp_path), *sys.path])
    origin = about / "direct_url.json"
    for text in (None, "{", "[]", '{"archive_info": {}}', '{"vcs_info": {"vcs": "git"}}'):
        if text is not None:
            origin.write_text(text)
        assert git_commit() is None, text
    origin.write_text('{"url": "file:///x", "vcs_info": {"vcs": "git", "commit_id": "0123abcd"}}')
    assert git_commit() == "0123abcd"
    # A package that runs from elsewhere is not the installed one.
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "other" / "manyeyes" / "studies" / "provenance.py"))
    assert git_commit() is None


def test_plain_keeps_what_json_has_and_names_the_rest() -> None:
    assert to_plain((None, True, 3, "x", 1.5, [Path("p")])) == [None, True, 3, "x", 1.5, ["p"]]
    assert to_plain({1: -math.inf}) == {"1": None}
