# SPDX-License-Identifier: Apache-2.0
"""Studies of map fusion as the command line runs them: progress, tables, JSON and Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._io import atomic_write_text
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import check_method, make_tuned_settings
from manyeyes.evaluation.maps.study import (
    TEST_PLACES,
    MapStudyConfig,
    check_margins,
    restrict_study,
    run_map_study,
    summarize_methods,
)
from manyeyes.maps.registry import list_map_fusions
from manyeyes.maps.store.executors import Executor, InlineExecutor, ProcessExecutor
from manyeyes.studies import provenance
from manyeyes.viz.map_table import (
    format_adversarial,
    format_study,
    make_adversarial_table,
    make_margin_table,
    make_study_table,
)
from manyeyes.viz.progress import make_progress_bars

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

TITLES = {
    "fusion": "Fusion on places that nothing was tuned on",
    "fleet-pose-noise": "Fusion under errors of claimed poses",
    "crowdmap-table3": "Two intersections, stage-1 input local and semi-global (after CrowdMap, Table 3)",
}


def run_study_command(options: Options, console: Console) -> None:
    """Runs the named study; cells that are kept are not made again."""
    for method in options.methods:
        check_method(method)
    if options.study == "tuning":
        _run_search(options, console)
    elif options.study == "adversarial":
        _run_adversarial_study(options, console)
    else:
        _run_fusion_study(options, console)


def choose_executor(workers: int) -> Executor:
    """This process, or a pool."""
    return ProcessExecutor(workers) if workers > 1 else InlineExecutor()


def _run_fusion_study(options: Options, console: Console) -> None:
    name = str(options.study)
    methods = (*(options.methods or list_map_fusions()), *(ORACLES if options.oracles else ()))
    config = MapStudyConfig(name, methods=methods, settings=make_tuned_settings())
    config = restrict_study(config, options.places, options.observation_counts, options.seeds)
    with make_progress_bars(console) as progress:
        task = progress.add_task("Trials", total=None)
        results = run_map_study(
            config,
            options.out / "cells",
            choose_executor(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    summaries, margin_tests = summarize_methods(config, results), check_margins(config, results)
    for group in dict.fromkeys(summary.group for summary in summaries):
        console.print(make_study_table(summaries, group))
        console.print()
    if margin_tests:
        console.print(make_margin_table(margin_tests))
    payload = {"summaries": summaries, "margin_tests": margin_tests, "results": results}
    provenance.write_json(options.out / f"{name}.json", payload, {"options": options, "study": config}, 0)
    atomic_write_text(options.out / f"{name}.md", format_study(TITLES[name], summaries, margin_tests))
    console.print(f"\nTable and numbers are in {options.out / name}.md and .json", highlight=False, soft_wrap=True)


def _run_search(options: Options, console: Console) -> None:
    from manyeyes.evaluation.maps.hyperparameter_search import NUM_CONFIGS, SEARCH_SPACE, run_random_search

    methods = options.methods or list_map_fusions()
    with make_progress_bars(console) as progress:
        task = progress.add_task("Cells", total=None)
        search_trials = run_random_search(
            methods,
            options.out / "cells",
            choose_executor(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    for method in methods:
        best = next(a for a in search_trials if a.method == method)
        default = next(a for a in search_trials if a.method == method and a.config_index == 0)
        changes = ", ".join(f"{name}={value}" for name, value in best.changes) or "its defaults"
        console.print(
            f"{method}: {best.mean_ap:.3f} ({default.mean_ap:.3f} by default) with {changes}",
            highlight=False,
            soft_wrap=True,
        )
    payload = {"budget": NUM_CONFIGS, "search_trials": search_trials}
    provenance.write_json(options.out / "tuning.json", payload, {"options": options, "search_space": SEARCH_SPACE}, 0)
    console.print(f"All attempts are in {options.out / 'tuning.json'}", highlight=False, soft_wrap=True)


def _run_adversarial_study(options: Options, console: Console) -> None:
    from manyeyes.evaluation.maps.adversarial import make_adversarial_jobs, run_adversarial_jobs

    settings = make_tuned_settings()
    jobs = make_adversarial_jobs(options.places or TEST_PLACES, range(options.seeds), settings, options.out / "cells")
    with make_progress_bars(console) as progress:
        task = progress.add_task("Trials", total=len(jobs))
        results = run_adversarial_jobs(
            jobs,
            choose_executor(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    console.print(make_adversarial_table(results))
    provenance.write_json(
        options.out / "adversarial.json", {"trials": results}, {"options": options, "settings": settings}, 0
    )
    atomic_write_text(options.out / "adversarial.md", format_adversarial(results))
    console.print(
        f"Table and numbers are in {options.out / 'adversarial'}.md and .json", highlight=False, soft_wrap=True
    )
