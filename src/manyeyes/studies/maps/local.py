# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 1: local maps of single agents, 30 m by 30 m ahead of a vehicle, 50 m by 30 m ahead of a roadside unit.

The paper trains a MapTR for each kind of agent; here one model of tiles draws for both, and the window is cut out of its tile.
Pictures: the paper's Fig. 2, drawings over the truth in pale.
"""

from __future__ import annotations

from dataclasses import replace

from manyeyes.agents.map_perception import MAP_MODES
from manyeyes.evaluation.maps.tile_prediction import ROADSIDE, VEHICLE, LocalPredictor, ScenarioPredictions
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.model_study import make_rows_table, make_tile_panels, prepare_map_study, select_for_figure
from manyeyes.studies.options import MapModelOptions
from manyeyes.viz.study_table import StudyTable

WINDOWS = {VEHICLE: MAP_MODES["local"].vehicle_window, ROADSIDE: MAP_MODES["local"].roadside_window}
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 1: DAIR-V2X, one camera an agent; for reference only",
    ("range", "agent", "AP crossing", "AP divider", "mAP"),
    (("30 x 30 m", VEHICLE, "0.745", "0.909", "0.827"), ("50 x 30 m", ROADSIDE, "0.772", "0.785", "0.778")),
)


def run(options: MapModelOptions, context: StudyContext) -> None:
    """Run the study of local maps and write its report."""
    study = prepare_map_study(options, context)
    tile_tables = study.predict_tables(LocalPredictor())
    names = tuple(WINDOWS)
    rows = {
        sensors: [table.make_row(name) for name in names if name in table.names]
        for sensors, table in tile_tables.items()
    }
    results_table = make_rows_table("Local maps, by sensors and agent", rows)
    results = next(iter(tile_tables.values())).results
    panels = []
    for name, area in WINDOWS.items():
        row_results = [one for result in results if (one := _keep_first(result, name)) is not None]
        for result in select_for_figure(row_results, lambda c: len(c.predictions[0].truth), 2) if row_results else ():
            panels += make_tile_panels(result, {name: name}, area)
    study.write_report({"rows": rows}, [results_table, PAPER_TABLE], panels, 4)


def _keep_first(result: ScenarioPredictions, row_name: str) -> ScenarioPredictions | None:
    """Return the cell with the first drawing of a row alone."""
    predictions = [one for one in result.predictions if one.row_name == row_name]
    return replace(result, predictions=(predictions[0],)) if predictions else None
