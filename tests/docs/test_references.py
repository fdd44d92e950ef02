# SPDX-License-Identifier: Apache-2.0
"""Documents refer to what exists: relative links and their anchors, files, and symbols of the code."""

import ast
import functools
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "manyeyes"
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *PACKAGE.rglob("*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
SYMBOL = re.compile(r"`([\w/]+/\w+\.py)(?:::([\w.]+))?`")
PAPERS = {"costr": {"3", "4", "5", "13"}, "feakm": {"3", "6", "7"}, "crowdmap": {"Table 3"}}


@functools.cache
def find_symbols(path: Path) -> frozenset[str]:
    """The functions, classes, methods, fields and constants of a module."""
    found: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            found.update(prefix + t.id for t in targets if isinstance(t, ast.Name))

    visit(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return frozenset(found)


def find_missing_symbols(text: str) -> list[str]:
    """The ``file::symbol`` of a text that do not exist; files are relative to the package or to the repository."""
    out = []
    for file, symbol in sorted(set(SYMBOL.findall(text))):
        paths = [path for path in (PACKAGE / file, ROOT / file) if path.is_file()]
        if not paths or (symbol and symbol not in find_symbols(paths[0])):
            out.append(f"{file}::{symbol}")
    return out


def make_anchors(path: Path) -> set[str]:
    """The anchors of a document's headings, by the rules of GitHub."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def find_broken_links(path: Path) -> list[str]:
    """The relative links and images of a document whose file or anchor does not exist."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.S)
    out = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|srcset|href)="([^"]+)"', text):
        name, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        file = path.parent / name if name else path
        if not file.exists() or (anchor and anchor not in make_anchors(file)):
            out.append(target)
    return out


@pytest.mark.parametrize("path", DOCUMENTS, ids=NAMES)
def test_links_and_symbols_of_a_document_exist(path):
    assert find_broken_links(path) == []
    assert find_missing_symbols(path.read_text(encoding="utf-8")) == []


def test_missing_references_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A page\n[a](other.md) [b](#a-page) [c](#none) [d](https://x.org) `ops/nms.py::nothing` `ops/none.py`\n"
    )
    assert find_broken_links(page) == ["other.md", "#none"]
    assert find_missing_symbols(page.read_text()) == ["ops/nms.py::nothing", "ops/none.py::"]


def test_files_name_documents_that_exist():
    listed = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")
    files = [ROOT / name for name in listed if name.endswith((".py", ".md", ".toml", "Makefile"))]
    assert len(files) > 400
    named = {(str(f.relative_to(ROOT)), d) for f in files for d in re.findall(r"\bdocs/[\w/]+\.\w+", f.read_text())}
    assert [(file, document) for file, document in sorted(named) if not (ROOT / document).is_file()] == []


@pytest.mark.parametrize(("paper", "rows"), PAPERS.items(), ids=PAPERS)
def test_a_page_lists_the_equations_of_its_paper(paper, rows):
    text = (ROOT / "docs" / "papers" / f"{paper}.md").read_text(encoding="utf-8")
    assert len(set(SYMBOL.findall(text))) > 9
    assert rows <= set(re.findall(r"^\| ([^|]+?) \|", text, re.MULTILINE))


def test_settings_in_the_page_of_costr_exist():
    fields = find_symbols(PACKAGE / "models" / "detector" / "encoder.py")
    text = (ROOT / "docs" / "papers" / "costr.md").read_text(encoding="utf-8")
    assert [name for name in re.findall(r"`(EncoderConfig\.\w+)", text) if name not in fields] == []
