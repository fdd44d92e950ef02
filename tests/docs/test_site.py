# SPDX-License-Identifier: Apache-2.0
"""The documentation site: every page is in its navigation, generated pages are current, it builds, and its search finds answers."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from tests.viz.chromium import Browser, find_program

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
QUESTIONS = {
    "gpu": "guides/train.html",
    "accuracy real data": "benchmarks/real-data.html",
    "score threshold": "guides/score-threshold.html",
    "add method": "questions.html",
    "change architecture": "guides/architecture-of-a-model.html",
    "training time": "questions.html",
    "cloud sensor frame": "guides/sensor-frame.html",
    "bytes network authenticated": "questions.html",
    "exported columns": "reference/columns.html",
    "fine-tune": "guides/fine-tune.html",
}
"""What a reader types into the search, and the page that answers."""
SHOWN_PAGES = (
    "index.html", "quickstart.html", "guides/own-detector.html", "benchmarks/detection.html", "papers/costr.html",
)  # fmt: skip
FOUND_LINKS = "[...document.querySelectorAll('.md-search-result__link')].map(link => link.href)"
RUN_PAGES = (
    "quickstart", "guides/byte-budget", "guides/score-threshold", "guides/sensor-frame", "guides/correct-poses",
    "guides/architecture-of-a-model", "guides/map-cluster",
)  # fmt: skip


def load_script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


HOOKS = load_script("docs_hooks")


class ConfigLoader(yaml.SafeLoader):
    """Reads mkdocs.yml without its Python objects."""


ConfigLoader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)
CONFIG: dict[str, Any] = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), ConfigLoader)


def list_pages(entry: Any) -> Iterator[str]:
    if isinstance(entry, str):
        yield entry
    for part in entry.values() if isinstance(entry, dict) else entry if isinstance(entry, list) else ():
        yield from list_pages(part)


def test_every_page_is_in_the_navigation_once() -> None:
    listed = sorted(list_pages(CONFIG["nav"]))
    outside = [page for name, page in HOOKS.OUTSIDE.items() if page != "index.md" and (ROOT / name).is_file()]
    assert listed == sorted([*(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")), *outside])


def test_warnings_are_errors_and_pages_open_without_a_server() -> None:
    assert CONFIG["strict"] is True and CONFIG["use_directory_urls"] is False and "offline" in CONFIG["plugins"]
    assert {*CONFIG["validation"]["nav"].values(), *CONFIG["validation"]["links"].values()} == {"warn"}
    assert all((DOCS / path).is_file() for path in (*CONFIG["extra"]["polyfills"], *CONFIG["extra_css"]))


@pytest.mark.slow
def test_reference_pages_are_those_that_the_code_generates() -> None:
    """In a process of their own, since other tests register presets."""
    run = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "reference_pages.py"), "--check"],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert run.returncode == 0, run.stdout + run.stderr


def test_every_stored_reference_page_is_generated() -> None:
    pages = load_script("reference_pages").make_pages()
    stored = {
        str(path.relative_to(DOCS / "reference")): path.read_text(encoding="utf-8")
        for path in (DOCS / "reference").rglob("*.md")
        if "written by scripts/reference_pages.py" in path.read_text(encoding="utf-8")
    }
    assert sorted(pages) == sorted(stored)


def test_links_that_leave_the_folder_become_pages_or_names() -> None:
    from pathlib import PurePosixPath

    text = "[a](../../README.md#install) [b](../../benchmarks/results/x.json) [c](own-data.md) [`x.py`](../../examples/x.py)"
    assert HOOKS.redirect_links(text, PurePosixPath("guides")) == (
        "[a](../index.md) b (`benchmarks/results/x.json`) [c](own-data.md) `x.py`"
    )
    assert HOOKS.move_links("[a](docs/concepts/messages.md) [b](https://x.org)", PurePosixPath("development")) == (
        "[a](../concepts/messages.md) [b](https://x.org)"
    )


def test_lists_and_tables_after_a_paragraph_get_an_empty_line() -> None:
    text = "A:\n- one\n- two\n  more\nB\n| a |\n|---|\n```\nx\n- y\n```"
    assert HOOKS.separate_blocks(text) == ("A:\n\n- one\n- two\n  more\nB\n\n| a |\n|---|\n```\nx\n- y\n```")


def test_pictures_of_two_themes_become_images_of_the_theme_of_the_site() -> None:
    text = '<picture><source media="(prefers-color-scheme: dark)" srcset="a/x-dark.svg"><img alt="X" src="a/x-light.svg"></picture>'
    assert HOOKS.split_pictures(f"One\n\n{text}\n") == (
        'One\n\n<p class="plot"><img alt="X" src="a/x-light.svg#only-light"><img alt="X" src="a/x-dark.svg#only-dark"></p>\n'
    )


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN_PAGES)
def test_the_python_of_a_page_runs(page: str) -> None:
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    if "simulate" in text:
        pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert blocks
    namespace: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, f"{page}.md", "exec"), namespace)


def rank_pages(sections: list[dict[str, str]], query: str) -> list[str]:
    """Rank pages by their best section that has all terms: titles first, then how densely the text has them."""
    best: dict[str, float] = {}
    for section in sections:
        title = section["title"].lower()
        text = re.sub(r"<[^>]+>", " ", section["text"]).lower()
        counts = [
            (len(re.findall(rf"\b{re.escape(t)}", title)), len(re.findall(rf"\b{re.escape(t)}", text)))
            for t in query.split()
        ]
        if all(map(any, counts)):
            density = sum(of_text for _, of_text in counts) / (50 + len(text.split()))
            score = 2 * sum(min(of_title, 1) for of_title, _ in counts) - len(title.split()) / 20 + density
            page = section["location"].partition("#")[0]
            best[page] = max(score, best.get(page, score))
    return sorted(best, key=lambda page: -best[page])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material", reason="the 'docs' extra is not installed")
    pytest.importorskip("mkdocstrings", reason="the 'docs' extra is not installed")
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.slow
def test_the_site_builds_and_asks_no_other_machine(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(list(DOCS.rglob("*.md")))
    loaded = [
        url
        for page in pages
        for url in re.findall(
            r"<(?:script|img|link rel=\"stylesheet\")[^>]*(?:src|href)=\"(https?:[^\"]+)", page.read_text()
        )
    ]
    assert loaded == []
    assert "ap_summaries" not in (site / "index.html").read_text() and (site / "search" / "search_index.js").is_file()
    agent = (site / "reference" / "api" / "agents.html").read_text()
    assert 'id="manyeyes.agents.agent.Agent"' in agent and "Agent.perceive" in agent


@pytest.mark.slow
@pytest.mark.parametrize(("query", "page"), QUESTIONS.items(), ids=QUESTIONS)
def test_the_search_finds_the_page_that_answers(site: Path, query: str, page: str) -> None:
    sections = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    assert page in rank_pages(sections, query)[:3]


@pytest.fixture(scope="module")
def browser(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser that shows the folder of the site without a server, with its search ready."""
    program = find_program()
    if program is None:
        pytest.skip("no Chromium is installed: the site was checked by its files only")
    browser = Browser(program, str(tmp_path_factory.mktemp("profile")))
    browser.open(f"{(site / 'index.html').as_uri()}?q=manyeyes", ready=f"{FOUND_LINKS}.length > 0")
    yield browser
    browser.close()


