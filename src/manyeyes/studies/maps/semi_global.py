# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 2: tiles of 120 m by 60 m from one vehicle's frame and from more frames, with their bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes.evaluation.maps.pooled_ap import MapMarginTest
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import SemiGlobalPredictor
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
from manyeyes.viz.study_table import StudyTable

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

MARGIN, TARGET_MARGIN = 0.20, 0.30
TILE_AREA = (-60.0, -30.0, 60.0, 30.0)
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 2: DAIR-V2X, cameras; for reference only",
    ("frames", "method", "AP ped", "AP div", "mAP"),
    (("1", "MapTR", "0.182", "0.103", "0.143"), ("10", "CrowdMap", "0.599", "0.682", "0.641")),
)


def run(options: Options, console: Console) -> None:
    """Run the study of semi-global tiles and write its report."""
    models_used = resolve_models(options)
    predictor = SemiGlobalPredictor()
    tile_tables = predict_tables(options, console, models_used, predictor)
    names = tuple(map(str, predictor.frame_counts))
    rows = {sensors: [table.make_row(name) for name in names] for sensors, table in tile_tables.items()}
    margin_tests = [
        margin_test
        for sensors, table in tile_tables.items()
        for margin_test in check_margins(sensors, table, predictor.frame_counts)
    ]
    study_tables = [
        make_rows_table("Tiles, by sensors and frames", rows),
        make_margin_table(margin_tests, "scenarios"),
        PAPER_TABLE,
    ]
    titles = {names[0]: "one vehicle", names[-1]: f"{names[-1]} frames"}
    results = next(iter(tile_tables.values())).results
    panels = [
        panel
        for result in select_for_figure(results, lambda c: len(c.predictions[0].truth))
        for panel in make_tile_panels(result, titles, TILE_AREA)
    ]
    write_study_report(
        options,
        console,
        make_title(options, models_used),
        {"rows": rows, "margin_tests": margin_tests},
        study_tables,
        panels,
        3,
    )


def check_margins(sensors: str, table: TileTable, frame_counts: tuple[int, ...]) -> list[MapMarginTest]:
    """Test more frames against one: margin and target at the largest number, and no number below one frame."""
    one, *more = map(str, frame_counts)
    margins = ((more[-1], MARGIN, ""), (more[-1], TARGET_MARGIN, ", goal"), *((name, 0.0, "") for name in more))
    return [
        table.check_margin(f"{sensors}: {name} frames - one vehicle{suffix}", name, one, margin)
        for name, margin, suffix in margins
    ]
