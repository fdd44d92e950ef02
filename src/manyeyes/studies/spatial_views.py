# SPDX-License-Identifier: Apache-2.0
"""Frames of a viewer (``viz.spatial_frame``) from a recording, from a replay of a method, and from a recorded live run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.replay import ReplayStep
from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, Snapshot, Transform
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.runtime.recorder import RunConfig
from manyeyes.runtime.replay import ReplayedTick, replay_run
from manyeyes.studies.map_folder import read_vector_map
from manyeyes.studies.town_maps import group_by_town
from manyeyes.viz.spatial_entities import measure_pose_difference
from manyeyes.viz.spatial_frame import Floats, ShownAgent, ShownBoxes, ShownLink, SpatialFrame, mark_errors

MapLines = Mapping[str, tuple[Floats, ...]]
MIN_DIFFERENCE_M, MIN_DIFFERENCE_DEG = 1e-3, 1e-3
"""Poses that differ by less are shown as one: messages hold poses as rounded numbers."""
_EVIDENCE = ("unchecked", "supported", "corroborated", "disputed", "refuted", "own")
"""Kinds by the value of ``agents.trust.interface.Evidence``."""


class SpatialLog(Protocol):
    """Where frames are logged: ``viz.rerun_log.RerunLog``, ``viz.foxglove_log.FoxgloveLog``."""

    def add(self, frame: SpatialFrame) -> None:
        """Log the frame of one instant."""
        ...


def log_frames(frames: Iterable[SpatialFrame], logs: Sequence[SpatialLog], advance: Callable[[], None]) -> int:
    """Log frames to all logs, each frame computed once; return their number. advance: called after each frame."""
    num = 0
    for frame in frames:
        for log in logs:
            log.add(frame)
        advance()
        num += 1
    return num


def read_map_lines(recording: Recording, scenario: str, place: Path | str) -> MapLines:
    """Return the published elements of a map in the world of a scenario, by kind.

    Args:
        recording: what the map was built of, which places it: a map is stated about its town's, or the first agent's, position.
        scenario: which of its scenarios.
        place: of the map, see :func:`~manyeyes.studies.map_folder.read_vector_map`.
    """
    vector_map = read_vector_map(place)
    (town_map,) = group_by_town(recording, (scenario,), scenario)
    return _lines_by_kind([vector_map.select_published().elements.transform(*town_map.origin_xy, 0.0)])


def show_snapshot(snapshot: Snapshot) -> SpatialFrame:
    """Return a snapshot without detections: clouds, claimed and true poses, and true boxes."""
    truth = None
    if snapshot.truth is not None:
        boxes = snapshot.truth.boxes
        truth = ShownBoxes(boxes, ("truth",) * len(boxes))
    agents = _show_agents(snapshot, {})
    ego = snapshot.frames[0]
    no_boxes = ShownBoxes(Boxes.empty(), ())
    return SpatialFrame(snapshot.index, ego.timestamp_ns, agents, no_boxes, truth, numbers=_pose_numbers(agents))


def show_step(step: ReplayStep, min_score: float = 0.0, detection_range: BevGrid | None = None) -> SpatialFrame:
    """Return one step of a replay: boxes marked against the truth where it is known, and messages with bytes and age.

    detection_range: about the ego; vehicles beyond it cannot be found, and are not marked as missed.
    """
    snapshot, ego = step.snapshot, step.snapshot.frames[step.ego]
    times_ns = {frame.agent_id: frame.timestamp_ns for frame in snapshot.frames}
    # The pose in an older message is that of an older sweep: it is no correction of the present one.
    corrected = {
        one.message.agent_id: one.message.world_from_agent
        for one in step.perception.received
        if step.perception.corrections and one.message.timestamp_ns == times_ns.get(one.message.agent_id)
    }
    agents = _show_agents(snapshot, corrected)
    sent = {one.agent_id: one.num_bytes for one in step.sent}
    links = tuple(
        ShownLink(
            one.message.agent_id, ego.agent_id, sent.get(one.message.agent_id, 0), 1e3 * age_s, one.last_arrival_ns
        )
        for one, age_s in zip(step.perception.received, step.ages_s)
    )
    numbers = {f"bytes/{agent_id}": float(count) for agent_id, count in sent.items()}
    numbers |= {f"age_ms/{link.sender}": link.age_ms for link in links} | _pose_numbers(agents)
    numbers |= {"stage_ms/perceive": 1e3 * step.perceive_seconds} | _numbers_of(step.perception)
    boxes, truth = _show_boxes(step.perception, ego, min_score), None
    if snapshot.truth is not None:
        listed = snapshot.truth.of_classes()
        others = listed.boxes[listed.seen.any(0) & (listed.boxes.id != ego.agent_id)]
        kinds, true_kinds = mark_errors(boxes.boxes, others)
        inside = _find_inside(others, ego, detection_range)
        true_kinds = tuple(kind if near else "truth" for kind, near in zip(true_kinds, inside))
        boxes, truth = ShownBoxes(boxes.boxes, kinds), ShownBoxes(others, true_kinds)
        marks = (*kinds, *true_kinds)
        numbers |= {f"counts/{kind}": float(marks.count(kind)) for kind in ("matched", "false", "missed")}
    return SpatialFrame(
        snapshot.index, ego.timestamp_ns, agents, boxes, truth, links, {}, numbers, _events_of(step.perception)
    )


def show_run(path: Path, make_agent: Callable[[RunConfig], Agent], min_score: float = 0.0) -> Iterator[SpatialFrame]:
    """Yield the frames of a recorded live run, computed again.

    Raises:
        RecordingError: the file is no whole recording of a live run.
    """
    local_maps, map_lines = dict[int, MapElements](), dict[str, tuple[Floats, ...]]()
    for index, tick in enumerate(replay_run(path, make_agent)):
        # A local map comes with few messages; the latest one of each sender is shown until the next.
        if received := _place_local_maps(tick.perception.received):
            local_maps |= received
            map_lines = _lines_by_kind(local_maps.values())
        yield _show_tick(index, tick, map_lines, min_score)


def _show_tick(index: int, tick: ReplayedTick, map_lines: MapLines, min_score: float) -> SpatialFrame:
    frame, perception = tick.frame, tick.perception
    received = {one.message.agent_id: one for one in perception.received}
    agents = [_show_agent(frame)]
    links, numbers = list[ShownLink](), dict[str, float]()
    for agent_id, one in received.items():
        stated = tick.stated_poses.get(agent_id, one.message.world_from_agent)
        agents.append(ShownAgent(agent_id, stated, corrected=_moved(stated, one.message.world_from_agent)))
        age_ms = one.age_ns(tick.now_ns) / 1e6
        links.append(
            ShownLink(agent_id, frame.agent_id, tick.received_bytes.get(agent_id, 0), age_ms, one.last_arrival_ns)
        )
        numbers |= {f"age_ms/{agent_id}": age_ms, f"bytes/{agent_id}": float(tick.received_bytes.get(agent_id, 0))}
    events = (*_events_of(perception), *(() if tick.same_result else ("the result differs from the recorded one",)))
    return SpatialFrame(
        index,
        frame.timestamp_ns,
        tuple(agents),
        _show_boxes(perception, frame, min_score),
        None,
        tuple(links),
        map_lines,
        numbers | {"level": float(tick.level)} | _numbers_of(perception),
        events,
    )


def _find_inside(boxes: Boxes, ego: AgentFrame, detection_range: BevGrid | None) -> list[bool]:
    """Return for each box in the world whether its centre lies in the range about the ego, seen from above."""
    if detection_range is None:
        return [True] * len(boxes)
    x, y, _ = ego.world_from_agent.inverse().apply(boxes.center.double()).unbind(-1)
    r = detection_range
    return ((x >= r.x_min) & (x <= r.x_max) & (y >= r.y_min) & (y <= r.y_max)).tolist()


def _show_agents(snapshot: Snapshot, corrected: Mapping[int, Transform]) -> tuple[ShownAgent, ...]:
    agents = [_show_agent(frame, corrected.get(frame.agent_id)) for frame in snapshot.frames]
    if snapshot.truth is None:
        return tuple(agents)
    true_poses = snapshot.truth.world_from_agent
    return tuple(
        replace(agent, true_pose=_moved(agent.world_from_agent, true_poses[row])) for row, agent in enumerate(agents)
    )


def _show_agent(frame: AgentFrame, corrected: Transform | None = None) -> ShownAgent:
    points = frame.points
    intensity = points.intensity.reshape(-1).float().cpu().numpy()
    claimed = frame.world_from_agent
    moved = None if corrected is None else _moved(claimed, corrected)
    return ShownAgent(frame.agent_id, claimed, points.xyz.float().cpu().numpy(), intensity, moved)


def _moved(claimed: Transform, other: Transform) -> Transform | None:
    """Return the other pose where it differs from the claimed one."""
    distance_m, turn_deg = measure_pose_difference(claimed, other)
    return other if distance_m > MIN_DIFFERENCE_M or turn_deg > MIN_DIFFERENCE_DEG else None


def _pose_numbers(agents: Sequence[ShownAgent]) -> dict[str, float]:
    """Return the distances of claimed and corrected poses from the true ones, metres, where they differ."""
    numbers: dict[str, float] = {}
    for agent in agents:
        if agent.true_pose is not None:
            numbers[f"pose_error_m/claimed/{agent.agent_id}"] = measure_pose_difference(
                agent.world_from_agent, agent.true_pose
            )[0]
            if agent.corrected is not None:
                distance_m, _ = measure_pose_difference(agent.corrected, agent.true_pose)
                numbers[f"pose_error_m/corrected/{agent.agent_id}"] = distance_m
    return numbers


def _show_boxes(perception: Perception, frame: AgentFrame, min_score: float) -> ShownBoxes:
    """Return boxes in the world, of a score at least, with the kind of their evidence where senders are assessed."""
    boxes = perception.boxes
    keep = boxes.score >= min_score
    kinds = ["found"] * len(boxes)
    if perception.evidence is not None:
        kinds = [_EVIDENCE[int(kind)] for kind in perception.evidence.kinds.tolist()]
    shown = boxes[keep].to(torch.float64).transform(frame.world_from_agent.double())
    return ShownBoxes(shown, tuple(kind for kind, kept in zip(kinds, keep.tolist()) if kept))


def _numbers_of(perception: Perception) -> dict[str, float]:
    reasons = [one.reason for one in perception.rejected]
    numbers = {f"rejected/{reason}": float(reasons.count(reason)) for reason in sorted(set(reasons))}
    assessment = perception.assessment
    for sender in () if assessment is None else assessment.senders:
        numbers[f"trust/{sender.agent_id}"] = sender.trust
    return numbers


def _events_of(perception: Perception) -> tuple[str, ...]:
    return tuple(f"agent {one.agent_id} rejected: {one.reason}: {one.text}" for one in perception.rejected)


def _place_local_maps(received: tuple[ReceivedMessage, ...]) -> dict[int, MapElements]:
    """Return the received local maps in the world, by agent id."""
    placed = dict[int, MapElements]()
    for one in received:
        if one.message.local_map is not None:
            pose = one.message.world_from_agent
            x, y, _ = pose.translation.tolist()
            placed[one.message.agent_id] = one.message.local_map.elements.transform(x, y, float(pose.yaw))
    return placed


def _lines_by_kind(many: Iterable[MapElements]) -> dict[str, tuple[Floats, ...]]:
    """Return polylines (K, 2) by kind; rings are closed."""
    lines: dict[str, list[Floats]] = {}
    for elements in many:
        closed = elements.closed
        for row in range(len(elements)):
            line = elements.polyline(row)
            line = np.concatenate((line, line[:1])) if closed[row] else line
            lines.setdefault(KINDS[int(elements.kind[row])], []).append(line)
    return {kind: tuple(found) for kind, found in lines.items()}