def wait_for(browser: Browser, expression: str) -> None:
    """Wait until an expression is true, at most a minute."""
    end = time.monotonic() + 60
    while browser.value(expression) is not True:
        assert time.monotonic() < end, expression
        time.sleep(0.2)


@pytest.mark.slow
def test_the_search_of_the_site_lists_the_pages_that_answer(site: Path, browser: Browser) -> None:
    """Typed one after the other into the search of one page."""
    field = "document.querySelector('[data-md-component=search-query]')"
    for query, page in QUESTIONS.items():
        for text, expected in (("", f"{FOUND_LINKS}.length == 0"), (query, f"{FOUND_LINKS}.length > 0")):
            browser.value(f"{field}.value = {text!r}; {field}.dispatchEvent(new Event('keyup'))")
            wait_for(browser, expected)
        found = [re.split(r"[?#]", link)[0] for link in browser.value(FOUND_LINKS)]
        assert (site / page).as_uri() in list(dict.fromkeys(found))[:3], query


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWN_PAGES)
def test_a_page_is_as_wide_as_the_window_and_has_its_pictures(site: Path, browser: Browser, page: str) -> None:
    browser.ask("Page.navigate", url=(site / page).as_uri())
    wait_for(browser, f"location.href.endsWith({page!r}) && document.readyState == 'complete'")
    pictures = "[...document.images].filter(picture => picture.offsetParent)"
    cut = (
        "[...document.querySelectorAll('article *')].filter(part => part.getBoundingClientRect().right > innerWidth + 1"
        " && !part.closest('.md-typeset__scrollwrap, pre, .highlight, .plot')).map(part => part.outerHTML.slice(0, 80))"
    )
    for width in (1280, 390):
        browser.resize(width, 800)
        wait_for(browser, f"document.documentElement.scrollWidth == {width}")
        wait_for(browser, f"{pictures}.every(picture => picture.naturalWidth > 0)")
        assert (browser.value(f"{pictures}.length") > 0) == (page in ("index.html", "benchmarks/detection.html"))
        assert browser.value(cut) == []
