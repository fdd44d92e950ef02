# SPDX-License-Identifier: Apache-2.0
"""Cost of adding one observation to a map of many elements: ``python benchmarks/map_stream.py [elements]``.

The map is that of 60 observations of the generated crossroads, set side by side until it has so many elements (100,000
unless another number
is given); 120 more observations of the same crossroads are added to its first copy. Times are of one process.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import IncrementalMap
from manyeyes.simulator.fleet import load_place, simulate_crowd

WARM_UP, APART_M = 3, 400.0


def main(elements: int) -> None:
    crossroads = load_place("cross")
    one = fuse(simulate_crowd(crossroads, 60).observations).select_published().elements
    copies = -(-elements // len(one))
    side = int(np.ceil(np.sqrt(copies)))
    spots = [(APART_M * (k % side), APART_M * (k // side)) for k in range(copies)]
    live = IncrementalMap(VectorMap.of(MapElements.cat([one.transform(x, y, 0.0) for x, y in spots])))
    spent, seen = [], []
    for observation in simulate_crowd(crossroads, 120, seed=1).observations:
        begin = time.perf_counter()
        live.update(observation)
        spent.append((time.perf_counter() - begin) * 1e3)
        seen.append(len(observation.elements))
    low, middle, high = np.quantile(spent[WARM_UP:], (0.0, 0.5, 0.95))
    print(
        f"{copies * len(one)} elements, {copies * len(one.points)} stations; {np.mean(seen):.1f} elements an observation"
    )
    print(f"ms an observation: min {low:.2f}, median {middle:.2f}, 95 % below {high:.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
