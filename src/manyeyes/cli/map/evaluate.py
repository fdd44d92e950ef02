# SPDX-License-Identifier: Apache-2.0
"""Evaluate a map against the ground truth: AP, F1 by length, duplication, fragmentation, with intervals over squares of 64 m."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from manyeyes._bounds import InputMap
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """The map to evaluate."""

    folder: tyro.conf.Positional[str]
    """The map: the folder of 'map fuse', or a store in a folder or at a URL (s3://bucket/city; city@2 is its release 2)."""
    truth: InputMap | None = None
    """The true map, likewise; 'truth' beside the map's folder is found by itself."""


def main(options: Options) -> None:
    """Evaluate a map against the ground truth."""
    from rich.console import Console

    from manyeyes.evaluation.maps.metrics import evaluate_map
    from manyeyes.evaluation.maps.spatial_bootstrap import MetricIntervals, bootstrap_ap_interval, bootstrap_f1_interval
    from manyeyes.maps.store.map_place import MapPlace
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder, read_vector_map
    from manyeyes.viz.map_table import PROTOCOLS, make_kinds_table

    console, place = Console(), MapPlace.parse(options.folder)
    vector_map = read_vector_map(options.folder).select_published().elements
    true_place = options.truth or place.beside("truth")
    if true_place is None:
        raise ConfigError(f"{place}: there is no folder 'truth' beside this map; name the true map with --truth.")
    truth = read_vector_map(true_place).elements
    true_folder = MapPlace.parse(true_place).folder
    cut_policy = None if true_folder is None else MapFolder(true_folder.parent).read_cut_policy()
    evaluated = cut_policy(vector_map) if cut_policy else vector_map
    metrics = evaluate_map(evaluated, truth)
    console.print(make_kinds_table(metrics, f"{place} against {true_place}"))
    intervals = tuple(
        MetricIntervals(
            row.kind,
            bootstrap_ap_interval(evaluated, truth, row.kind),
            bootstrap_f1_interval(evaluated, truth, row.kind),
        )
        for row in metrics.kinds
        if row.n_truth
    )
    for interval in intervals:
        console.print(
            f"{interval.kind}: AP exact {interval.ap.value:.3f} [{interval.ap.low:.3f}, {interval.ap.high:.3f}], "
            f"F1@0.5 m {interval.f1.value:.3f} [{interval.f1.low:.3f}, {interval.f1.high:.3f}] over "
            f"{interval.ap.num_scenarios} squares of 64 m",
            highlight=False,
            soft_wrap=True,
        )
    out, mean_ap = place.output_folder / "quality.json", {protocol: metrics.mean_ap(protocol) for protocol in PROTOCOLS}
    provenance.write_json(out, {"mean_ap": mean_ap, "kinds": metrics.kinds, "intervals": intervals}, options, None)
    console.print(f"All numbers are in {out}", highlight=False, soft_wrap=True)
