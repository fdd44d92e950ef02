# SPDX-License-Identifier: Apache-2.0
"""Divide a recording into scenarios for training and a holdout; a single scenario is divided by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import ConfigError, Snapshot

GAP_FRAMES = 5
"""Snapshots of a single scenario between its two parts, which neither uses."""


@dataclass(frozen=True)
class RecordingPart:
    """Some scenarios of a recording.

    Attributes:
        recording: of which this is a part.
        lengths: number of snapshots of each scenario that belongs to it, from the first; names in order.
        eval_starts: index of the first evaluated snapshot of each scenario, at least.
    """

    recording: Recording
    lengths: Mapping[str, int]
    eval_starts: Mapping[str, int]

    @property
    def scenarios(self) -> tuple[str, ...]:
        """The names of the scenarios."""
        return tuple(self.lengths)

    def length(self, scenario: str) -> int:
        """Return how many snapshots of the scenario belong to the part."""
        return self.lengths[scenario]

    def eval_indices(self, scenario: str) -> range:
        """Return the evaluated indices of the recording that belong to the part."""
        whole = self.recording.eval_indices(scenario)
        kept = [i for i in whole if self.eval_starts[scenario] <= i < self.lengths[scenario]]
        return range(kept[0], kept[-1] + 1, whole.step) if kept else range(0)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording."""
        return self.recording.snapshot(scenario, index)


def split_holdout(recording: Recording, fraction: float) -> tuple[RecordingPart, RecordingPart]:
    """Divide a recording into a part for training and a holdout.

    Every 1 / fraction-th scenario is held out, at least one. Of a single scenario, the end is held out, after a gap of GAP_FRAMES.

    Args:
        recording: what is divided.
        fraction: of scenarios, or of the frames of a single one, that is held out; between 0 and 1.

    Raises:
        ConfigError: the fraction is out of range, or a single scenario is too short.
    """
    if not 0 < fraction < 1:
        raise ConfigError(f"A holdout needs a fraction between 0 and 1; got {fraction}.")
    names = recording.scenarios
    if len(names) == 1:
        return _split_by_time(recording, names[0], fraction)
    count = min(len(names) - 1, max(1, round(fraction * len(names))))
    held = {names[((2 * k + 1) * len(names)) // (2 * count)] for k in range(count)}
    training = {name: recording.length(name) for name in names if name not in held}
    holdout = {name: recording.length(name) for name in names if name in held}
    return (
        RecordingPart(recording, training, dict.fromkeys(training, 0)),
        RecordingPart(recording, holdout, dict.fromkeys(holdout, 0)),
    )


def _split_by_time(recording: Recording, name: str, fraction: float) -> tuple[RecordingPart, RecordingPart]:
    length = recording.length(name)
    first = length - max(1, round(fraction * length))
    end = first - GAP_FRAMES
    if end < 1:
        raise ConfigError(
            f"Scenario '{name}' has {length} frames, too few for a holdout of {fraction:g} after a gap of {GAP_FRAMES}; give a "
            "recording of validation of its own, or more frames."
        )
    training, holdout = {name: end}, {name: length}
    return RecordingPart(recording, training, {name: 0}), RecordingPart(recording, holdout, {name: first})
