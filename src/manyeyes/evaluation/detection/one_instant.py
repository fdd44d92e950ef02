# SPDX-License-Identifier: Apache-2.0
"""A recording with one snapshot a scenario, at an index drawn from the seed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import Snapshot
from manyeyes.ops.keyed_random import keyed_generator


@dataclass(frozen=True)
class SingleFramePerScenario:
    """The recording with one of its evaluated snapshots a scenario, which is the scenario's first and last."""

    recording: Recording
    seed: int

    @property
    def scenarios(self) -> tuple[str, ...]:
        """As in the recording."""
        return self.recording.scenarios

    def length(self, scenario: str) -> int:
        """Return 1, the number of snapshots."""
        return 1

    def eval_indices(self, scenario: str) -> range:
        """Return the one there is."""
        return range(1)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return the one scenario, counted as 0."""
        rng = keyed_generator("one instant", self.seed, scenario)
        return replace(
            self.recording.snapshot(scenario, int(rng.choice(self.recording.eval_indices(scenario)))), index=0
        )
