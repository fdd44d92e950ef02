# SPDX-License-Identifier: Apache-2.0
"""How far the incremental map is from the batch fusion of the same observations.

The batch map of all but the last observations takes the last ones one by one. Points every metre of the published lines of the
incremental map are measured against those of the batch map of all observations, of the same kind: distances at the median, the
95th and the 99th percentile (bar: 1 cm at the 99th). Beside them the same distances without the last observations.

python benchmarks/map_incremental.py [--seeds 3] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import IncrementalMap
from manyeyes.ops.nearest_line import find_nearest_line
from manyeyes.ops.polyline import resample_spaced
from manyeyes.simulator.fleet import CROWDS
from manyeyes.studies.provenance import write_json

PLACE, OBSERVATION_COUNTS, LAST_COUNTS = "Town07", (60, 200), (1, 10)
QUANTILES, MAX_DISTANCE_M = (0.5, 0.95, 0.99), 20.0

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Distances to the batch map at QUANTILES, metres; unchanged_m: of the map before the last observations."""

    observations: int
    last: int
    points: int
    distance_m: tuple[float, ...]
    unchanged_m: tuple[float, ...]


def measure_distances(one: VectorMap, other: VectorMap) -> Floats:
    """Return distances (P,) from points of one map's published lines to the nearest line of the other's, by kind, metres."""
    found = []
    for kind in (DIVIDER, BOUNDARY):
        lines, others = (_take_kind(vector_map.select_published().elements, kind) for vector_map in (one, other))
        points, _ = resample_spaced(lines.points, lines.offsets, 1.0)
        found.append(find_nearest_line(points, others.points, others.offsets, MAX_DISTANCE_M).distance)
    return np.minimum(np.concatenate(found), MAX_DISTANCE_M)


def _take_kind(elements: MapElements, kind: int) -> MapElements:
    return elements.take(np.flatnonzero(elements.kind == kind))


def measure(count: int, last: int, seeds: range) -> Row:
    """Measure the distances over all seeds together."""
    incremental, unchanged = [], []
    for seed in seeds:
        experiment = run_trial(FleetTrial(PLACE, count, seed, fleet_config=CROWDS["local"]))
        observations, frame = list(experiment.observations), experiment.place.frame
        batch, before = fuse(observations, frame=frame), fuse(observations[:-last], frame=frame)
        grown = IncrementalMap(before)
        for observation in observations[-last:]:
            grown.update(observation)
        incremental.append(measure_distances(grown.build_map(), batch))
        unchanged.append(measure_distances(before, batch))
    distances, others = np.concatenate(incremental), np.concatenate(unchanged)
    quantiles = tuple(tuple(np.quantile(part, QUANTILES).round(4).tolist()) for part in (distances, others))
    return Row(count, last, len(distances), *quantiles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path)
    wanted = parser.parse_args()
    rows = [measure(count, last, range(wanted.seeds)) for count in OBSERVATION_COUNTS for last in LAST_COUNTS]
    headings = (
        "observations",
        "of these one by one",
        "points",
        *(f"{q:.0%} [m]" for q in QUANTILES),
        "99% without them [m]",
    )
    lines = [
        (
            f"{r.observations}",
            f"{r.last}",
            f"{r.points:,}",
            *(f"{d:.3f}" for d in r.distance_m),
            f"{r.unchanged_m[-1]:.3f}",
        )
        for r in rows
    ]
    for line in lines:
        print(*line, sep="  ")
    if wanted.out:
        command = shlex.join(["python", *sys.argv])
        table = {"title": "Incremental map", "headings": headings, "lines": lines}
        result = {"command": command, "study": "map-incremental", "rows": rows, "tables": [table]}
        write_json(wanted.out, result, {"place": PLACE, "seeds": wanted.seeds}, seed=0)


if __name__ == "__main__":
    main()
