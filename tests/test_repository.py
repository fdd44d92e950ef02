# SPDX-License-Identifier: Apache-2.0
"""Files of the repository beside the package: citation, templates, workflows, hooks, the notebook and the node for ROS 2."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import manyeyes

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAKEFILE = (ROOT / "Makefile").read_text()
NODE = ROOT / "examples" / "ros2" / "detection_node.py"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FILES = [
    ROOT / name
    for name in ("CITATION.cff", "SECURITY.md", ".pre-commit-config.yaml", ".github/PULL_REQUEST_TEMPLATE.md")
]


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_citation_names_version_and_licence_of_the_package() -> None:
    citation = load(ROOT / "CITATION.cff")
    assert citation["version"] == manyeyes.__version__ and citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"] == [{"name": "The manyeyes authors"}]


@pytest.mark.parametrize("path", [*FILES, *WORKFLOWS], ids=lambda path: path.name)
def test_no_address_of_a_person_or_machine_is_named(path: Path) -> None:
    assert re.findall(r"[\w.+-]+@[\w-]+\.\w+|https?://\S+", path.read_text(encoding="utf-8")) == []


def test_no_tracked_link_leaves_the_repository() -> None:
    """A link to a folder of one machine dangles in every other clone, and nothing can be written below it."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout: there is nothing tracked")
    listing = subprocess.run(
        ["git", "ls-files", "-s", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    entries = [line.partition("\t") for line in listing.split("\0") if line]
    links = [ROOT / path for mode, _, path in entries if mode.startswith("120000")]
    outside = [link for link in links if not link.resolve().is_relative_to(ROOT)]
    assert len(entries) > 100 and outside == []


def test_workflows_run_targets_of_the_makefile_on_every_python() -> None:
    jobs = {name: job for path in WORKFLOWS for name, job in load(path)["jobs"].items()}
    assert set(jobs) == {"lint", "test", "docs", "wheels"}
    versions = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert jobs["test"]["strategy"]["matrix"]["python-version"] == versions
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    targets = [run.split()[1] for run in runs if run.startswith("make ")]
    assert sorted(targets) == ["check", "docs", "test", "wheel"]
    assert all(re.search(rf"^{target}:", MAKEFILE, re.MULTILINE) for target in targets)
    uses = [step["uses"] for job in jobs.values() for step in job["steps"] if "uses" in step]
    assert uses and all(re.fullmatch(r"actions/[\w-]+@v\d+", use) for use in uses)


def test_hooks_are_the_commands_of_make_check() -> None:
    hooks = [
        hook["entry"].split()[0] for repo in load(ROOT / ".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]
    ]
    recipe = re.search(r"^check: .*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert recipe is not None
    assert {hook.replace(".venv", "$(VENV)") for hook in hooks} == {
        word.replace("$(BIN)", "$(VENV)/bin") for word in re.findall(r"@(\S+)", recipe[1])
    }


def test_forms_of_issues_have_what_the_platform_needs() -> None:
    forms = [
        load(path) for path in sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")) if path.name != "config.yml"
    ]
    assert len(forms) == 2
    for form in forms:
        assert {"name", "description", "body"} <= set(form)
        identifiers = [part["id"] for part in form["body"]]
        assert len(set(identifiers)) == len(identifiers) and all(part["attributes"]["label"] for part in form["body"])


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    notebook = json.loads((ROOT / "examples" / "quickstart.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert notebook["nbformat"] == 4 and len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    namespace: dict[str, Any] = {}
    for cell in cells:
        exec(compile("".join(cell["source"]), "quickstart.ipynb", "exec"), namespace)
    lines = capsys.readouterr().out.splitlines()[-7:]  # SUMO may print a warning before
    assert lines[0].startswith("3 agents")
    alone, fused = (int(re.split(r"[: ]+", line)[1]) for line in lines[2:4])
    assert 0 < alone <= fused
    sent = [int(re.findall(r"([\d,]+) bytes sent", line)[0].replace(",", "")) for line in lines[4:]]
    assert sent == sorted(sent) and sent[0] < sent[-1]


def test_the_node_for_ros_2_calls_what_manyeyes_has() -> None:
    tree = ast.parse(NODE.read_text(encoding="utf-8"))
    assert (
        "not run" in (ast.get_docstring(tree) or "").lower()
        and "was not run" in (NODE.parent / "README.md").read_text()
    )
    imported = {
        (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("manyeyes")
        for alias in node.names
    }
    assert len(imported) >= 6
    for module, name in imported:
        assert hasattr(__import__(str(module), fromlist=[name]), name), (module, name)
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert {"share", "perceive"} <= used and hasattr(manyeyes.Transform, "from_xyz_yaw")
    text = NODE.read_text(encoding="utf-8")
    assert all(word in text for word in ("PointCloud2", "PoseStamped", "Detection3DArray"))
