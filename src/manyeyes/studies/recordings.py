# SPDX-License-Identifier: Apache-2.0
"""Checks of a recording's files, notes on it, and the configuration of a replay that suits it."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datasets.missing import MissingFiles
from manyeyes.datatypes import RecordingError

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording, RecordingReader
    from manyeyes.studies.replay_options import FileChecks, ReplayOptions

_MAX_NOTES = 8


def check_files(
    recording: RecordingReader,
    checks: FileChecks,
    console: Console,
    scenarios: Collection[str] | None = None,
) -> MissingFiles:
    """Name the missing and mismatched files of a recording, and refuse them unless they are allowed.

    Args:
        recording: what is played.
        checks: whether to go on.
        console: for notes.
        scenarios: names of the scenarios that are played; None for all.

    Raises:
        RecordingError: files are missing or mismatched, and that is not allowed.
    """
    with console.status("Checking files") as status:
        missing = recording.verify(scenarios, lambda done, total: status.update(f"Checking files: {done} of {total}"))
    if missing.count and not checks.allow_missing:
        more = f", and {missing.count - 1:,} more files are missing or mismatched" if missing.count > 1 else ""
        raise RecordingError(
            f"{missing.files[0]}{more}: ground truth and results would change. Restore the files, or add --allow-missing to "
            "go on and have them counted."
        )
    mismatched = [str(problem) for problem in missing.files if problem.kind == "mismatched"]
    print_notes(recording, console, scenarios)
    for line in mismatched[:_MAX_NOTES]:
        console.print(f"note: {line}", highlight=False, markup=False, soft_wrap=True)
    return missing


def check_evaluated_frames(recording: Recording, scenarios: Collection[str]) -> None:
    """Raise RecordingError where none of the scenarios has an evaluated frame."""
    if not any(len(recording.eval_indices(name)) for name in scenarios):
        names = ", ".join(list(scenarios)[:_MAX_NOTES])
        raise RecordingError(
            f"{names}: no frame is evaluated, as data_protocol.yaml makes all of them history (history_frames); correct it."
        )


def print_notes(recording: RecordingReader, console: Console, scenarios: Collection[str] | None = None) -> None:
    """Print what a user should know of the played scenarios of a recording, all for None: what it lacks."""
    lines = list(recording.missing_summary)
    played = [name for name in recording.scenarios if scenarios is None or name in scenarios]
    if all(len(recording.agents(name)) < 2 for name in played):
        lines.append("no scenario has a second agent: nothing is shared, and all methods find what 'no-fusion' finds")
    for line in lines:
        console.print(f"note: {line}", highlight=False, markup=False, soft_wrap=True)


def choose_results_folder(out: Path, missing: MissingFiles) -> Path:
    """Return the folder under out for the kept results of a study, another one for each set of missing files."""
    if not missing.count:
        return out / "cells"
    digest = hashlib.blake2b(repr(missing).encode(), digest_size=4).hexdigest()
    return out / f"cells-missing-{digest}"


def select_checked_scenarios(recording: RecordingReader, replayed: str, chosen_name: str | None) -> frozenset[str]:
    """Return the scenarios whose files count where one is played; those that are left out count if it was not chosen by name."""
    return frozenset({replayed}) | (recording.unreadable_scenarios if chosen_name is None else frozenset())


def adapt_to_dataset(config: ReplayConfig, options: ReplayOptions, recording: RecordingReader) -> ReplayConfig:
    """Return the configuration that suits the recording; a latency budget that the user chose stays."""
    adapted = config.adapt_to(recording)
    return adapted if options.latency_budget_ms is None else replace(adapted, latency_budget_s=config.latency_budget_s)
