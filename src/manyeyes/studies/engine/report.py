# SPDX-License-Identifier: Apache-2.0
"""What every study has in common: its results folder, jobs with progress bars, and the files that it writes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from manyeyes._io import atomic_write_text
from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.maps.store.executors import InlineExecutor, ProcessExecutor, map_blocks
from manyeyes.studies import provenance
from manyeyes.studies.engine.cells import CellStore
from manyeyes.studies.options import StudyOptions
from manyeyes.studies.recordings import choose_results_folder
from manyeyes.viz.progress import track
from manyeyes.viz.study_table import StudyTable, format_markdown, make_terminal_table
from manyeyes.viz.table import missing_footer

T = TypeVar("T")


@dataclass(frozen=True)
class StudyContext:
    """A study that runs. name: of its files. missing: files that its recording lacks. seed: of its randomness."""

    name: str
    options: StudyOptions
    console: Console
    missing: MissingFiles = NONE_MISSING
    seed: int = 0

    @property
    def store(self) -> CellStore:
        """The cells under --out, other ones for each set of missing files."""
        return CellStore(choose_results_folder(self.options.out, self.missing))

    def run_jobs(self, jobs: Sequence[Callable[[], T]], workers: int, description: str) -> list[T]:
        """Call every job, which must pickle, in this process or a pool; the results are in the order of the jobs."""
        executor = ProcessExecutor(workers) if workers > 1 else InlineExecutor()
        with track(self.console, description, len(jobs)) as report, executor.open() as session:
            return map_blocks(_call, jobs, session, report)

    def write_report(
        self,
        title: str,
        payload: dict[str, object],
        tables: Sequence[StudyTable],
        save_picture: Callable[[Path], None] | None = None,
        notes: Sequence[str] = (),
        config: object = None,
    ) -> None:
        """Print the tables; write STUDY.json, STUDY.md and STUDY.png in the folder --out.

        Args:
            title: of tables and documents.
            payload: the results, for JSON.
            tables: for the terminal, the document and JSON.
            save_picture: draws the picture to a path; None: there is none.
            notes: lines below the tables.
            config: what else the provenance names, beside the options.
        """
        out, name = self.options.out, self.name
        footer = missing_footer(self.missing.count, f"{name}.json")
        notes = (*notes, footer) if footer else notes
        self.print(f"{title}\n")
        for table in tables:
            self.console.print(make_terminal_table(table))
            self.console.print()
        for note in notes:
            self.print(note)
        result = {"study": name, "title": title, "missing": self.missing, **payload, "tables": tables}
        provenance.write_json(out / f"{name}.json", result, {"options": self.options, "config": config}, self.seed)
        text = [f"# {name}\n\n{title}\n", *map(format_markdown, tables), *(f"{note}\n" for note in notes)]
        if save_picture is not None:
            save_picture(out / f"{name}.png")
            text.append(f"![{name}]({name}.png)\n")
        atomic_write_text(out / f"{name}.md", "\n".join(text))
        endings = ".md and .json" if save_picture is None else ".md, .json and .png"
        self.print(f"Intervals and numbers are in {out / name}{endings}")

    def print(self, text: str) -> None:
        """Print a line as it is."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)


def _call(job: Callable[[], T]) -> T:
    return job()
