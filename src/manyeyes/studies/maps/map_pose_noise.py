# SPDX-License-Identifier: Apache-2.0
"""Tiles under errors of claimed poses, 0.5 m and 1 degree: clean, noisy, and noisy behind the corrector of claimed poses.

Looks are those of agents that meet at one instant: the corrector goes by vehicles that both detect, and at other times they stand
elsewhere. What the corrector wins back is held against half of what the errors cost: corrected - (clean + noisy) / 2 is at least 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes.agents.pose_correction import Aligner
from manyeyes.evaluation.maps.pooled_ap import MapClaim, claimed, mean_of
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import ALONE, CLEAN, CORRECTED, NOISY, UNHURT, DrawPose
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
from manyeyes.studies.maps.semi_global import TILE

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

NAMES = (ALONE, CLEAN, NOISY, CORRECTED, UNHURT)


def run(options: Options, console: Console) -> None:
    """The study."""
    found = models(options)
    draw = DrawPose(aligner=Aligner(options.align))
    done = tables(options, console, found, draw)
    rows = {sensors: [table.row(name) for name in NAMES] for sensors, table in done.items()}
    held = [claim for sensors, table in done.items() for claim in claims(sensors, table)]
    title = f"Tiles, others' claims off by {draw.sigma_m:g} m and {draw.sigma_m * draw.deg_per_m:g} degrees (sigma)"
    sheets = [rows_sheet(title, rows), claims_sheet(held, "scenarios")]
    cells = next(iter(done.values())).cells
    panels = [
        panel
        for cell in shown(cells, lambda c: len(c.drawings[0].truth))
        for panel in tile_panels(cell, {name: name for name in (CLEAN, NOISY, CORRECTED)}, TILE)
    ]
    publish(options, console, title_of(options, found), {"rows": rows, "claims": held}, sheets, panels, 4)


def claims(sensors: str, table: TileTable) -> list[MapClaim]:
    """What errors cost, what the corrector wins back of it, and that it does no harm where there are none."""
    half = mean_of([table.mean(CLEAN), table.mean(NOISY)])
    return [
        claimed(f"{sensors}: corrected - (clean + noisy) / 2", table.mean(CORRECTED).less(half), 0.0),
        table.claim(f"{sensors}: clean - noisy", CLEAN, NOISY, 0.0),
        table.claim(f"{sensors}: corrected - noisy", CORRECTED, NOISY, 0.0),
        table.claim(f"{sensors}: corrected - one vehicle", CORRECTED, ALONE, 0.0),
        table.claim(f"{sensors}: corrected without errors - clean", UNHURT, CLEAN, -0.01),
    ]
