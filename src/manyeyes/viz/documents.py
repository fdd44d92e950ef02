# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of stored results in Markdown documents, between two markers.

A marker is a comment on a line of its own, the table stands below it, and ``<!-- end of report -->`` ends it. Paths are below
``benchmarks/results``:

- ``<!-- report: FILE.json -->`` or ``<!-- report: FOLDER -->``: all tables of a file, or of all files of a folder by name;
- ``<!-- report: FILE.json TABLE ... -->``: some of its tables, by name (``methods``, ``operating-point``, ``differences``, ...);
- ``<!-- report: seeds STRATEGY NAME=FILE.json,FILE.json NAME=... -->``: methods that were trained from several seeds;
  differences are those of the first to the others;
- ``<!-- report: training-seeds SEED=FILE.json SEED=FILE.json ... -->``: main tables of several training seeds, side by side;
- ``<!-- report: picture FILE.png TEXT -->``: a picture that a study drew, with its text;
- ``<!-- report: figure NAME FILE.json ... -->``: a figure drawn from files of results, light and dark, in docs/images/plots.

Below the tables of a file stands where its numbers come from. What is not stored yet reads "not run".
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from manyeyes.datatypes import ConfigError
from manyeyes.viz.figure_svg import THEMES
from manyeyes.viz.seed_comparison import make_seed_comparison
from manyeyes.viz.stored_figures import FIGURES, draw_figure
from manyeyes.viz.stored_tables import StoredTable, load_result, make_seed_tables, make_tables
from manyeyes.viz.table import NOT_RUN, format_markdown_lines

RESULTS = Path("benchmarks/results")
PLOTS = Path("docs/images/plots")
END = "<!-- end of report -->"
_BEGIN = re.compile(r"^<!-- report: (.+?) -->$", re.M)
_FOLDERS = ("docs", "src", "examples", "benchmarks")


@dataclass(frozen=True)
class Document:
    """A file made from stored results: Markdown with their tables, or a figure as SVG.

    text: as it is, empty where the file does not exist; updated: as its results make it.
    """

    path: Path
    text: str
    updated: str


def find_documents(root: Path) -> tuple[Document, ...]:
    """Read all documents of a repository that have a marker, and make their tables, then the figures that they show.

    Raises:
        ConfigError: a marker or its results are not valid; the text names the document or the file of results.
    """
    paths = [*sorted(root.glob("*.md")), *(p for f in _FOLDERS for p in sorted((root / f).rglob("*.md")))]
    texts = [(path, text) for path in paths if _BEGIN.search(text := path.read_text(encoding="utf-8"))]
    documents = [
        Document(path, text, update_text(text, root / RESULTS, str(path.relative_to(root)))) for path, text in texts
    ]
    markers = [marker.group(1).split() for _, text in texts for marker in _BEGIN.finditer(text)]
    figures = dict.fromkeys(tuple(words[1:]) for words in markers if words[0] == "figure")
    return (*documents, *(document for words in figures for document in _draw_documents(words, root)))


def _draw_documents(words: Sequence[str], root: Path) -> Iterator[Document]:
    """Yield the two files of one figure, where all of its results are stored."""
    files = [root / RESULTS / name for name in words[1:]]
    if not all(file.is_file() for file in files):
        return
    results = [load_result(file) for file in files]
    for theme in THEMES:
        path = root / PLOTS / _name_figure(words, theme.name)
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        yield Document(path, text, draw_figure(words[0], results, theme))


def _name_figure(words: Sequence[str], theme: str) -> str:
    """Name the file of a figure: the figure, its results and the theme."""
    return "-".join((words[0], *(Path(name).stem.replace("_", "-") for name in words[1:]), f"{theme}.svg"))


def update_text(text: str, results: Path, name: str) -> str:
    """Return the text with the tables of its markers made from the folder of results; name: of the document, for errors."""
    parts, at = list[str](), 0
    for marker in _BEGIN.finditer(text):
        end = text.find(f"\n{END}", marker.end())
        following = _BEGIN.search(text, marker.end())
        if end < 0 or (following is not None and following.start() < end):
            raise ConfigError(f"{name}: the marker {marker.group()} has no {END} below it; add one.")
        words = marker.group(1).split()
        parts += [text[at : marker.end()], "\n\n", "\n".join(_make_parts(words, results, name))]
        at = end + 1
    return "".join((*parts, text[at:]))


