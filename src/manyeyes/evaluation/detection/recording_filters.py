# SPDX-License-Identifier: Apache-2.0
"""Views of a recording: some of its scenarios, evaluated frames or agents, or cached snapshots. All are recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch

from manyeyes.datasets.base import Recording
from manyeyes.datatypes import ConfigError, GroundTruth, Snapshot, Transform


class RecordingView:
    """What is read of another recording as it is; views change a part. recording: the other one."""

    recording: Recording

    @property
    def scenarios(self) -> tuple[str, ...]:
        """As in the recording."""
        return self.recording.scenarios

    def length(self, scenario: str) -> int:
        """As in the recording."""
        return self.recording.length(scenario)

    def eval_indices(self, scenario: str) -> range:
        """As in the recording."""
        return self.recording.eval_indices(scenario)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """As in the recording."""
        return self.recording.agents(scenario)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording."""
        return self.recording.snapshot(scenario, index)


@dataclass(frozen=True)
class FrameStride(RecordingView):
    """Every K-th evaluated frame of each scenario, the first one always; all frames can still be replayed."""

    recording: Recording
    stride: int

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise ConfigError(f"Every K-th frame is evaluated, K at least 1; got {self.stride}.")

    def eval_indices(self, scenario: str) -> range:
        """Return the indices K apart; the range ends behind the last of them, so that no further frame is replayed."""
        indices = self.recording.eval_indices(scenario)[:: self.stride]
        return range(indices.start, indices[-1] + 1, indices.step) if indices else indices


@dataclass(frozen=True)
class ScenarioStride(RecordingView):
    """Every K-th scenario of a recording, the first one always."""

    recording: Recording
    stride: int

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise ConfigError(f"Every K-th scenario is evaluated, K at least 1; got {self.stride}.")

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Those K apart, in the recording's order."""
        return self.recording.scenarios[:: self.stride]


class CachedRecording(RecordingView):
    """The last so many snapshots that were asked for are kept, for several who play a recording side by side."""

    def __init__(self, recording: Recording, max_snapshots: int) -> None:
        self.recording = recording
        self._read = lru_cache(maxsize=max_snapshots)(recording.snapshot)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """As in the recording, and the same object while it is kept."""
        return self._read(scenario, index)


class NearestAgents(RecordingView):
    """The ego and the agents that are truly nearest to it when a scenario's first evaluated frame comes, ``num_agents`` in all.

    Scenarios that have fewer are left out. The choice holds for the whole scenario, so that the set of agents
    is constant. The ground truth stays that of all agents, whatever num_agents is. Its rows of agents that
    are left out stand behind those of the frames.
    """

    def __init__(self, recording: Recording, num_agents: int) -> None:
        if num_agents < 1:
            raise ConfigError(f"num_agents is at least 1; got {num_agents}.")
        self.recording, self._num_agents = recording, num_agents
        self._chosen: dict[str, frozenset[int]] = {}

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Those with agents enough."""
        return tuple(s for s in self.recording.scenarios if len(self.recording.agents(s)) >= self._num_agents)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the ids of those that are left, in their order."""
        return tuple(agent for agent in self.recording.agents(scenario) if agent in self._select_nearest(scenario))

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return the frames of those that are left."""
        full, selected = self.recording.snapshot(scenario, index), self._select_nearest(scenario)
        kept_rows = [row for row, frame in enumerate(full.frames) if frame.agent_id in selected]
        removed_rows = [row for row in range(len(full.frames)) if row not in kept_rows]
        return replace(
            full,
            frames=tuple(full.frames[row] for row in kept_rows),
            truth=full.truth and _reorder_agents(full.truth, [*kept_rows, *removed_rows]),
        )

    def _select_nearest(self, scenario: str) -> frozenset[int]:
        if scenario not in self._chosen:
            first = self.recording.snapshot(scenario, self.recording.eval_indices(scenario).start)
            poses = (
                first.truth.world_from_agent
                if first.truth
                else Transform.stack([frame.world_from_agent for frame in first.frames])
            )
            distance = (poses.translation[:, :2] - poses.translation[0, :2]).norm(dim=1).tolist()
            order = sorted(range(len(first.frames)), key=lambda row: (distance[row], row))
            self._chosen[scenario] = frozenset(first.frames[row].agent_id for row in order[: self._num_agents])
        return self._chosen[scenario]


def _reorder_agents(truth: GroundTruth, order: list[int]) -> GroundTruth:
    """Return the truth with its agents in another order."""
    rows = torch.tensor(order, dtype=torch.int64)
    return replace(truth, seen=truth.seen[rows], world_from_agent=truth.world_from_agent[rows])
