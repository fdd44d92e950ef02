# SPDX-License-Identifier: Apache-2.0
"""Several recordings as one, with scenario names that are unique, for training on a mixture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from manyeyes.datasets.base import Recording, RecordingReader
from manyeyes.datasets.deferred import read_deferred
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import ConfigError, RecordingError, Snapshot


class MixedRecording(RecordingReader):
    """The scenarios of several recordings, in order.

    A name that an earlier recording has is followed by ``~`` and the number of its recording, from 1. Snapshots carry the new name.

    Args:
        recordings: what is mixed.
        weights: probability of each recording when a sample is drawn, up to a common factor; uniform over its scenarios. Without
            weights all scenarios of all recordings are drawn alike.

    Attributes:
        scenario_probs: (scenarios,) float64, their sum 1; None for a uniform draw.

    Raises:
        ConfigError: there is no recording, or weights do not fit.
    """

    def __init__(self, recordings: Sequence[RecordingReader], weights: Sequence[float] = ()) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not recordings:
            raise ConfigError("A mixture needs at least one recording; give the folder of one.")
        _check_weights(weights, len(recordings))
        self._source: dict[str, tuple[RecordingReader, str]] = {}
        self._new_name: list[dict[str, str]] = []
        for number, recording in enumerate(recordings, 1):
            names = {name: _unique_name(name, number, self._source) for name in recording.scenarios}
            self._new_name.append(names)
            self._source |= {new: (recording, name) for name, new in names.items()}
        self.scenarios = tuple(self._source)
        self.missing_summary = tuple(line for recording in recordings for line in recording.missing_summary)
        self.missing_files = tuple(
            _rename(problem, names)
            for recording, names in zip(recordings, self._new_name)
            for problem in recording.missing_files
        )
        self.scenario_probs = _scenario_probs([len(r.scenarios) for r in recordings], weights) if weights else None

    def length(self, scenario: str) -> int:
        """Return how many snapshots the scenario has."""
        recording, name = self._find(scenario)
        return recording.length(name)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return all agents at one instant, under the scenario's name in the mixture."""
        recording, name = self._find(scenario)
        return replace(recording.snapshot(name, index), scenario=scenario)

    def deferred_snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return the snapshot without pictures; clouds are read at their first use where their recording supports it."""
        recording, name = self._find(scenario)
        return replace(read_deferred(recording, name, index), scenario=scenario)

    def eval_indices(self, scenario: str) -> range:
        """Return the indices that evaluation counts."""
        recording, name = self._find(scenario)
        return recording.eval_indices(name)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of all agents of the scenario, the ego first."""
        recording, name = self._find(scenario)
        return recording.agents(name)

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        """Find the files of a scenario whose content does not belong to their frame."""
        recording, name = self._find(scenario)
        return [replace(problem, scenario=scenario) for problem in recording.verify_contents(name)]

    def _find(self, scenario: str) -> tuple[RecordingReader, str]:
        if scenario not in self._source:
            known = ", ".join(self.scenarios[:8])
            raise RecordingError(f"No scenario '{scenario}' in this mixture; it holds {known}: choose one of them.")
        return self._source[scenario]


def open_recordings(
    paths: Sequence[Path], split: str | None = None, *, images: bool = False, weights: Sequence[float] = ()
) -> RecordingReader:
    """Open one recording, or a mixture of several with the same split.

    Raises:
        RecordingError: as for :func:`manyeyes.datasets.registry.open_recording`.
        ConfigError: there is no path, or weights do not fit.
    """
    opened = [open_recording(path, split, images=images) for path in paths]
    if len(opened) != 1:
        return MixedRecording(opened, weights)
    _check_weights(weights, 1)
    return opened[0]


def draw_scenario(recording: Recording, rng: np.random.Generator) -> str:
    """Draw the scenario of a sample: uniform, or by the weights of a mixture."""
    names = recording.scenarios
    probs = recording.scenario_probs if isinstance(recording, MixedRecording) else None
    number = rng.integers(len(names)) if probs is None else rng.choice(len(names), p=probs)
    return names[int(number)]


def _unique_name(name: str, number: int, taken: dict[str, tuple[RecordingReader, str]]) -> str:
    new = name
    while new in taken:
        new = f"{new}~{number}"
    return new


def _rename(problem: FileProblem, names: dict[str, str]) -> FileProblem:
    return replace(problem, scenario=names.get(problem.scenario, problem.scenario))


def _check_weights(weights: Sequence[float], count: int) -> None:
    if weights and (len(weights) != count or not all(math.isfinite(w) and w > 0 for w in weights)):
        raise ConfigError(f"A mixture of {count} recordings needs {count} positive weights; got {list(weights)}.")


def _scenario_probs(counts: Sequence[int], weights: Sequence[float]) -> np.ndarray:
    each = np.concatenate([np.full(n, w / max(1, n)) for n, w in zip(counts, weights)])
    return each / each.sum()