def _make_parts(words: Sequence[str], results: Path, name: str) -> Iterator[str]:
    """Yield the Markdown of one marker, by its words."""
    if words[0] == "seeds":
        yield from _make_seed_parts(words[1:], results, name)
        return
    if words[0] == "training-seeds":
        yield from _make_seed_comparison(words[1:], results, name)
        return
    if words[0] == "picture":
        yield _make_picture(words[1:], results, name)
        return
    if words[0] == "figure":
        yield from _make_figure(words[1:], results, name)
        return
    path = results / words[0]
    files = sorted(path.glob("*.json")) if path.is_dir() else [path] if path.is_file() else []
    if not files:
        yield _name_missing(words[0])
    for file in files:
        stored = load_result(file)
        tables = make_tables(stored)
        unknown = sorted(set(words[1:]) - {table.name for table in tables})
        if unknown:
            known = ", ".join(table.name for table in tables)
            raise ConfigError(f"{name}: {file} has no table {unknown[0]}; it has {known}.")
        chosen = [table for table in tables if table.name in words[1:]] or tables
        yield from _format_tables(chosen, has_titles=len(chosen) > 1 or len(files) > 1 or path.is_dir())
        yield f"{stored.origin}\n"


def _name_missing(path: str) -> str:
    """Return the text of results that are not stored yet."""
    return f"*{NOT_RUN}: `{RESULTS / path}` is not stored.*\n"


def _make_picture(words: Sequence[str], results: Path, name: str) -> str:
    if len(words) < 2:
        raise ConfigError(
            f"{name}: a marker of a picture is 'picture FILE.png TEXT'; got {' '.join(words) or 'nothing'}."
        )
    path = results / words[0]
    if not path.is_file():
        return _name_missing(words[0])
    root = results.parents[len(RESULTS.parts) - 1]
    return f"![{' '.join(words[1:])}]({Path(os.path.relpath(path, (root / name).parent)).as_posix()})\n"


def _make_figure(words: Sequence[str], results: Path, name: str) -> Iterator[str]:
    if len(words) < 2 or words[0] not in FIGURES:
        known = ", ".join(FIGURES)
        raise ConfigError(
            f"{name}: a marker of a figure is 'figure NAME FILE.json ...', NAME one of {known}; got {' '.join(words)}."
        )
    figure = FIGURES[words[0]]
    missing = [file for file in words[1:] if not (results / file).is_file()]
    if missing:
        yield f"*{NOT_RUN}: {figure.text}: `{RESULTS / missing[0]}` is not stored; `{figure.command}` makes it.*\n"
        return
    root = results.parents[len(RESULTS.parts) - 1]
    light, dark = (
        Path(os.path.relpath(root / PLOTS / _name_figure(words, theme), (root / name).parent)).as_posix()
        for theme in ("light", "dark")
    )
    yield (
        f'<picture><source media="(prefers-color-scheme: dark)" srcset="{dark}"><img alt="{figure.text}" src="{light}">'
        "</picture>\n"
    )
    yield '<details markdown="1"><summary>Command, commit, seed and split</summary>\n'
    yield from (f"{load_result(results / file).origin}\n" for file in words[1:])
    yield "</details>\n"


def _make_seed_parts(words: Sequence[str], results: Path, name: str) -> Iterator[str]:
    pairs = [word.partition("=") for word in words[1:]]
    if not pairs or not all(method and files for method, _, files in pairs):
        raise ConfigError(f"{name}: a marker of seeds is 'seeds STRATEGY NAME=FILE,FILE ...'; got {' '.join(words)}.")
    named = [(method, file) for method, _, files in pairs for file in files.split(",")]
    missing = [file for _, file in named if not (results / file).is_file()]
    if missing:
        yield _name_missing(missing[0])
        return
    runs = [(method, load_result(results / file)) for method, file in named]
    yield from _format_tables(make_seed_tables(runs, words[0]), has_titles=True)
    yield from (f"- {method}: {stored.origin}" for method, stored in runs)
    yield ""


def _make_seed_comparison(words: Sequence[str], results: Path, name: str) -> Iterator[str]:
    files = {seed: file for seed, _, file in (word.partition("=") for word in words)}
    if len(files) < 2 or not all(files.values()):
        raise ConfigError(
            f"{name}: a marker of seeds of main tables is 'training-seeds SEED=FILE.json SEED=FILE.json ...'; "
            f"got {' '.join(words) or 'nothing'}."
        )
    missing = [file for file in files.values() if not (results / file).is_file()]
    if missing:
        yield _name_missing(missing[0])
        return
    stored = {seed: load_result(results / file) for seed, file in files.items()}
    yield from _format_tables([make_seed_comparison({s: one.result for s, one in stored.items()})], has_titles=False)
    yield from (f"- seed {seed}: {one.origin}" for seed, one in stored.items())
    yield ""


def _format_tables(tables: Sequence[StoredTable], has_titles: bool) -> Iterator[str]:
    for table in tables:
        yield (
            f"**{table.title}**\n\n{format_markdown_lines(table.lines)}"
            if has_titles
            else format_markdown_lines(table.lines)
        )
