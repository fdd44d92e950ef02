# SPDX-License-Identifier: Apache-2.0
"""Progress bars in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from rich.console import Console


def make_progress_bars(console: Console) -> Progress:
    """Progress bars, on the same console as everything else."""
    columns = TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=console)


@contextmanager
def track(console: Console, description: str, total: int | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show one progress bar; yield what sets it to so many done of so many."""
    with make_progress_bars(console) as progress:
        task = progress.add_task(description, total=total)
        yield lambda done, total: progress.update(task, completed=done, total=total)
