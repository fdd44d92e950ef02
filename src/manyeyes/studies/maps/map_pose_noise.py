# SPDX-License-Identifier: Apache-2.0
"""Tiles under errors of claimed poses, 0.5 m and 1 degree: clean, noisy, and noisy behind the corrector of claimed poses.

Frames are those of one snapshot, since the corrector matches vehicles that both agents detect, which move between snapshots.
The corrector is to recover at least half of the AP drop: corrected - (clean + noisy) / 2 is at least 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.evaluation.maps.pooled_ap import MapMarginTest, average_samples, check_map_margin
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import (
    CLEAN,
    CLEAN_CORRECTED,
    CORRECTED,
    NOISY,
    SINGLE_VEHICLE,
    PoseNoisePredictor,
)
from manyeyes.studies.maps.running import (
    make_margin_table,
    make_rows_table,
    make_tile_panels,
    make_title,
    predict_tables,
    resolve_models,
    select_for_figure,
    write_study_report,
)
from manyeyes.studies.maps.semi_global import TILE_AREA

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

ROW_NAMES = (SINGLE_VEHICLE, CLEAN, NOISY, CORRECTED, CLEAN_CORRECTED)


def run(options: Options, console: Console) -> None:
    """Run the study of map tiles under pose noise and write its report."""
    models_used = resolve_models(options)
    predictor = PoseNoisePredictor(pose_correction=PoseCorrection(options.pose_correction))
    tile_tables = predict_tables(options, console, models_used, predictor)
    rows = {sensors: [table.make_row(name) for name in ROW_NAMES] for sensors, table in tile_tables.items()}
    margin_tests = [
        margin_test for sensors, table in tile_tables.items() for margin_test in check_margins(sensors, table)
    ]
    title = f"Tiles, others' claims off by {predictor.sigma_m:g} m and {predictor.sigma_m * predictor.deg_per_m:g} degrees (sigma)"
    study_tables = [make_rows_table(title, rows), make_margin_table(margin_tests, "scenarios")]
    results = next(iter(tile_tables.values())).results
    panels = [
        panel
        for result in select_for_figure(results, lambda c: len(c.predictions[0].truth))
        for panel in make_tile_panels(result, {name: name for name in (CLEAN, NOISY, CORRECTED)}, TILE_AREA)
    ]
    write_study_report(
        options,
        console,
        make_title(options, models_used),
        {"rows": rows, "margin_tests": margin_tests},
        study_tables,
        panels,
        4,
    )


def check_margins(sensors: str, table: TileTable) -> list[MapMarginTest]:
    """What errors cost, what the corrector wins back of it, and that it does no harm where there are none."""
    half_loss = average_samples([table.bootstrap_mean_ap(CLEAN), table.bootstrap_mean_ap(NOISY)])
    return [
        check_map_margin(
            f"{sensors}: corrected - (clean + noisy) / 2",
            table.bootstrap_mean_ap(CORRECTED).paired_difference(half_loss),
            0.0,
        ),
        table.check_margin(f"{sensors}: clean - noisy", CLEAN, NOISY, 0.0),
        table.check_margin(f"{sensors}: corrected - noisy", CORRECTED, NOISY, 0.0),
        table.check_margin(f"{sensors}: corrected - one vehicle", CORRECTED, SINGLE_VEHICLE, 0.0),
        table.check_margin(f"{sensors}: corrected without errors - clean", CLEAN_CORRECTED, CLEAN, -0.01),
    ]
