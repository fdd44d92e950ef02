# SPDX-License-Identifier: Apache-2.0
"""Judges a map against the truth, or runs a study: methods side by side over places, counts and seeds, against bars.

Studies: fusion (four test places), fleet-pose-noise (pose noise of 0 to 1.5 m), crowdmap-table3 (Table 3 of the CrowdMap paper),
adversarial (displacement by malicious agents), tuning (hyperparameter search with equal budgets, on other places).
Of the map model, on a recording of towns outside its training set: local, semi-global and full-map (Tables 1 to 3 of that paper,
from sensors), map-pose-noise (tiles under pose noise, with and without pose correction).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError
from manyeyes.studies.maps import MODEL_STUDIES
from manyeyes.studies.maps.options import Options

if TYPE_CHECKING:
    from rich.console import Console

STUDIES = ("fusion", "fleet-pose-noise", "crowdmap-table3", "adversarial", "tuning", *MODEL_STUDIES)


def main(options: Options) -> None:
    """Evaluate a map, or run a study of maps."""
    from rich.console import Console

    if options.study is not None and options.study not in STUDIES:
        raise ConfigError(f"No study is called {options.study!r}; known: {', '.join(STUDIES)}.")
    if (options.study is None) == (options.folder is None):
        raise ConfigError(f"Give a map's folder, or --study with one of {', '.join(STUDIES)}.")
    console = Console()
    if options.folder is not None:
        _evaluate_map(options, options.folder, console)
        return
    if options.study in MODEL_STUDIES:
        from manyeyes.studies.maps import run_model_study

        run_model_study(options, console)
        return
    from manyeyes.studies.maps.fleet import run_study_command

    run_study_command(options, console)


def _evaluate_map(options: Options, path: Path, console: Console) -> None:
    from manyeyes.evaluation.maps.map_cells import evaluate_map_rows
    from manyeyes.evaluation.maps.spatial_bootstrap import MetricIntervals, bootstrap_ap_interval, bootstrap_f1_interval
    from manyeyes.studies import provenance
    from manyeyes.studies.map_folder import MapFolder, read_vector_map
    from manyeyes.viz.map_table import make_kinds_table

    truth_folder = options.truth or path.parent / "truth"
    if not truth_folder.is_dir():
        raise ConfigError(f"{truth_folder}: no truth there; name one with --truth.")
    vector_map, truth = read_vector_map(path).select_published().elements, read_vector_map(truth_folder).elements
    cut_policy = MapFolder(truth_folder.parent).read_cut_policy()
    evaluated = cut_policy(vector_map) if cut_policy else vector_map
    ap, kinds = evaluate_map_rows(evaluated, truth)
    console.print(make_kinds_table(ap, kinds, f"{path} against {truth_folder}"))
    intervals = tuple(
        MetricIntervals(
            row.kind,
            bootstrap_ap_interval(evaluated, truth, row.kind),
            bootstrap_f1_interval(evaluated, truth, row.kind),
        )
        for row in kinds
        if row.n_truth
    )
    for interval in intervals:
        console.print(
            f"{interval.kind}: AP exact {interval.ap.value:.3f} [{interval.ap.low:.3f}, {interval.ap.high:.3f}], "
            f"F@0.5 m {interval.f1.value:.3f} [{interval.f1.low:.3f}, {interval.f1.high:.3f}] over "
            f"{interval.ap.num_scenarios} squares of 64 m",
            highlight=False,
            soft_wrap=True,
        )
    out = path / "quality.json"
    provenance.write_json(out, {"ap": ap, "kinds": kinds, "intervals": intervals}, options, None)
    console.print(f"All numbers are in {out}", highlight=False, soft_wrap=True)
