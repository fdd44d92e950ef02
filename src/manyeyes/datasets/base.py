# SPDX-License-Identifier: Apache-2.0
"""Interface of recordings, base of their readers, and functions on any recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from manyeyes.datasets.missing import FileProblem, MissingFiles
from manyeyes.datatypes import RecordingError, Snapshot


class Recording(Protocol):
    """Scenarios of consecutive snapshots; opening one reads no cloud."""

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The names of all scenarios, in a fixed order."""
        ...

    def length(self, scenario: str) -> int:
        """Return how many snapshots the scenario has."""
        ...

    def eval_indices(self, scenario: str) -> range:
        """Return the indices that evaluation counts; those before them are history."""
        ...

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents of the scenario, the ego first."""
        ...

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return all agents at one instant."""
        ...


class RecordingReader(ABC):
    """Base of readers: a :class:`Recording` with what commands ask of it; all but three methods have defaults.

    :func:`manyeyes.datasets.registry.register_dataset` registers a reader; commands then open its recordings.
    """

    scenarios: tuple[str, ...]
    """The names of all scenarios, in a fixed order; the constructor sets them."""
    matches: ClassVar[Callable[[Path], bool]]
    """Whether a folder is in the reader's layout; set by the registration, like ``layout``: what is recognised, in words."""
    layout: ClassVar[str]
    reads_images: ClassVar[bool] = False
    """Whether the constructor takes ``images``: True reads the pictures of cameras."""
    comm_range_m: float | None = None
    """The range in which agents of a replay exchange messages, metres; None: that of the replay."""
    latency_budget_s: float | None = None
    """How long the ego of a replay waits for messages after its own sweep; None: as the channel needs."""
    missing_summary: tuple[str, ...] = ()
    """What was missing when the recording was opened; one line for each kind of thing."""
    missing_files: tuple[FileProblem, ...] = ()
    """The files that were missing when the recording was opened."""

    @abstractmethod
    def __init__(self, root: Path | str, split: str | None = None, *, images: bool = False) -> None:
        """Open a folder and set ``scenarios``; a reader that reads no images does not take them."""

    @abstractmethod
    def length(self, scenario: str) -> int:
        """Return how many snapshots the scenario has."""

    @abstractmethod
    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return all agents at one instant."""

    def eval_indices(self, scenario: str) -> range:
        """Return the indices that evaluation counts: all by default."""
        return range(self.length(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents of the scenario, the ego first: by default those of its first snapshot."""
        return tuple(frame.agent_id for frame in self.snapshot(scenario, 0).frames)

    @property
    def unreadable_scenarios(self) -> frozenset[str]:
        """The names of the scenarios of which nothing can be read; the empty name stands for files of an unknown scenario."""
        return frozenset(problem.scenario for problem in self.missing_files) - frozenset(self.scenarios)

    def verify(
        self, scenarios: Collection[str] | None = None, progress: Callable[[int, int], None] | None = None
    ) -> MissingFiles:
        """Name the files that are missing, or whose content does not belong to their frame.

        Args:
            scenarios: names of the scenarios to verify; None for all.
            progress: called with the number of scenarios that are verified, and of all.
        """
        names = [name for name in self.scenarios if scenarios is None or name in scenarios]
        found = [problem for problem in self.missing_files if scenarios is None or problem.scenario in scenarios]
        for count, name in enumerate(names, 1):
            found += self.verify_contents(name)
            if progress is not None:
                progress(count, len(names))
        return MissingFiles.of(found)

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        """Find the files of a scenario whose content does not belong to their frame: none are searched by default."""
        return []


def iter_eval_frames(recording: Recording) -> Iterator[tuple[str, int]]:
    """Yield every (scenario, index) that evaluation counts, in order."""
    for scenario in recording.scenarios:
        for index in recording.eval_indices(scenario):
            yield scenario, index


def require_index(recording: Recording, scenario: str, index: int) -> None:
    """Refuse a scenario or index that the recording does not hold."""
    if scenario not in recording.scenarios:
        known = ", ".join(recording.scenarios[:8])
        raise RecordingError(f"No scenario '{scenario}' in this recording; it holds {known}: choose one of them.")
    if not 0 <= index < recording.length(scenario):
        last = recording.length(scenario) - 1
        raise RecordingError(f"Scenario '{scenario}' has no snapshot {index}; choose an index from 0 to {last}.")


def count_points_in_listed_boxes(snapshot: Snapshot, margin_m: float = 0.1) -> Tensor:
    """Return (agents, N) int64: how many of an agent's points lie in each true box that it lists; -1: not listed.

    Boxes are moved into each agent's frame and enlarged by margin_m. A vehicle that is listed was met by the agent's
    LiDAR, so a zero means that points, poses and boxes do not agree: a wrong sign in a reader shows at once.
    """
    if snapshot.truth is None:
        raise RecordingError(f"Snapshot {snapshot.index} of '{snapshot.scenario}' has no truth; read one with labels.")
    truth = snapshot.truth
    counts = torch.full(truth.seen.shape, -1, dtype=torch.int64)
    for row, frame in enumerate(snapshot.frames):
        listed = truth.seen[row].nonzero()[:, 0]
        boxes = truth.boxes[listed].transform(truth.world_from_agent[row].inverse())
        points = frame.points.xyz.to(boxes.center.dtype)
        points = points[points[:, 0].argsort()]  # a box then needs a slice of them
        radius_m = boxes.size.norm(dim=-1) / 2 + margin_m
        x, ahead = boxes.center[:, 0], points[:, 0].contiguous()
        first, end = (
            torch.searchsorted(ahead, x - radius_m).tolist(),
            torch.searchsorted(ahead, x + radius_m, right=True).tolist(),
        )
        for one, (column, radius) in enumerate(zip(listed.tolist(), radius_m.tolist())):
            near = points[first[one] : end[one]]
            near = near[((near - boxes.center[one]).abs() <= radius).all(-1)]
            counts[row, column] = boxes[one : one + 1].contains(near, margin_m).sum()
    return counts
