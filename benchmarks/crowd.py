# SPDX-License-Identifier: Apache-2.0
"""Cost of simulated map observations: elements and processor time of one observation, by place.

The place is made, and one observation of it, before the clock starts. Processor time of this process is counted, so that a busy
machine does not show.

python benchmarks/crowd.py [--count 1000] [--out benchmarks/results/crowd.json]
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manyeyes.simulator.fleet.config import crowd_config
from manyeyes.simulator.fleet.place import load_place
from manyeyes.simulator.fleet.simulate import simulate_crowd
from manyeyes.studies.provenance import write_json

CASES = (
    ("cross", "local", 300.0),
    ("Town03", "local", 300.0),
    ("Town05", "local", 300.0),
    ("av2-miami", "local", 300.0),
    ("av2-pittsburgh", "local", 300.0),
    ("Town03", "semi-global", 300.0),
    ("grid-20", "semi-global", None),
)


@dataclass(frozen=True)
class Result:
    """Elements an observation (mean), milliseconds an observation, and true elements and kilometres of lanes of the place."""

    place: str
    crowd: str
    size_m: float | None
    true_elements: int
    lanes_km: float
    elements: float
    ms: float


def measure(name: str, crowd: str, size_m: float | None, count: int) -> Result:
    """One place."""
    where, config = load_place(name, size_m), crowd_config(crowd)
    simulate_crowd(where, 1, config)
    start = time.process_time()
    made = simulate_crowd(where, count, config)
    ms = (time.process_time() - start) / count * 1e3
    elements = float(np.mean([len(o.elements) for o in made.observations]))
    return Result(name, crowd, size_m, len(where.truth), where.routes.lengths.sum() / 1e3, elements, ms)


def main() -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    results = []
    for case in CASES:
        r = measure(*case, options.count)
        results.append(r)
        size = "all" if r.size_m is None else f"{r.size_m:g} m"
        print(
            f"{r.place:15} {r.crowd:12} {size:6} {r.true_elements:6} true, {r.lanes_km:6.1f} km of lanes; "
            f"{r.elements:5.1f} elements, {r.ms:5.2f} ms an observation"
        )
    if options.out is not None:
        settings = {"count": options.count, "threads": 1, "load": os.getloadavg()[0]}
        command = shlex.join(["python", *sys.argv])
        write_json(options.out, {"command": command, "settings": settings, "rows": results}, settings, 0)


if __name__ == "__main__":
    main()
