# SPDX-License-Identifier: Apache-2.0
"""Measure how often stations of given log-odds, number of agents and views exist; write tables of ``existence_calibration``.

A station of a line exists if a true line of its kind lies within 0.5 m; a crossing, if it overlaps a true one with an intersection
over union of 0.5. Tuning places only. Frequencies by the nearest log-odds of the table are made monotone: in log-odds by isotonic
regression (pool adjacent violators; Barlow et al., 1972), from class to class by a cumulative maximum.

python benchmarks/existence_calibration.py --out benchmarks/results/maps/existence.json
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import CROSSING, DIVIDER
from manyeyes.evaluation.maps.experiment import FleetExperiment, FleetTrial, run_trial
from manyeyes.maps.fusion.existence import EvidenceConfig, EvidenceTable
from manyeyes.maps.fusion.existence_calibration import LOG_ODDS, MIN_VIEWS
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays
from manyeyes.maps.fusion.pose_config import PoseSolverConfig
from manyeyes.maps.fusion.pose_optimization import solve_poses
from manyeyes.maps.fusion.stations import StationConfig, StationTable, build_stations
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.studies.maps.tuning import PLACES, SEED
from manyeyes.studies.provenance import write_json

OBSERVATION_COUNTS = (20, 60, 200)
MAX_DISTANCE_M, MIN_IOU, MIN_COUNT = 0.5, 0.5, 5
CLASSES = ("one view", "1", "2", "3+")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Counts by log-odds of the table: stations, and those of them that exist; agents: of CLASSES."""

    element: str
    num_observations: int
    agents: str
    stations: tuple[int, ...]
    existing: tuple[int, ...]


def count_stations(experiment: FleetExperiment) -> tuple[Floats, Floats]:
    """Return log-odds, class and existence (K, 3) of the stations of lines and of the crossings of a trial."""
    config = StationConfig(evidence=EvidenceConfig(min_publish_prob=0.0, min_publish_agents=1))
    solver = PoseSolverConfig()
    solution = solve_poses(experiment.observations, solver)
    arrays = to_observation_arrays(experiment.observations, solver.spacing_m)
    table = build_stations(arrays, solution, None, config)
    return _lines(table, experiment), _crossings(table, experiment)


def _lines(table: StationTable, experiment: FleetExperiment) -> Floats:
    truth, evidence, place = experiment.truth, table.line_evidence, experiment.place
    points = np.asarray(shapely.points(table.xy))
    # The policy of every evaluation leaves out dividers in junctions.
    judged = shapely.contains(shapely.box(*place.area), points)
    judged &= ~(shapely.intersects(place.junctions, points) & (evidence.kind == DIVIDER))
    exists = np.zeros(len(table), bool)
    for kind in np.unique(truth.kind[truth.kind != CROSSING]):
        lines = shapely.MultiLineString([truth.polyline(int(k)) for k in np.flatnonzero(truth.kind == kind)])
        own = evidence.kind == kind
        exists[own] = shapely.distance(points[own], lines) <= MAX_DISTANCE_M
    return np.stack((evidence.log_odds, _classify(evidence), exists), 1)[judged]


def _crossings(table: StationTable, experiment: FleetExperiment) -> Floats:
    truth, evidence, area = experiment.truth, table.ring_evidence, shapely.box(*experiment.place.area)
    true = [shapely.Polygon(truth.polyline(int(k))) for k in np.flatnonzero(truth.kind == CROSSING)]
    found = []
    for k, (start, end) in enumerate(zip(table.ring_offsets[:-1], table.ring_offsets[1:])):
        ring = shapely.Polygon(table.ring_xy[start:end])
        if area.contains(ring.centroid):
            iou = max((ring.intersection(other).area / ring.union(other).area for other in true), default=0.0)
            found.append((evidence.log_odds[k], _classify(evidence)[k], iou >= MIN_IOU))
    return np.array(found, np.float64).reshape(-1, 3)


def _classify(evidence: EvidenceTable) -> Floats:
    """Return the place in CLASSES (K,): by the number of agents, and for one agent by the sum of visibilities."""
    return np.where(evidence.coverage < MIN_VIEWS, 0, np.minimum(evidence.agents, 3)).astype(np.float64)


def tally(element: str, num_observations: int, stations: Floats) -> list[Row]:
    """Count stations (K, 3) of log-odds from 0 by class and nearest log-odds of the table; beyond its end, of the last."""
    rows, edges = [], (np.array(LOG_ODDS)[1:] + np.array(LOG_ODDS)[:-1]) / 2
    for place, name in enumerate(CLASSES):
        own = stations[(stations[:, 1] == place) & (stations[:, 0] >= 0.0)]
        column = np.searchsorted(edges, own[:, 0], side="right")
        counts = [np.bincount(column, weights, len(LOG_ODDS)).astype(int) for weights in (None, own[:, 2])]
        rows.append(Row(element, num_observations, name, *(tuple(c.tolist()) for c in counts)))
    return rows


def fit_monotone(counts: Floats, existing: Floats) -> Floats:
    """Fit probabilities (C, B) that grow with log-odds and from class to class; few stations take the column before."""
    fitted = []
    for total, true in zip(counts, existing):
        known = np.flatnonzero(total >= MIN_COUNT)
        blocks: list[list[float]] = []  # true, total, number of columns
        for column in known:
            blocks.append([true[column], total[column], 1])
            while len(blocks) > 1 and blocks[-2][0] * blocks[-1][1] >= blocks[-1][0] * blocks[-2][1]:
                last = blocks.pop()
                blocks[-1] = [a + b for a, b in zip(blocks[-1], last)]
        level = np.repeat([a / b for a, b, _ in blocks], [int(n) for _, _, n in blocks])
        at = np.searchsorted(known, np.arange(len(total)), side="right") - 1
        fitted.append(np.where(at >= 0, level[at], 0.0))
    return np.maximum.accumulate(fitted, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=int, default=3, help="seeds of the lines; crossings, which are few, have four times as many"
    )
    parser.add_argument("--out", type=Path, required=True)
    wanted = parser.parse_args()
    rows: list[Row] = []
    for count in OBSERVATION_COUNTS:
        lines, crossings = [], []
        for place in PLACES:
            for k in range(wanted.seeds if count == max(OBSERVATION_COUNTS) else 4 * wanted.seeds):
                found = count_stations(run_trial(FleetTrial(place, count, SEED + k, fleet_config=CROWDS["local"])))
                lines += [found[0]] if k < wanted.seeds else []
                crossings.append(found[1])
        rows += tally("line", count, np.concatenate(lines)) + tally("crossing", count, np.concatenate(crossings))
    tables = {}
    for element in ("line", "crossing"):
        total, true = (
            np.array(
                [np.sum([getattr(r, name) for r in rows if (r.element, r.agents) == (element, a)], 0) for a in CLASSES]
            )
            for name in ("stations", "existing")
        )
        if element == "crossing":
            # Too few to tell the classes of one agent apart.
            total, true = (np.stack((a[0] + a[1], a[0] + a[1], a[2], a[3])) for a in (total, true))
        tables[element] = np.round(fit_monotone(total, true), 2).tolist()
        print(element, *tables[element], sep="\n", flush=True)
    result = {"command": shlex.join(["python", *sys.argv]), "log_odds": LOG_ODDS, "tables": tables, "rows": rows}
    write_json(
        wanted.out,
        result,
        {"places": PLACES, "observation_counts": OBSERVATION_COUNTS, "seeds": wanted.seeds},
        seed=SEED,
    )


if __name__ == "__main__":
    main()
