# SPDX-License-Identifier: Apache-2.0
"""Make random rows of a stored table again, each by the command that stands in it, and compare all of their numbers.

The exit code is 1 where a number differs. --clone runs the commands from a fresh clone of this repository at the commit of the
result, with the installed dependencies. Paths in commands are relative to the working folder, as they were for the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from manyeyes._bounds import NonNegativeFloat, PositiveInt, Seed


@dataclass(frozen=True)
class Options:
    """Which rows, and how they are made."""

    result: Positional[Path]
    """JSON of a study whose rows name their commands: main-table, byte-curves."""
    count: PositiveInt = 3
    """Number of rows."""
    seed: Seed = 0
    """Of the draw of rows."""
    data: Path | None = None
    """Recording, in place of that of the commands."""
    clone: bool = False
    """Run a fresh clone at the commit of the result, instead of these sources."""
    tolerance: NonNegativeFloat = 0.0
    """Largest difference of a number; 0 on the same kind of machine."""


def main(options: Options) -> None:
    """Make rows again and compare them."""
    import tempfile

    from rich.console import Console

    from manyeyes.datatypes import ConfigError
    from manyeyes.studies.cell_check import clone_sources, draw_rows, make_again

    console, failed = Console(), 0
    table, rows = draw_rows(options.result, options.count, options.seed)
    with tempfile.TemporaryDirectory() as folder:
        sources = clone_sources(table.commit, Path(folder) / "clone") if options.clone else None
        for number, row in enumerate(rows):
            command = row.command_on(options.data)
            console.print(f"{number + 1} of {len(rows)}: {command}", highlight=False, soft_wrap=True)
            again = make_again(command, table.study, Path(folder) / str(number), sources)
            differences = row.compare(again, options.tolerance)
            failed += bool(differences)
            for difference in differences or ("equal",):
                console.print(f"  {difference}", highlight=False, soft_wrap=True)
    if failed:
        raise ConfigError(f"{options.result}: {failed} of {len(rows)} rows differ when they are made again.")
