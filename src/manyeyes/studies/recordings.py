# SPDX-License-Identifier: Apache-2.0
"""Opens a recording by what its folder holds, checks its files, and suits the replay to it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.dair_v2x.index import find_dair_root
from manyeyes.datasets.missing import MissingFiles
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datatypes import ConfigError, RecordingError

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.agents.replay import ReplayConfig
    from manyeyes.datasets.base import Recording
    from manyeyes.studies.replay_options import FileChecks, ReplayOptions

# Half of DAIR-V2X's period: a pair's later sweep arrives in time, and the next pair has not begun.
PAIRS_LATENCY_BUDGET_S = 0.05
_MAX_NOTES = 8


def open_recording(root: Path, split: str | None = None, images: bool = False) -> Opv2vRecording | DairRecording:
    """DAIR-V2X's layout where the folder has a vehicle-side or an infrastructure-side, else OPV2V's.

    images: with what cameras took, which is read of OPV2V's layout only.
    """
    if find_dair_root(root) is None:
        return Opv2vRecording(root, split, images=images)
    if images:
        raise ConfigError(f"{root}: pictures are read in OPV2V's layout only; choose a model of agents with LiDAR.")
    return DairRecording(root, split)


def check_files(
    recording: Opv2vRecording | DairRecording,
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
    for line in (*recording.missing_summary, *mismatched[:_MAX_NOTES]):
        console.print(f"note: {line}", highlight=False, markup=False, soft_wrap=True)
    return missing


def choose_results_folder(out: Path, missing: MissingFiles) -> Path:
    """The folder under out for the kept results of a study, another one for each set of missing files."""
    if not missing.count:
        return out / "cells"
    digest = hashlib.blake2b(repr(missing).encode(), digest_size=4).hexdigest()
    return out / f"cells-missing-{digest}"


def select_checked_scenarios(
    recording: Opv2vRecording | DairRecording, replayed: str, chosen_name: str | None
) -> frozenset[str]:
    """The scenarios whose files count where one is played; those that are left out count if it was not chosen by name."""
    return frozenset({replayed}) | (recording.unreadable_scenarios if chosen_name is None else frozenset())


def adapt_to_dataset(config: ReplayConfig, options: ReplayOptions, recording: Recording) -> ReplayConfig:
    """The configuration with the wait and the reach that suit the recording; a wait that the user chose stays.

    The two sweeps of a DAIR-V2X pair are some ten milliseconds apart, either way: an ego that does not wait would never
    receive an infrastructure message whose sweep is the later one. And its pairs collaborate at any distance, by its own protocol.
    """
    if not isinstance(recording, DairRecording):
        return config
    return replace(
        config,
        comm_range_m=math.inf,
        latency_budget_s=config.latency_budget_s if options.latency_budget_ms is not None else PAIRS_LATENCY_BUDGET_S,
    )
