# SPDX-License-Identifier: Apache-2.0
"""Evaluate a map against the ground truth: AP, F1 by length, duplication, fragmentation, with intervals over squares of 64 m."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from manyeyes._bounds import InputPath
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class Options:
    """The map to evaluate."""

    folder: tyro.conf.Positional[Path]
    """The map's folder, of 'map fuse'."""
    truth: InputPath | None = None
    """A map's folder with the truth; 'truth' beside the map is found by itself."""


def main(options: Options) -> None:
    """Evaluate a map against the ground truth."""
    from rich.console import Console

    from manyeyes.evaluation.maps.metrics import evaluate_map
    from manyeyes.evaluation.maps.spatial_bootstrap import MetricIntervals, bootstrap_ap_interval, bootstrap_f1_interval
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder, read_vector_map
    from manyeyes.viz.map_table import PROTOCOLS, make_kinds_table

    console, path = Console(), options.folder
    vector_map = read_vector_map(path).select_published().elements
    truth_folder = options.truth or path.parent / "truth"
    if not truth_folder.is_dir():
        raise ConfigError(f"{truth_folder}: no truth there; name one with --truth.")
    truth = read_vector_map(truth_folder).elements
    cut_policy = MapFolder(truth_folder.parent).read_cut_policy()
    evaluated = cut_policy(vector_map) if cut_policy else vector_map
    metrics = evaluate_map(evaluated, truth)
    console.print(make_kinds_table(metrics, f"{path} against {truth_folder}"))
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
    out, mean_ap = path / "quality.json", {protocol: metrics.mean_ap(protocol) for protocol in PROTOCOLS}
    provenance.write_json(out, {"mean_ap": mean_ap, "kinds": metrics.kinds, "intervals": intervals}, options, None)
    console.print(f"All numbers are in {out}", highlight=False, soft_wrap=True)
