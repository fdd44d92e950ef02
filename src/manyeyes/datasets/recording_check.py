# SPDX-License-Identifier: Apache-2.0
"""What a recording is: agents, sensors, time stamps, labels, and what disagrees in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

from manyeyes.datasets.base import Recording, count_points_in_listed_boxes
from manyeyes.datatypes import LABELS, AgentFrame, Snapshot
from manyeyes.ops.lidar.sweep_statistics import SweepStatistics, measure_sweep


@dataclass(frozen=True)
class ReadSensor:
    """The sensor of one agent of a scenario.

    Attributes:
        scenario: name of the scenario.
        agent_id: of the agent.
        is_infrastructure: whether it stands beside the road.
        sweep: of its first read sweep.
        period_s: median time between consecutive sweeps; None with a single one.
    """

    scenario: str
    agent_id: int
    is_infrastructure: bool
    sweep: SweepStatistics
    period_s: float | None


@dataclass(frozen=True)
class RecordingCheck:
    """What was found in the read snapshots of a recording.

    Attributes:
        num_scenarios: number of scenarios.
        num_snapshots: number of snapshots of all scenarios.
        num_read: number of snapshots that were read.
        sensors: of every agent of every read scenario.
        num_boxes: true boxes of read snapshots, by label.
        num_listed: pairs of an agent and a box that it lists.
        num_empty: those of them whose box holds none of the agent's points.
        disorder: time stamps that do not increase, one line each.
    """

    num_scenarios: int
    num_snapshots: int
    num_read: int
    sensors: tuple[ReadSensor, ...]
    num_boxes: dict[str, int]
    num_listed: int
    num_empty: int
    disorder: tuple[str, ...]

    @property
    def has_truth(self) -> bool:
        """Whether any read snapshot has true boxes."""
        return self.num_listed > 0 or bool(self.num_boxes)


def check_recording(
    recording: Recording,
    max_scenarios: int = 10,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RecordingCheck:
    """Read two consecutive snapshots of scenarios that are spread evenly over a recording.

    Args:
        recording: of any reader.
        max_scenarios: maximum number of scenarios that are read.
        progress: called with the number of read scenarios and of all that are read.
    """
    names = _spread(recording.scenarios, max_scenarios)
    sensors, labels, listed, empty, num_read = list[ReadSensor](), Counter[str](), 0, 0, 0
    disorder = list[str]()
    for done, name in enumerate(names, 1):
        snapshots = _read_pair(recording, name)
        num_read += len(snapshots)
        sensors += _find_sensors(name, snapshots)
        disorder += _find_disorder(name, snapshots)
        for snapshot in snapshots:
            if snapshot.truth is not None:
                labels.update(LABELS[label] for label in snapshot.truth.boxes.label.tolist())
                counts = count_points_in_listed_boxes(snapshot)
                listed += int((counts >= 0).sum())
                empty += int((counts == 0).sum())
        progress(done, len(names))
    total = sum(recording.length(name) for name in recording.scenarios)
    return RecordingCheck(
        len(recording.scenarios), total, num_read, tuple(sensors), dict(labels), listed, empty, tuple(disorder)
    )


def measure_first_sweeps(recording: Recording, scenario: str) -> list[ReadSensor]:
    """Measure the sensors of the agents of one scenario from its first two evaluated snapshots."""
    return _find_sensors(scenario, _read_pair(recording, scenario))


def _spread(names: Sequence[str], count: int) -> list[str]:
    """Return at most so many names, evenly spread."""
    if len(names) <= count:
        return list(names)
    return [names[k * len(names) // count] for k in range(count)]


def _read_pair(recording: Recording, scenario: str) -> list[Snapshot]:
    """Read the first evaluated snapshot and the one after it, or before it where it is the last."""
    length, evaluated = recording.length(scenario), recording.eval_indices(scenario)
    first = evaluated.start if len(evaluated) else 0
    first = max(0, min(first, length - 2))
    return [recording.snapshot(scenario, index) for index in range(first, min(first + 2, length))]


def _find_sensors(scenario: str, snapshots: Sequence[Snapshot]) -> list[ReadSensor]:
    frames: dict[int, list[AgentFrame]] = {}
    for snapshot in snapshots:
        for frame in snapshot.frames:
            frames.setdefault(frame.agent_id, []).append(frame)
    found = []
    for agent_id, own in frames.items():
        steps = [(b.timestamp_ns - a.timestamp_ns) / 1e9 for a, b in pairwise(own)]
        sweep = measure_sweep(own[0].points, own[0].sensor_height_m)
        period_s = median(steps) if steps and median(steps) > 0 else None
        found.append(ReadSensor(scenario, agent_id, own[0].is_infrastructure, sweep, period_s))
    return found


def _find_disorder(scenario: str, snapshots: Sequence[Snapshot]) -> list[str]:
    last: dict[int, int] = {}
    found = []
    for snapshot in snapshots:
        for frame in snapshot.frames:
            if frame.timestamp_ns <= last.get(frame.agent_id, frame.timestamp_ns - 1):
                found.append(
                    f"{scenario}: the time stamp of agent {frame.agent_id} does not increase at {snapshot.index}"
                )
            last[frame.agent_id] = frame.timestamp_ns
    return found
