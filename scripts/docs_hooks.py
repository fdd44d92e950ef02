# SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: pages outside docs, links that leave it, and Markdown that GitHub reads and Python-Markdown does not."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "development/contributing.md",
    "CHANGELOG.md": "development/changelog.md",
}
"""Documents outside docs, and the pages that hold their content in the site."""
_FENCE = re.compile(r"^ *(```|~~~)")
_ITEM = re.compile(r"^ *(?:[-*]|\d+\.) ")
_PICTURE = re.compile(
    r'<picture><source media="\(prefers-color-scheme: dark\)" srcset="([^"]+)"><img alt="([^"]*)" src="([^"]+)"></picture>'
)
_LINK = re.compile(r"(?<!!)\[([^\]\[]*(?:\[[^\]]*\][^\]\[]*)*)\]\(([^)\s]+)\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the documents outside docs as pages."""
    from mkdocs.structure.files import File

    for name, page in OUTSIDE.items():
        if page != "index.md":
            text = (ROOT / name).read_text(encoding="utf-8")
            files.append(File.generated(config, page, content=move_links(text, PurePosixPath(page).parent)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Adapt one page of the repository to the site."""
    return separate_blocks(split_pictures(redirect_links(markdown, PurePosixPath(page.file.src_uri).parent)))


def move_links(text: str, folder: PurePosixPath) -> str:
    """Make links of a document at the root of the repository relative to a folder of docs."""

    def move(found: re.Match[str]) -> str:
        label, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        return f"[{label}]({os.path.relpath(target, PurePosixPath('docs') / folder)})"

    return _LINK.sub(move, text)


def redirect_links(text: str, folder: PurePosixPath) -> str:
    """Replace links of a page in a folder of docs that leave docs: by a page of the site, else by the name of the file."""

    def redirect(found: re.Match[str]) -> str:
        label, target = found.groups()
        name, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target) or not name:
            return found[0]
        path = os.path.normpath(PurePosixPath("docs") / folder / name)
        if path == "docs" or path.startswith("docs/"):
            return found[0]
        if path in OUTSIDE:
            page = os.path.relpath(OUTSIDE[path], folder)
            return f"[{label}]({page})" if path == "README.md" or not anchor else f"[{label}]({page}#{anchor})"
        return label if PurePosixPath(path).name in label else f"{label} (`{path}`)"

    return _LINK.sub(redirect, text)


def split_pictures(text: str) -> str:
    """Replace pictures with a light and a dark form by two images, of which the site shows the one of its own theme."""
    return _PICTURE.sub(
        r'<p class="plot"><img alt="\2" src="\3#only-light"><img alt="\2" src="\1#only-dark"></p>',
        text,
    )


def separate_blocks(text: str) -> str:
    """Put an empty line before lists and tables that follow a paragraph at once."""
    out: list[str] = []
    in_fence = False
    for line in text.split("\n"):
        before = out[-1] if out else ""
        if _FENCE.match(line):
            in_fence = not in_fence
        elif not in_fence and before.strip():
            begins_list = _ITEM.match(line) and not _ITEM.match(before) and not before.startswith(" ")
            begins_table = line.startswith("|") and not before.startswith("|")
            if (begins_list or begins_table) and not line.startswith(" "):
                out.append("")
        out.append(line)
    return "\n".join(out)
