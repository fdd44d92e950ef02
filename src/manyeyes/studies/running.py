# SPDX-License-Identifier: Apache-2.0
"""What studies have in common: what they start from, the sweep with its progress, and the files they write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._io import atomic_write_text
from manyeyes.agents.strategies import METHODS, method
from manyeyes.datasets.base import Recording
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.evaluation.statistics.significance import Claim
from manyeyes.evaluation.study import Condition, Sweep, sweep
from manyeyes.studies import provenance
from manyeyes.studies.recordings import cells_folder, check_files, open_recording, suited_to
from manyeyes.studies.replay_options import weights_name
from manyeyes.viz.curves import Panel, save_curves
from manyeyes.viz.progress import bars
from manyeyes.viz.study_table import Sheet, change, markdown, terminal
from manyeyes.viz.table import missing_footer

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

ALONE, OURS, BOUND = "alone", "intermediate", "early"
SELECTORS = ("intermediate", "confidence", "random")
PAPER = 'The column "paper" holds CoSTr\'s own figures: another data set (OPV2V), unknown protocol; they are no bar and no rival.'


@dataclass(frozen=True)
class Start:
    """What a study's conditions are changes of, the recording that they are played on, and files that it lacks."""

    options: Options
    console: Console
    opener: Callable[[], Recording]
    base: BenchmarkConfig
    missing: MissingFiles = NONE_MISSING

    @property
    def cells(self) -> Path:
        """The folder of the cells under --out, another one for each set of missing files."""
        return cells_folder(self.options.out, self.missing)

    @property
    def title(self) -> str:
        """Weights, data, and how many frames."""
        options, recording = self.options, self.base.view(self.opener())
        frames = sum(len(recording.judged(name)) for name in recording.scenarios)
        where = f"{options.data.name}{f'/{options.split}' if options.split else ''}"
        return f"{weights_name(self.base.weights)} on {where}: {len(recording.scenarios)} scenarios, {frames} frames"


def start(options: Options, console: Console, all_egos: bool = False) -> Start:
    """The setting without any disturbance; names that are unknown are refused here, before any work."""
    if options.noise_xy_m or options.noise_yaw_deg or options.all_egos:
        raise ConfigError(
            "A study sets errors and egos itself: leave out --noise-xy-m, --noise-yaw-deg and --all-egos."
        )
    opener = partial(open_recording, options.data, options.split)
    recording = opener()
    missing = check_files(recording, options.checks, console)
    replay = suited_to(options.playing.replay_config(options.seed, all_egos), options.playing, recording)
    base = BenchmarkConfig(
        options.playing.weights, options.playing.methods, options.protocol, replay, every=options.every
    )
    return Start(options, console, opener, base, missing)


def selectors(options: Options) -> tuple[str, ...]:
    """The ways to choose tokens that are compared: those asked for, or those of SELECTORS that there are."""
    for name in options.selectors:
        method(name)
    return options.selectors or tuple(name for name in SELECTORS if name in METHODS)


def carry_out(begun: Start, conditions: Sequence[Condition]) -> Sweep:
    """The sweep; its cells lie in the folder of the start."""
    with bars(begun.console) as progress:
        task = progress.add_task("Judging", total=None)

        def report(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        options = begun.options
        return sweep(begun.opener, conditions, begun.cells, options.workers, report)


def publish(
    begun: Start,
    payload: dict[str, object],
    sheets: Sequence[Sheet],
    panels: Sequence[Panel],
    conditions: Sequence[Condition],
    notes: Sequence[str] = (),
) -> None:
    """Table in the terminal; STUDY.json, STUDY.md and STUDY.png in the folder --out."""
    options, name = begun.options, str(begun.options.study)
    title = begun.title
    footer = missing_footer(begun.missing.count, f"{name}.json")
    notes = (*notes, footer) if footer else notes
    begun.console.print(f"{title}\n", highlight=False, soft_wrap=True)
    for sheet in sheets:
        begun.console.print(terminal(sheet))
        begun.console.print()
    for note in notes:
        begun.console.print(note, highlight=False, soft_wrap=True)
    config = {"options": options, "conditions": conditions}
    provenance.write_json(
        options.out / f"{name}.json", {"title": title, "missing": begun.missing, **payload}, config, options.seed
    )
    if panels:
        save_curves(panels, options.out / f"{name}.png")
    picture = f"![{name}]({name}.png)\n"
    text = "\n".join([f"# {name}\n\n{title}\n", *map(markdown, sheets), *(f"{note}\n" for note in notes), picture])
    atomic_write_text(options.out / f"{name}.md", text)
    begun.console.print(
        f"Intervals, numbers and picture are in {options.out / name}.md, .json and .png",
        highlight=False,
        soft_wrap=True,
    )


def claims_sheet(claims: Sequence[Claim]) -> Sheet:
    """The claims as a table."""
    lines = tuple((c.what, f"{c.iou:g}", change(c.difference), f"{c.bar:+.3f}", c.verdict) for c in claims)
    return Sheet(
        "Claims, paired over scenarios", ("claim", "IoU", "difference, 95 % interval", "bar", "verdict"), lines
    )


def with_replay(config: BenchmarkConfig, **changes: object) -> BenchmarkConfig:
    """The configuration with some fields of its replay changed."""
    return replace(config, replay=replace(config.replay, **changes))  # pyright: ignore[reportArgumentType]
