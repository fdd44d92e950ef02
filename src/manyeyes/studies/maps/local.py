# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's Table 1: local maps of single agents, 30 m by 30 m ahead of a vehicle, 50 m by 30 m ahead of a roadside unit.

The paper trains a MapTR for each kind of agent. Here one tile model predicts for both unless roadside_weights are given, and the
window is cut out of its tile. Figures: the paper's Fig. 2, predictions over the ground truth in pale.
"""

from __future__ import annotations

from dataclasses import replace

from manyeyes.agents.map_perception import MAP_MODES
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.tile_metrics import TileTable
from manyeyes.evaluation.maps.tile_prediction import ROADSIDE, VEHICLE, LocalPredictor, ScenarioPredictions
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.maps.model_study import (
    MapModelStudy,
    make_rows_table,
    make_tile_panels,
    prepare_map_study,
    resolve_models,
    select_for_figure,
)
from manyeyes.studies.options import LocalMapOptions
from manyeyes.viz.study_table import StudyTable

WINDOWS = {VEHICLE: MAP_MODES["local"].vehicle_window, ROADSIDE: MAP_MODES["local"].roadside_window}
PAPER_TABLE = StudyTable(
    "CrowdMap's Table 1: DAIR-V2X, one camera an agent; for reference only",
    ("range", "agent", "AP crossing", "AP divider", "mAP"),
    (("30 x 30 m", VEHICLE, "0.745", "0.909", "0.827"), ("50 x 30 m", ROADSIDE, "0.772", "0.785", "0.778")),
)


def run(options: LocalMapOptions, context: StudyContext) -> None:
    """Run the study of local maps and write its report."""
    study = prepare_map_study(options, context)
    tile_tables = _predict_tables(study, options)
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


def _predict_tables(study: MapModelStudy, options: LocalMapOptions) -> dict[str, TileTable]:
    """Predict with one model for both kinds of agents, or with one model each."""
    if not options.roadside_weights:
        return study.predict_tables(LocalPredictor())
    roadside = replace(study, models=resolve_models(replace(options, weights=options.roadside_weights)))
    vehicle_sensors, roadside_sensors = ({model.sensors for model in one.models} for one in (study, roadside))
    if vehicle_sensors != roadside_sensors:
        raise ConfigError(
            f"--weights are for {', '.join(vehicle_sensors)} and --roadside-weights for {', '.join(roadside_sensors)}; give models "
            "of the same sensors."
        )
    vehicle_tables = study.predict_tables(LocalPredictor((VEHICLE,)))
    roadside_tables = roadside.predict_tables(LocalPredictor((ROADSIDE,)))
    return {
        sensors: TileTable((*table.results, *roadside_tables[sensors].results))
        for sensors, table in vehicle_tables.items()
    }


def _keep_first(result: ScenarioPredictions, row_name: str) -> ScenarioPredictions | None:
    """Return the cell with the first drawing of a row alone."""
    predictions = [one for one in result.predictions if one.row_name == row_name]
    return replace(result, predictions=(predictions[0],)) if predictions else None
