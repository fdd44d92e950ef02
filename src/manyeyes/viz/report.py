# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML report of a run: player of the drive, plots, tables, images, commands, configuration.

Style and script are in ``viz/web``; the page holds its data as JSON and fetches nothing.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write_text
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.viz.report_columns import COLUMN_DESCRIPTIONS
from manyeyes.viz.scene_player import ScenePlayer, to_json
from manyeyes.viz.table import (
    DIFFERENCE_HEADINGS,
    NOT_RUN,
    MethodRow,
    format_difference_cells,
    format_lines,
)
from manyeyes.viz.web_assets import read_asset, to_safe_json

MIME = {".png": "image/png", ".gif": "image/gif", ".webp": "image/webp", ".svg": "image/svg+xml"}


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
    """Content of a report. facts: short (name, value) pairs; provenance: as returned by write_json.

    player: frames of the drive; its methods are those of the rows. pictures: without a player on the page, with one for browsers
    without scripts. story: chapters before the results; shown: the method whose tab is open first.
    """

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
    player: ScenePlayer | None = None
    story: tuple[Chapter, ...] = ()
    shown: str = ""


def render(report: HtmlReport) -> str:
    """Render the page as HTML with embedded images, style and script."""
    parts = [f"<h1>{_escape(report.title)}</h1>", f'<p class="lead">{_escape(report.lead)}</p>']
    if report.facts:
        items = "".join(f"<li><b>{_escape(name)}</b>{_escape(value)}</li>" for name, value in report.facts)
        parts.append(f'<ul class="facts">{items}</ul>')
    parts += _drive_parts(report)
    parts += [part for chapter in report.story for part in _chapter_parts(chapter)]
    if report.rows:
        parts += [
            "<h2>Results</h2>",
            read_asset("web/report_plots.html"),
            _table(*_split_headings(format_lines(report.rows))),
        ]
    if report.differences:
        is_drawn = any(_bounds(d.interval) for d in report.differences)
        parts += [read_asset("web/report_forest.html")] if is_drawn else []
        parts += [_table(DIFFERENCE_HEADINGS, [format_difference_cells(d) for d in report.differences])]
    parts += [f"<p>{_escape(note)}</p>" for note in report.notes]
    parts += [part for chapter in report.chapters for part in _chapter_parts(chapter)]
    if report.commands:
        parts += ["<h2>Commands</h2>", f"<pre>{_escape(chr(10).join(report.commands))}</pre>"]
    if report.provenance:
        dump = _escape(json.dumps(report.provenance, indent=2, default=str))
        parts += ["<h2>Provenance</h2>"]
        parts += [f"<details><summary>Configuration, seed, versions, commit</summary><pre>{dump}</pre></details>"]
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{_escape(report.title)}</title><style>{read_asset("web/report.css")}</style>'
    )
    data = f'<script type="application/json" id="report-data">{to_safe_json(_page_data(report))}</script>'
    script = f"{data}\n<script>{read_asset('web/report.js')}</script>"
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head><body><main>\n{body}\n</main>\n{script}</body></html>\n'
    )


def _drive_parts(report: HtmlReport) -> list[str]:
    """Return the player, or the pictures where there is none."""
    wide, pairs = [p for p in report.pictures if p.wide], [p for p in report.pictures if not p.wide]
    pictures = "".join(map(_figure, wide))
    pictures += f'<div class="pair">{"".join(map(_figure, pairs))}</div>' if pairs else ""
    if report.player is not None:
        parts = ["<h2>The drive from above</h2>", read_asset("web/report_player.html")]
        return parts + ([f"<noscript>{pictures}</noscript>"] if pictures else [])
    return ["<h2>From above</h2>", pictures] if pictures else []


def _chapter_parts(chapter: Chapter) -> list[str]:
    parts = [f"<h2>{_escape(chapter.title)}</h2>", f"<p>{_escape(chapter.text)}</p>"]
    parts += [_table(chapter.table[0], chapter.table[1:])] if chapter.table else []
    return [*parts, *map(_figure, chapter.pictures)]


def _page_data(report: HtmlReport) -> dict[str, Any]:
    """Return what the script draws: numbers of the methods, class by class, paired differences, and the player."""
    player = report.player
    air_ms = {method.name: method.air_ms for method in player.methods} if player else {}
    has_classes = len({row.class_name for row in report.rows}) > 1
    methods = [
        {
            "name": row.method,
            "label": f"{row.method}, {row.class_name}" if has_classes else row.method,
            "ap": _number(row.ap50.value) if row.ap50 else None,
            "interval": _bounds(row.ap50),
            "bytes": _number(row.bytes_per_message),
            "share": _number(row.share_ms) if row.bytes_per_message else None,
            "air": _number(air_ms.get(row.method)),
            "perceive": _number(row.perceive_ms),
        }
        for row in report.rows
    ]
    differences = [
        {"label": d.description, "metric": d.metric, "value": _number(d.interval.value), "interval": bounds}
        for d in report.differences
        if (bounds := _bounds(d.interval)) is not None
    ]
    drive = None if player is None else to_json(player)
    return {"methods": methods, "differences": differences, "player": drive, "shown": report.shown}


def _bounds(value: Interval | None) -> list[float] | None:
    """Return the bounds of an interval over several scenarios, where it has any."""
    if value is None or value.num_scenarios < 2 or not math.isfinite(value.low + value.high):
        return None
    return [round(value.low, 4), round(value.high, 4)]


def _number(value: float | None) -> float | None:
    """Return a number as JSON can hold it."""
    return None if value is None or not math.isfinite(value) else round(value, 4)


def save_report(report: HtmlReport, path: Path) -> None:
    """Write the page atomically."""
    atomic_write_text(path, render(report))


def _escape(value: str) -> str:
    return html.escape(value, quote=True)


def _split_headings(lines: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], Sequence[tuple[str, ...]]]:
    return lines[0], lines[1:]


def _table(headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table; below each heading stands what the column means."""
    head = "".join(f"<th>{_escape(heading)}{_describe_column(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(_cell(c) for c in line)}</tr>" for line in lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _describe_column(heading: str) -> str:
    description = COLUMN_DESCRIPTIONS.get(heading)
    return f"<small>{_escape(description)}</small>" if description else ""


def _cell(text: str) -> str:
    return f'<td class="absent">{_escape(text)}</td>' if text in ("-", NOT_RUN) else f"<td>{_escape(text)}</td>"


def _figure(picture: ReportImage) -> str:
    mime = MIME.get(picture.path.suffix.lower())
    if mime is None:
        raise ConfigError(f"{picture.path.name}: a report embeds {', '.join(MIME)}; convert the picture first.")
    data = base64.b64encode(picture.path.read_bytes()).decode()
    caption = _escape(picture.caption)
    return f'<figure><img alt="{caption}" src="data:{mime};base64,{data}"><figcaption>{caption}</figcaption></figure>'
