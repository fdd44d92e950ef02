# SPDX-License-Identifier: Apache-2.0
"""Studies of several recordings: the same conditions on each, in one grid whose conditions are named RECORDING: CONDITION."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from manyeyes.datasets.missing import MAX_LISTED, MissingFiles
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig
from manyeyes.studies.engine.conditions import Condition, ResultGrid
from manyeyes.studies.engine.replay_study import ReplayStudy, prepare_study
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import EvaluationOptions


@dataclass(frozen=True)
class SeveralRecordings:
    """The study of each recording by its name, and the context of their common report."""

    studies: dict[str, ReplayStudy]
    context: StudyContext

    @property
    def title(self) -> str:
        """Weights and data of the first recording, and the names of the others."""
        first, *others = self.studies
        return self.studies[first].title + (f"; {', '.join(others)}" if others else "")

    def run(self, make_conditions: Callable[[BenchmarkConfig], Sequence[Condition]]) -> ResultGrid:
        """Run the conditions on each recording; stored results are not computed again.

        make_conditions: makes them from the configuration of a recording.
        """
        grids = {name: study.run(make_conditions(study.base)) for name, study in self.studies.items()}
        merged = {
            (join_name(name, condition), method): result
            for name, grid in grids.items()
            for (condition, method), result in grid.results.items()
        }
        thresholds = {
            (join_name(name, condition), method): threshold
            for name, grid in grids.items()
            for (condition, method), threshold in grid.thresholds.items()
        }
        return ResultGrid(merged, next(iter(grids.values())).protocol, thresholds)


def join_name(recording: str, condition: str) -> str:
    """Return the name of a condition on a recording in the common grid."""
    return f"{recording}: {condition}"


def prepare_recordings(
    options: EvaluationOptions, context: StudyContext, sources: Mapping[str, tuple[Path, str | None]]
) -> SeveralRecordings:
    """Open recordings, each given by name as a folder and a split; their files are checked.

    Raises:
        ConfigError: there is none.
    """
    if not sources:
        raise ConfigError(f"The study '{context.name}' needs at least one recording; give --data.")
    studies = {
        name: prepare_study(replace(options, data=data, split=split), context)
        for name, (data, split) in sources.items()
    }
    found = [study.context.missing for study in studies.values()]
    files = tuple(problem for missing in found for problem in missing.files)[:MAX_LISTED]
    missing = MissingFiles(sum(missing.count for missing in found), files)
    return SeveralRecordings(studies, replace(context, missing=missing, seed=options.seed))
