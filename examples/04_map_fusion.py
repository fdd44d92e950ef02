# SPDX-License-Identifier: Apache-2.0
"""Fuse sixty noisy local maps of a crossroads into one map, evaluate the result and draw it.

python examples/04_map_fusion.py out/crossroads.html
"""

import sys
from pathlib import Path

from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.maps.elements.observation_file import read_observations, write_observations
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.simulator.fleet.place import load_place
from manyeyes.simulator.fleet.simulate import simulate_crowd
from manyeyes.viz.map_page import make_page, save_map_page

page = Path(sys.argv[1] if len(sys.argv) > 1 else "out/crossroads.html")
page.parent.mkdir(parents=True, exist_ok=True)

# A fleet drives through a crossroads; each Observation has a reported pose, a view and map elements.
where = load_place("cross", size_m=160.0)
crowd = simulate_crowd(where, 60, seed=1)

# Observations of your own are read from a file in the format of docs/reference/map-observations.md: one row per observation.
file = page.with_name("observations.parquet")
write_observations(file, crowd.observations, where.frame)
observations = read_observations(file).observations

made = fuse(observations, frame=where.frame).select_published()
union = MapElements.cat([observation.elements_in_map() for observation in observations])
truth = where.clip_to_area()
for name, elements in (("fused", made.elements), ("union", union)):
    quality = evaluate_map(where.clip_to_area(elements), truth)
    divider = quality.get_length_score("divider")
    print(
        f"{name}: {len(elements)} elements, mAP {quality.mean_ap():.2f}, dividers: precision {divider.precision:.2f}, "
        f"recall {divider.recall:.2f}, duplication {quality.get_kind('divider').duplication:.2f}"
    )

save_map_page(make_page("Crossroads", made, truth, observations), page)
print(f"wrote {page}")
