# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 1: what an agent draws ahead from its own look, 30 m by 30 m of a vehicle, 50 m by 30 m of a roadside unit.

The paper trains a MapTR for each kind of agent; here one model of tiles draws for both, and the window is cut out of its tile.
Pictures: the paper's Fig. 2, drawings over the truth in pale.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from manyeyes.agents.map_perception import SURVEYS
from manyeyes.evaluation.maps.tile_cells import TileCell
from manyeyes.evaluation.maps.tile_prediction import ROADSIDE, VEHICLE, DrawLocal
from manyeyes.studies.maps.running import models, publish, rows_sheet, shown, tables, tile_panels, title_of
from manyeyes.viz.study_table import Sheet

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

WINDOWS = {VEHICLE: SURVEYS["local"].vehicle, ROADSIDE: SURVEYS["local"].roadside}
PAPER = Sheet(
    "CrowdMap's Table 1: DAIR-V2X, one camera an agent; no bar and no rival",
    ("range", "agent", "AP ped", "AP div", "mAP"),
    (("30 x 30 m", VEHICLE, "0.745", "0.909", "0.827"), ("50 x 30 m", ROADSIDE, "0.772", "0.785", "0.778")),
)


def run(options: Options, console: Console) -> None:
    """The study."""
    found = models(options)
    done = tables(options, console, found, DrawLocal())
    names = tuple(WINDOWS)
    rows = {sensors: [table.row(name) for name in names if name in table.names] for sensors, table in done.items()}
    sheet = rows_sheet("Local maps, by sensors and agent", rows)
    cells = next(iter(done.values())).cells
    panels = []
    for name, area in WINDOWS.items():
        own = [one for cell in cells if (one := _first(cell, name)) is not None]
        for cell in shown(own, lambda c: len(c.drawings[0].truth), 2) if own else ():
            panels += tile_panels(cell, {name: name}, area)
    publish(options, console, title_of(options, found), {"rows": rows}, [sheet, PAPER], panels, 4)


def _first(cell: TileCell, row: str) -> TileCell | None:
    """The cell with the first drawing of a row alone."""
    own = [one for one in cell.drawings if one.row == row]
    return replace(cell, drawings=(own[0],)) if own else None
