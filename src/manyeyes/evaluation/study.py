# SPDX-License-Identifier: Apache-2.0
"""Sweeps: methods played in many conditions, every cell kept, so that a sweep that was stopped goes on where it was.

A cell is a method in a condition. Its file's name holds a digest of the whole configuration, of the weights, of the recording
and of the sources that its numbers follow from: a change of any of them makes the cell anew. Cells are judged over scenarios;
differences are paired: all cells are resampled alike, and the unit draws of noise, loss and jitter are the same at every level.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

from manyeyes._source import source_digest
from manyeyes.datasets.base import Recording
from manyeyes.evaluation.detection.average_precision import Protocol
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, judging_protocol, loaded, played
from manyeyes.evaluation.statistics.bootstrap import Drawn, Interval, drawn
from manyeyes.evaluation.study_result import Cell, Speeds, cell_of, read_cell, write_cell
from manyeyes.models.checkpoint import fingerprint

COMPUTED_BY = "manyeyes.evaluation.detection.benchmark"
"""The module whose import closure the numbers of a cell follow from."""


@dataclass(frozen=True)
class Condition:
    """One setting of the world in which methods are played. name: how tables call it, and how it is found again."""

    name: str
    config: BenchmarkConfig


Place = tuple[str, str]
"""The names of a condition and of a method."""


@dataclass(frozen=True)
class Sweep:
    """The cells of a sweep by condition and method, and what follows from them. iou counts the thresholds of tally.IOUS."""

    cells: dict[Place, Cell]
    protocol: Protocol
    _drawn: dict[object, Drawn] = field(default_factory=dict, repr=False, compare=False)

    def ap(
        self, place: Place, iou: int, speeds: Speeds | None = None, scenarios: Collection[str] | None = None
    ) -> Interval:
        """AP of a cell with its interval, over some scenarios or one class of speeds alone."""
        return self._draws(place, iou, speeds, scenarios).interval()

    def less(self, place: Place, other: Place, iou: int, scenarios: Collection[str] | None = None) -> Interval:
        """AP of a cell minus that of another, paired over scenarios."""
        return self._draws(place, iou, None, scenarios).less(self._draws(other, iou, None, scenarios))

    def scenarios(self, place: Place) -> frozenset[str]:
        """Those that a cell was played on."""
        return frozenset(match.scenario for match in self.cells[place].matches[0])

    def _draws(self, place: Place, iou: int, speeds: Speeds | None, scenarios: Collection[str] | None) -> Drawn:
        key = (place, iou, speeds, None if scenarios is None else frozenset(scenarios))
        if key not in self._drawn:
            frames = self.cells[place].frames(iou, scenarios, speeds)
            self._drawn[key] = drawn(frames, protocol=self.protocol)
        return self._drawn[key]


def sweep(
    open_recording: Callable[[], Recording],
    conditions: Sequence[Condition],
    folder: Path,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sweep:
    """Every method of every condition: the cell kept in the folder, or played now and kept.

    progress counts scenarios of conditions that are still to be played. Conditions of one configuration but for its methods
    should be one: methods of one condition look at each cloud once between them.
    """
    data = recording_digest(open_recording())
    paths = {
        (c.name, method): cell_path(folder, c.config, method, data) for c in conditions for method in c.config.methods
    }
    cells = {place: cell for place, path in paths.items() if (cell := read_cell(path)) is not None}
    left = [(c, tuple(m for m in c.config.methods if (c.name, m) not in cells)) for c in conditions]
    todo = [Condition(c.name, replace(c.config, methods=methods)) for c, methods in left if methods]
    with closing(played(open_recording, [c.config for c in todo], workers, progress)) as results:
        for condition, tallies in zip(todo, results):
            for tally in tallies:
                cell = cell_of(tally)
                write_cell(paths[condition.name, tally.method], cell)
                cells[condition.name, tally.method] = cell
    return Sweep({place: cells[place] for place in paths}, judging_protocol(conditions[0].config))


def cell_path(folder: Path, config: BenchmarkConfig, method: str, data: str) -> Path:
    """The file of a cell, named by all that its numbers depend on. data: the recording's digest."""
    alone = replace(config, methods=(method,), weights=loaded(config.weights).fingerprint.hex())
    net = config.replay.aligner.net if config.replay.aligner is not None else None
    eyes = "" if net is None else fingerprint(net).hex()
    digest = hashlib.blake2b(repr((alone, eyes, data, source_digest(COMPUTED_BY))).encode(), digest_size=8)
    return folder / f"{method}-{digest.hexdigest()}.npz"


def recording_digest(recording: Recording) -> str:
    """What a recording holds, as far as each scenario's first judged snapshot tells: agents, poses, clouds, truth."""
    digest = hashlib.blake2b(digest_size=8)
    for scenario in recording.scenarios:
        judged = recording.judged(scenario)
        digest.update(repr((scenario, recording.length(scenario), judged, recording.agents(scenario))).encode())
        first = recording.snapshot(scenario, judged.start)
        for frame in first.frames:
            digest.update(frame.points.xyz.numpy().tobytes())
            digest.update(frame.world_from_agent.matrix().numpy().tobytes())
        if first.truth is not None:
            digest.update(first.truth.boxes.center.numpy().tobytes())
    return digest.hexdigest()
