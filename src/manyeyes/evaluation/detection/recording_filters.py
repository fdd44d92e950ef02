# SPDX-License-Identifier: Apache-2.0
"""A recording seen with less: some of its judged frames, some of its agents, or each snapshot read once. All are recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import ConfigError, Snapshot, Transform, Truth


@dataclass(frozen=True)
class EveryKth:
    """Every K-th judged frame of each scenario is judged, the first one always; all frames are still there to be played."""

    recording: Recording
    every: int

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ConfigError(f"Every K-th frame is judged, K at least 1; got {self.every}.")

    @property
    def scenarios(self) -> tuple[str, ...]:
        """As in the recording."""
        return self.recording.scenarios

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self.recording.length(scenario)

    def judged(self, scenario: str) -> range:
        """The indices K apart; the range ends behind the last of them, so that nothing is played in vain."""
        kept = self.recording.judged(scenario)[:: self.every]
        return range(kept.start, kept[-1] + 1, kept.step) if kept else kept

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording."""
        return self.recording.snapshot(scenario, index)


class KeptSnapshots:
    """The last so many snapshots that were asked for are kept, for several who play a recording side by side."""

    def __init__(self, recording: Recording, count: int) -> None:
        self._recording = recording
        self._read = lru_cache(maxsize=count)(recording.snapshot)

    @property
    def scenarios(self) -> tuple[str, ...]:
        """As in the recording."""
        return self._recording.scenarios

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self._recording.length(scenario)

    def judged(self, scenario: str) -> range:
        """As in the recording."""
        return self._recording.judged(scenario)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self._recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording, and the same object while it is kept."""
        return self._read(scenario, index)


class NearestAgents:
    """The ego and the agents that are truly nearest to it when a scenario's first judged frame comes, ``count`` in all.

    Scenarios that have fewer are left out. The choice holds for the whole scenario, so that nobody comes and goes. The truth
    stays that of everybody: what is to be found does not shrink with the number of those who look. Its rows of agents that
    are left out stand behind those of the frames.
    """

    def __init__(self, recording: Recording, count: int) -> None:
        if count < 1:
            raise ConfigError(f"At least one agent looks; got {count}.")
        self._recording, self._count = recording, count
        self._chosen: dict[str, frozenset[int]] = {}

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Those with agents enough."""
        return tuple(s for s in self._recording.scenarios if len(self._recording.agents(s)) >= self._count)

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self._recording.length(scenario)

    def judged(self, scenario: str) -> range:
        """As in the recording."""
        return self._recording.judged(scenario)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """The ids of those that are left, in their order."""
        return tuple(agent for agent in self._recording.agents(scenario) if agent in self._nearest(scenario))

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """The frames of those that are left."""
        whole, chosen = self._recording.snapshot(scenario, index), self._nearest(scenario)
        left = [row for row, frame in enumerate(whole.frames) if frame.agent_id in chosen]
        out = [row for row in range(len(whole.frames)) if row not in left]
        return replace(
            whole,
            frames=tuple(whole.frames[row] for row in left),
            truth=whole.truth and _rows(whole.truth, [*left, *out]),
        )

    def _nearest(self, scenario: str) -> frozenset[int]:
        if scenario not in self._chosen:
            first = self._recording.snapshot(scenario, self._recording.judged(scenario).start)
            poses = (
                first.truth.world_from_agent
                if first.truth
                else Transform.stack([frame.world_from_agent for frame in first.frames])
            )
            away = (poses.translation[:, :2] - poses.translation[0, :2]).norm(dim=1).tolist()
            order = sorted(range(len(first.frames)), key=lambda row: (away[row], row))
            self._chosen[scenario] = frozenset(first.frames[row].agent_id for row in order[: self._count])
        return self._chosen[scenario]


def _rows(truth: Truth, order: list[int]) -> Truth:
    """The truth with its agents in another order."""
    rows = torch.tensor(order, dtype=torch.int64)
    return replace(truth, seen=truth.seen[rows], world_from_agent=truth.world_from_agent[rows])
