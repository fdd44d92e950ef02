# SPDX-License-Identifier: Apache-2.0
"""Clouds and metadata that do not belong to their frame, found without digests: copies, and clouds beside the listed boxes.

A file that was replaced by another of its scenario is a copy: two files with the same bytes. A file that was replaced by one
from elsewhere does not fit the boxes of its metadata: OPV2V, V2XSet and the simulator list vehicles that the agent's LiDAR hit,
so each listed box holds a point. The rule is applied to scenarios in which most clouds meet their boxes, since other data sets
may list vehicles by distance alone. Two frames of one agent that follow each other and were exchanged are not found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from manyeyes.datasets.base import count_points_in_listed_boxes
from manyeyes.datasets.manifest import sha256_of
from manyeyes.datasets.missing import FileProblem
from manyeyes.datatypes import Snapshot

# Files below this size hold no sweep (fewer than 250 points as floats), so equal bytes mean nothing.
_MIN_BYTES = 4096
_MIN_POINTS = 100
# A cloud is mismatched where so many listed boxes hold no point, and they are more than that fraction of the listed.
_MIN_UNMET = 3
_MAX_UNMET_FRACTION = 0.3
# The rule holds where the median cloud of a scenario meets that fraction of its boxes.
_MIN_USUAL_FRACTION = 0.9


@dataclass(frozen=True)
class _Fit:
    """How many boxes the metadata of a cloud list, and how many of them hold no point."""

    listed: int
    unmet: int

    @property
    def met_fraction(self) -> float:
        return 1 - self.unmet / self.listed if self.listed else math.nan


def find_mismatched_files(
    read: Callable[[int], Snapshot], scenario: str, clouds: Sequence[Mapping[int, Path]]
) -> list[FileProblem]:
    """Find the clouds and metadata of a scenario that are copies of others or miss the listed boxes.

    Args:
        read: the snapshot of an index.
        scenario: name for the records.
        clouds: path of each agent's cloud by its id, for each snapshot; the metadata lie beside it with the suffix .yaml.
    """
    fits = {path: fit for index, paths in enumerate(clouds) for path, fit in _fits(read(index), paths)}
    found = [
        FileProblem(
            path, "mismatched", scenario, f"{fit.unmet} of {fit.listed} boxes that its frame lists hold no point of it"
        )
        for path, fit in find_mismatched_clouds(fits).items()
    ]
    by_fit = sorted(
        (path for paths in clouds for path in paths.values()), key=lambda p: (_unmet_fraction(fits.get(p)), p)
    )
    found += find_copied_files(by_fit, scenario, _same_metadata)
    metadata = [path.with_suffix(".yaml") for path in by_fit]
    # Metadata hold the agent's own pose: equal ones of two agents are wrong, of one agent they tell that it stands.
    found += find_copied_files(metadata, scenario, lambda one, other: one.parent == other.parent, min_bytes=0)
    return found


def find_mismatched_clouds(fits: Mapping[Path, _Fit]) -> dict[Path, _Fit]:
    """Return the clouds that miss too many boxes, in a scenario where that is unusual."""
    fractions = sorted(fit.met_fraction for fit in fits.values() if fit.listed)
    if not fractions or fractions[len(fractions) // 2] < _MIN_USUAL_FRACTION:
        return {}
    return {
        path: fit
        for path, fit in fits.items()
        if fit.unmet >= _MIN_UNMET and fit.unmet > _MAX_UNMET_FRACTION * fit.listed
    }


def find_copied_files(
    files: Iterable[Path],
    scenario: str,
    may_be_equal: Callable[[Path, Path], bool] = lambda one, other: False,
    min_bytes: int = _MIN_BYTES,
) -> list[FileProblem]:
    """Find files whose bytes are those of an earlier file of the sequence.

    may_be_equal: whether two files may be equal, because nothing moved between their frames. min_bytes: smaller files are skipped.
    """
    by_size: dict[int, list[Path]] = {}
    for path in files:
        by_size.setdefault(path.stat().st_size, []).append(path)
    found = []
    for size, group in by_size.items():
        first: dict[str, Path] = {}
        for path in group if size >= min_bytes and len(group) > 1 else ():
            original = first.setdefault(sha256_of(path), path)
            if original is not path and not may_be_equal(original, path):
                found.append(FileProblem(path, "mismatched", scenario, f"its bytes are those of {original}"))
    return found


def _fits(snapshot: Snapshot, paths: Mapping[int, Path]) -> Iterator[tuple[Path, _Fit]]:
    """Yield the fit of each cloud that is a sweep, or is empty although vehicles are listed."""
    if snapshot.truth is None:
        return
    for frame, counts in zip(snapshot.frames, count_points_in_listed_boxes(snapshot)):
        if len(frame.points) >= _MIN_POINTS or not len(frame.points):
            yield paths[frame.agent_id], _Fit(int((counts >= 0).sum()), int((counts == 0).sum()))


def _unmet_fraction(fit: _Fit | None) -> float:
    return 1.0 if fit is None or not fit.listed else 1 - fit.met_fraction


def _same_metadata(one: Path, other: Path) -> bool:
    """Return whether two clouds are of one agent and their metadata have the same bytes."""
    metadata = (one.with_suffix(".yaml"), other.with_suffix(".yaml"))
    return one.parent == other.parent and metadata[0].read_bytes() == metadata[1].read_bytes()
