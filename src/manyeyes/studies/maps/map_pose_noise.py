# SPDX-License-Identifier: Apache-2.0
"""Tiles under pose noise, 0.5 m and 1 degree: clean, noisy, and noisy with pose correction.

Frames are those of one snapshot, since the corrector matches vehicles that both agents detect, which move between snapshots.
Half of the AP drop is the reference of the corrector: corrected - (clean + noisy) / 2.
"""

from __future__ import annotations

from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.evaluation.maps.pooled_ap import average_samples
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import (
    CLEAN,
    CLEAN_CORRECTED,
    CORRECTED,
    NOISY,
    SINGLE_VEHICLE,
    PoseNoisePredictor,
)
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.model_study import make_rows_table, make_tile_panels, prepare_map_study, select_for_figure
from manyeyes.studies.maps.semi_global import TILE_AREA
from manyeyes.studies.options import MapPoseNoiseOptions
from manyeyes.viz.study_table import make_comparison_table

ROW_NAMES = (SINGLE_VEHICLE, CLEAN, NOISY, CORRECTED, CLEAN_CORRECTED)


def run(options: MapPoseNoiseOptions, context: StudyContext) -> None:
    """Run the study of map tiles under pose noise and write its report."""
    predictor = PoseNoisePredictor(pose_correction=PoseCorrection(options.pose_correction))
    study = prepare_map_study(options, context)
    tile_tables = study.predict_tables(predictor)
    rows = {sensors: [table.make_row(name) for name in ROW_NAMES] for sensors, table in tile_tables.items()}
    comparisons = [c for sensors, table in tile_tables.items() for c in make_comparisons(sensors, table)]
    sigma_deg = predictor.sigma_m * predictor.deg_per_m
    title = f"Tiles, pose noise of other agents {predictor.sigma_m:g} m and {sigma_deg:g} degrees (sigma)"
    tables = [make_rows_table(title, rows), make_comparison_table(comparisons)]
    results = next(iter(tile_tables.values())).results
    panels = [
        panel
        for result in select_for_figure(results, lambda c: len(c.predictions[0].truth))
        for panel in make_tile_panels(result, {name: name for name in (CLEAN, NOISY, CORRECTED)}, TILE_AREA)
    ]
    study.write_report({"rows": rows, "comparisons": comparisons}, tables, panels, 4)


def make_comparisons(sensors: str, table: TileTable) -> list[Comparison]:
    """Compare what noise costs, what the corrector recovers of it, and what it costs where there is no noise."""
    half_loss = average_samples([table.bootstrap_mean_ap(CLEAN), table.bootstrap_mean_ap(NOISY)])
    recovered = table.bootstrap_mean_ap(CORRECTED).paired_difference(half_loss)
    return [
        Comparison(f"{sensors}: corrected - (clean + noisy) / 2", "mAP", recovered),
        table.compare(f"{sensors}: clean - noisy", CLEAN, NOISY),
        table.compare(f"{sensors}: corrected - noisy", CORRECTED, NOISY),
        table.compare(f"{sensors}: corrected - one vehicle", CORRECTED, SINGLE_VEHICLE),
        table.compare(f"{sensors}: corrected without noise - clean", CLEAN_CORRECTED, CLEAN),
    ]
