# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML report of a run: tables, images, animation, commands, configuration."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write_text
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.viz.table import (
    DATA_AGE,
    DIFFERENCE_HEADINGS,
    LOG2_BYTES,
    NOT_RUN,
    MethodRow,
    format_difference_cells,
    format_lines,
)

MIME = {".png": "image/png", ".gif": "image/gif", ".webp": "image/webp", ".svg": "image/svg+xml"}

STYLE = """
:root { --ink: #263238; --soft: #607d8b; --line: #e3e8eb; --wash: #f6f8f9; --accent: #1976d2; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff;
  font: 15px/1.55 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 40px 24px 72px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 6px; letter-spacing: -.01em; }
h2 { font-size: 19px; margin: 44px 0 12px; padding-top: 16px; border-top: 1px solid var(--line); }
p { margin: 0 0 12px; max-width: 78ch; }
.lead { color: var(--soft); font-size: 17px; }
.facts { display: flex; flex-wrap: wrap; gap: 10px; margin: 20px 0 0; padding: 0; list-style: none; }
.facts li { background: var(--wash); border: 1px solid var(--line); border-radius: 8px; padding: 8px 14px; }
.facts b { display: block; font-size: 12px; font-weight: 500; color: var(--soft); }
.wide { overflow-x: auto; margin-bottom: 12px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 8px 12px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { font-size: 12.5px; font-weight: 600; color: var(--soft); }
th:first-child, td:first-child { text-align: left; font-weight: 600; }
td.absent { color: #a9b6bd; }
figure { margin: 0 0 22px; }
figure img { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: 8px; }
figcaption { color: var(--soft); font-size: 13.5px; margin-top: 6px; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); gap: 4px 20px; }
pre { background: var(--wash); border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px;
  overflow-x: auto; font-size: 13px; }
details { margin: 0 0 10px; } summary { cursor: pointer; color: var(--accent); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0; }
dt { font-weight: 600; } dd { margin: 0; color: var(--soft); }
@media print { main { padding: 0; } }
"""

COLUMN_DESCRIPTIONS = (
    ("AP@0.5, AP@0.7", "average precision at rotated bird's-eye IoU 0.5 and 0.7, detections of all frames sorted by score, "
     "with the 95 % confidence interval over scenarios where there is more than one"),
    ("bytes/message", "mean size of an agent's message, with all packets and headers"),
    (LOG2_BYTES, "the base-2 logarithm of bytes/message"),
    (DATA_AGE, "mean age of received data when it is fused: capture, share and channel"),
    ("share [ms], perceive [ms]", "mean computing time of one call on this machine"),
)  # fmt: skip


@dataclass(frozen=True)
class ReportImage:
    """Image file of a report; wide ones take the whole width, others are placed in pairs."""

    path: Path
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class Chapter:
    """Chapter of a report: title, text, a table whose first line is the headings, and images."""

    title: str
    text: str
    pictures: tuple[ReportImage, ...] = ()
    table: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class HtmlReport:
    """Content of a report. facts: short (name, value) pairs; provenance: as returned by write_json."""

    title: str
    lead: str
    rows: tuple[MethodRow, ...] = ()
    differences: tuple[Comparison, ...] = ()
    pictures: tuple[ReportImage, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    commands: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    chapters: tuple[Chapter, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)


def render(report: HtmlReport) -> str:
    """Render the page as HTML with embedded images."""
    parts = [f"<h1>{_escape(report.title)}</h1>", f'<p class="lead">{_escape(report.lead)}</p>']
    if report.facts:
        items = "".join(f"<li><b>{_escape(name)}</b>{_escape(value)}</li>" for name, value in report.facts)
        parts.append(f'<ul class="facts">{items}</ul>')
    if report.rows:
        columns = "".join(f"<dt>{_escape(name)}</dt><dd>{_escape(what)}</dd>" for name, what in COLUMN_DESCRIPTIONS)
        parts += [
            "<h2>Results</h2>",
            _table(*_split_headings(format_lines(report.rows))),
            f"<details><summary>Definitions of columns</summary><dl>{columns}</dl></details>",
        ]
    if report.differences:
        parts += [_table(DIFFERENCE_HEADINGS, [format_difference_cells(d) for d in report.differences])]
    parts += [f"<p>{_escape(note)}</p>" for note in report.notes]
    wide, pairs = [p for p in report.pictures if p.wide], [p for p in report.pictures if not p.wide]
    if wide:
        parts += ["<h2>Animation</h2>", *(_figure(p) for p in wide)]
    if pairs:
        parts += [
            "<h2>One frame, bird's-eye view</h2>",
            f'<div class="pair">{"".join(_figure(p) for p in pairs)}</div>',
        ]
    for chapter in report.chapters:
        parts += [
            f"<h2>{_escape(chapter.title)}</h2>",
            f"<p>{_escape(chapter.text)}</p>",
            *map(_figure, chapter.pictures),
        ]
        if chapter.table:
            parts.append(_table(chapter.table[0], chapter.table[1:]))
    if report.commands:
        parts += ["<h2>Commands</h2>", f"<pre>{_escape(chr(10).join(report.commands))}</pre>"]
    if report.provenance:
        dump = _escape(json.dumps(report.provenance, indent=2, default=str))
        parts += ["<h2>Provenance</h2>"]
        parts += [f"<details><summary>Configuration, seed, versions, commit</summary><pre>{dump}</pre></details>"]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{_escape(report.title)}</title>'
    body = "\n".join(parts)
    style = f"<style>{STYLE}</style>"
    page = f'<html lang="en"><head>{head}{style}</head><body><main>\n{body}\n</main></body></html>'
    return f"<!doctype html>\n{page}\n"


def save_report(report: HtmlReport, path: Path) -> None:
    """Write the page atomically."""
    atomic_write_text(path, render(report))


def _escape(value: str) -> str:
    return html.escape(value, quote=True)


def _split_headings(lines: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], Sequence[tuple[str, ...]]]:
    return lines[0], lines[1:]


def _table(headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{_escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(_cell(c) for c in line)}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str) -> str:
    return f'<td class="absent">{_escape(text)}</td>' if text in ("-", NOT_RUN) else f"<td>{_escape(text)}</td>"


def _figure(picture: ReportImage) -> str:
    mime = MIME.get(picture.path.suffix.lower())
    if mime is None:
        raise ConfigError(f"{picture.path.name}: a report embeds {', '.join(MIME)}; convert the picture first.")
    data = base64.b64encode(picture.path.read_bytes()).decode()
    caption = _escape(picture.caption)
    return f'<figure><img alt="{caption}" src="data:{mime};base64,{data}"><figcaption>{caption}</figcaption></figure>'
