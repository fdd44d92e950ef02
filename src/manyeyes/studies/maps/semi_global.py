# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 2: tiles of 120 m by 60 m from one vehicle's frame and from more frames, with their bytes."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.evaluation.maps.tile_metrics import TileRow, TileTable, split_by_curvature
from manyeyes.evaluation.maps.tile_prediction import SemiGlobalPredictor
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.model_study import make_rows_table, make_tile_panels, prepare_map_study, select_for_figure
from manyeyes.studies.options import MapModelOptions
from manyeyes.viz.study_table import StudyTable, make_comparison_table

TILE_AREA = (-60.0, -30.0, 60.0, 30.0)
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 2: DAIR-V2X, cameras; for reference only",
    ("frames", "method", "AP crossing", "AP divider", "mAP"),
    (("1", "MapTR", "0.182", "0.103", "0.143"), ("10", "CrowdMap", "0.599", "0.682", "0.641")),
)


def run(options: MapModelOptions, context: StudyContext) -> None:
    """Run the study of semi-global tiles and write its report."""
    study, predictor = prepare_map_study(options, context), SemiGlobalPredictor()
    tile_tables = study.predict_tables(predictor)
    names = tuple(map(str, predictor.frame_counts))
    rows = {sensors: [table.make_row(name) for name in names] for sensors, table in tile_tables.items()}
    comparisons = [c for sensors, table in tile_tables.items() for c in make_comparisons(sensors, table, names)]
    by_curvature = {sensors: make_curvature_rows(table, names[-1]) for sensors, table in tile_tables.items()}
    tables = [
        make_rows_table("Tiles, by sensors and frames", rows),
        make_rows_table(f"Tiles of {names[-1]} frames, by the curvature of their dividers", by_curvature),
        make_comparison_table(comparisons),
        PAPER_TABLE,
    ]
    titles = {names[0]: "one vehicle", names[-1]: f"{names[-1]} frames"}
    results = next(iter(tile_tables.values())).results
    panels = [
        panel
        for result in select_for_figure(results, lambda c: len(c.predictions[0].truth))
        for panel in make_tile_panels(result, titles, TILE_AREA)
    ]
    payload = {"rows": rows, "curvature_rows": by_curvature, "comparisons": comparisons}
    study.write_report(payload, tables, panels, 3)


def make_curvature_rows(table: TileTable, name: str) -> list[TileRow]:
    """Return the row of a name for tiles with straight and with curved dividers (``evaluation.maps.curvature``) apart."""
    return [
        replace(TileTable(part).make_row(name), name=side) for side, part in split_by_curvature(table.results).items()
    ]


def make_comparisons(sensors: str, table: TileTable, names: tuple[str, ...]) -> list[Comparison]:
    """Compare each larger number of frames with one frame."""
    return [table.compare(f"{sensors}: {name} frames - one vehicle", name, names[0]) for name in names[1:]]
