# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 2: tiles of 120 m by 60 m from one vehicle's look, and together from more; with what that takes in bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes.evaluation.maps.pooled_ap import MapClaim
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import DrawSemiGlobal
from manyeyes.studies.maps.running import (
    claims_sheet,
    models,
    publish,
    rows_sheet,
    shown,
    tables,
    tile_panels,
    title_of,
)
from manyeyes.viz.study_table import Sheet

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

BAR, GOAL = 0.20, 0.30
TILE = (-60.0, -30.0, 60.0, 30.0)
PAPER = Sheet(
    "CrowdMap's Table 2: DAIR-V2X, cameras; no bar and no rival",
    ("looks", "method", "AP ped", "AP div", "mAP"),
    (("1", "MapTR", "0.182", "0.103", "0.143"), ("10", "CrowdMap", "0.599", "0.682", "0.641")),
)


def run(options: Options, console: Console) -> None:
    """The study."""
    found = models(options)
    draw = DrawSemiGlobal()
    done = tables(options, console, found, draw)
    names = tuple(map(str, draw.looks))
    rows = {sensors: [table.row(name) for name in names] for sensors, table in done.items()}
    held = [claim for sensors, table in done.items() for claim in claims(sensors, table, draw.looks)]
    sheets = [rows_sheet("Tiles, by sensors and looks", rows), claims_sheet(held, "scenarios"), PAPER]
    titles = {names[0]: "one vehicle", names[-1]: f"{names[-1]} looks"}
    cells = next(iter(done.values())).cells
    panels = [
        panel for cell in shown(cells, lambda c: len(c.drawings[0].truth)) for panel in tile_panels(cell, titles, TILE)
    ]
    publish(options, console, title_of(options, found), {"rows": rows, "claims": held}, sheets, panels, 3)


def claims(sensors: str, table: TileTable, looks: tuple[int, ...]) -> list[MapClaim]:
    """More looks against one: the bar and the goal for the most, and that none is worse."""
    one, *more = map(str, looks)
    bars = ((more[-1], BAR, ""), (more[-1], GOAL, ", goal"), *((name, 0.0, "") for name in more))
    return [table.claim(f"{sensors}: {name} looks - one vehicle{said}", name, one, bar) for name, bar, said in bars]
