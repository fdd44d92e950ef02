# SPDX-License-Identifier: Apache-2.0
"""What studies have in common: what they start from, the sweep with its progress, and the files they write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import atomic_write_text
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datasets.base import Recording
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.significance import MarginTest
from manyeyes.evaluation.study import Condition, ResultGrid, run_conditions
from manyeyes.studies import provenance
from manyeyes.studies.recordings import adapt_to_dataset, check_files, choose_results_folder
from manyeyes.studies.replay_options import display_name
from manyeyes.viz.curves import CurvePanel, save_curves
from manyeyes.viz.progress import make_progress_bars
from manyeyes.viz.study_table import StudyTable, format_difference, format_markdown, make_terminal_table
from manyeyes.viz.table import missing_footer

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

NO_FUSION, OURS, UPPER_BOUND = "none", "intermediate", "early"
TOKEN_SELECTION_METHODS = ("intermediate", "intermediate-confidence", "intermediate-random")
PAPER_NOTE = (
    'The column "paper" holds CoSTr\'s own figures: another data set (OPV2V), unknown protocol; they are '
    "for reference only."
)


@dataclass(frozen=True)
class StudyContext:
    """What a study's conditions are changes of, the recording that they are played on, and files that it lacks."""

    options: Options
    console: Console
    opener: Callable[[], Recording]
    base: BenchmarkConfig
    missing: MissingFiles = NONE_MISSING

    @property
    def results_folder(self) -> Path:
        """The folder of the cells under --out, another one for each set of missing files."""
        return choose_results_folder(self.options.out, self.missing)

    @property
    def title(self) -> str:
        """Weights, data, and how many frames."""
        options, recording = self.options, self.base.filter_recording(self.opener())
        frames = sum(len(recording.eval_indices(name)) for name in recording.scenarios)
        data_name = f"{options.data.name}{f'/{options.split}' if options.split else ''}"
        return (
            f"{display_name(self.base.weights)} on {data_name}: {len(recording.scenarios)} scenarios, {frames} frames"
        )


def prepare_study(options: Options, console: Console, all_egos: bool = False) -> StudyContext:
    """The setting without any disturbance; names that are unknown are refused here, before any work."""
    if options.noise_xy_m or options.noise_yaw_deg or options.all_egos:
        raise ConfigError(
            "A study sets errors and egos itself: leave out --noise-xy-m, --noise-yaw-deg and --all-egos."
        )
    opener = partial(open_recording, options.data, options.split)
    recording = opener()
    missing = check_files(recording, options.checks, console)
    replay = adapt_to_dataset(
        options.replay_options.make_replay_config(options.seed, all_egos), options.replay_options, recording
    )
    base = BenchmarkConfig(
        options.replay_options.weights,
        options.replay_options.methods,
        options.protocol,
        replay,
        frame_stride=options.frame_stride,
    )
    return StudyContext(options, console, opener, base, missing)


def resolve_token_selection(options: Options) -> tuple[str, ...]:
    """The ways to choose tokens that are compared: those asked for, or those of SELECTORS that there are."""
    for name in options.token_selection:
        get_strategy(name)
    return options.token_selection or tuple(name for name in TOKEN_SELECTION_METHODS if name in list_strategies())


def run_study(context: StudyContext, conditions: Sequence[Condition]) -> ResultGrid:
    """The sweep; its cells lie in the folder of the start."""
    with make_progress_bars(context.console) as progress:
        task = progress.add_task("Judging", total=None)

        def report(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        options = context.options
        return run_conditions(context.opener, conditions, context.results_folder, options.workers, report)


def write_study_report(
    context: StudyContext,
    payload: dict[str, object],
    tables: Sequence[StudyTable],
    panels: Sequence[CurvePanel],
    conditions: Sequence[Condition],
    notes: Sequence[str] = (),
) -> None:
    """Table in the terminal; STUDY.json, STUDY.md and STUDY.png in the folder --out."""
    options, name = context.options, str(context.options.study)
    title = context.title
    footer = missing_footer(context.missing.count, f"{name}.json")
    notes = (*notes, footer) if footer else notes
    context.console.print(f"{title}\n", highlight=False, soft_wrap=True)
    for table in tables:
        context.console.print(make_terminal_table(table))
        context.console.print()
    for note in notes:
        context.console.print(note, highlight=False, soft_wrap=True)
    config = {"options": options, "conditions": conditions}
    provenance.write_json(
        options.out / f"{name}.json", {"title": title, "missing": context.missing, **payload}, config, options.seed
    )
    if panels:
        save_curves(panels, options.out / f"{name}.png")
    picture = f"![{name}]({name}.png)\n"
    text = "\n".join(
        [f"# {name}\n\n{title}\n", *map(format_markdown, tables), *(f"{note}\n" for note in notes), picture]
    )
    atomic_write_text(options.out / f"{name}.md", text)
    context.console.print(
        f"Intervals, numbers and picture are in {options.out / name}.md, .json and .png",
        highlight=False,
        soft_wrap=True,
    )


def make_margin_table(margin_tests: Sequence[MarginTest]) -> StudyTable:
    """The claims as a table."""
    lines = tuple(
        (c.description, f"{c.iou:g}", format_difference(c.difference), f"{c.margin:+.3f}", c.verdict)
        for c in margin_tests
    )
    return StudyTable(
        "Claims, paired over scenarios", ("claim", "IoU", "difference, 95 % interval", "bar", "verdict"), lines
    )


def with_replay(config: BenchmarkConfig, **changes: object) -> BenchmarkConfig:
    """The configuration with some fields of its replay changed."""
    return replace(config, replay=replace(config.replay, **changes))  # pyright: ignore[reportArgumentType]
