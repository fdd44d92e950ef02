# SPDX-License-Identifier: Apache-2.0
"""Studies of map fusion as the command line runs them: progress, tables, JSON and Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._io import atomic_write_text
from manyeyes.evaluation.maps.oracles import ORACLES
from manyeyes.evaluation.maps.registry import METHODS, check_method, tuned
from manyeyes.evaluation.maps.study import TEST_PLACES, StudyConfig, lines, run_study, smaller, verdicts
from manyeyes.maps.store.executors import Executor, Inline, ProcessPool
from manyeyes.studies import provenance
from manyeyes.viz.map_table import (
    malice_markdown,
    malice_terminal,
    study_markdown,
    study_terminal,
    verdicts_terminal,
)
from manyeyes.viz.progress import bars

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.maps.options import Options

TITLES = {
    "fusion": "Fusion on places that nothing was tuned on",
    "noise": "Fusion under errors of claimed poses",
    "table3": "Two intersections, stage-1 input local and semi-global (after CrowdMap, Table 3)",
}


def study(options: Options, console: Console) -> None:
    """Runs the named study; cells that are kept are not made again."""
    for method in options.methods:
        check_method(method)
    if options.study == "tuning":
        _tune(options, console)
    elif options.study == "malicious":
        _malicious(options, console)
    else:
        _side_by_side(options, console)


def executor_of(workers: int) -> Executor:
    """This process, or a pool."""
    return ProcessPool(workers) if workers > 1 else Inline()


def _side_by_side(options: Options, console: Console) -> None:
    name = str(options.study)
    methods = (*(options.methods or METHODS), *(ORACLES if options.oracles else ()))
    config = StudyConfig(name, methods=methods, settings=tuned())
    config = smaller(config, options.places, options.counts, options.seeds)
    with bars(console) as progress:
        task = progress.add_task("Trials", total=None)
        cells = run_study(
            config,
            options.out / "cells",
            executor_of(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    table, held = lines(config, cells), verdicts(config, cells)
    for group in dict.fromkeys(line.group for line in table):
        console.print(study_terminal(table, group))
        console.print()
    if held:
        console.print(verdicts_terminal(held))
    payload = {"lines": table, "verdicts": held, "cells": cells}
    provenance.write_json(options.out / f"{name}.json", payload, {"options": options, "study": config}, 0)
    atomic_write_text(options.out / f"{name}.md", study_markdown(TITLES[name], table, held))
    console.print(f"\nTable and numbers are in {options.out / name}.md and .json", highlight=False, soft_wrap=True)


def _tune(options: Options, console: Console) -> None:
    from manyeyes.evaluation.maps.hyperparameter_search import BUDGET, CHOICES, tune

    methods = options.methods or METHODS
    with bars(console) as progress:
        task = progress.add_task("Cells", total=None)
        attempts = tune(
            methods,
            options.out / "cells",
            executor_of(options.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    for method in methods:
        best = next(a for a in attempts if a.method == method)
        first = next(a for a in attempts if a.method == method and a.number == 0)
        said = ", ".join(f"{name}={value}" for name, value in best.changed) or "its defaults"
        console.print(
            f"{method}: {best.worth:.3f} ({first.worth:.3f} by default) with {said}", highlight=False, soft_wrap=True
        )
    payload = {"budget": BUDGET, "attempts": attempts}
    provenance.write_json(options.out / "tuning.json", payload, {"options": options, "choices": CHOICES}, 0)
    console.print(f"All attempts are in {options.out / 'tuning.json'}", highlight=False, soft_wrap=True)


def _malicious(options: Options, console: Console) -> None:
    from manyeyes.evaluation.maps.adversarial import malice_units, run_malice

    settings = tuned()
    units = malice_units(options.places or TEST_PLACES, range(options.seeds), settings, options.out / "cells")
    with bars(console) as progress:
        task = progress.add_task("Trials", total=len(units))
        found = run_malice(
            units, executor_of(options.workers), lambda done, total: progress.update(task, completed=done, total=total)
        )
    console.print(malice_terminal(found))
    provenance.write_json(
        options.out / "malicious.json", {"trials": found}, {"options": options, "settings": settings}, 0
    )
    atomic_write_text(options.out / "malicious.md", malice_markdown(found))
    console.print(f"Table and numbers are in {options.out / 'malicious'}.md and .json", highlight=False, soft_wrap=True)
