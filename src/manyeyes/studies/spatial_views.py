# SPDX-License-Identifier: Apache-2.0
"""Frames of a viewer (``viz.spatial_frame``) from a recording, from a replay of a method, and from a recorded live run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from manyeyes.agents.agent import Agent, Perception
from manyeyes.agents.replay import ReplayStep
from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.datatypes import AgentFrame, Boxes, Snapshot, Transform
from manyeyes.datatypes.map_element import KINDS
from manyeyes.runtime.recorder import RunConfig
from manyeyes.runtime.replay import ReplayedTick, replay_run
from manyeyes.viz.spatial_frame import Floats, ShownAgent, ShownBoxes, ShownLink, SpatialFrame, mark_errors

_EVIDENCE = ("unchecked", "supported", "corroborated", "disputed", "refuted", "own")
"""Kinds by the value of ``agents.trust.interface.Evidence``."""


def show_snapshot(snapshot: Snapshot) -> SpatialFrame:
    """Return a snapshot without detections: clouds, poses, and true boxes."""
    truth = None
    if snapshot.truth is not None:
        boxes = snapshot.truth.boxes
        truth = ShownBoxes(boxes, ("truth",) * len(boxes))
    agents = tuple(_show_agent(frame) for frame in snapshot.frames)
    ego = snapshot.frames[0]
    return SpatialFrame(snapshot.index, ego.timestamp_ns, agents, ShownBoxes(Boxes.empty(), ()), truth)


def show_step(step: ReplayStep, min_score: float = 0.0) -> SpatialFrame:
    """Return one step of a replay: boxes marked against the truth where it is known, and messages with bytes and age."""
    snapshot, ego = step.snapshot, step.snapshot.frames[step.ego]
    corrected = {one.message.agent_id: one.message.world_from_agent for one in step.perception.received}
    agents = tuple(_show_agent(frame, corrected.get(frame.agent_id)) for frame in snapshot.frames)
    sent = {one.agent_id: one.num_bytes for one in step.sent}
    links = tuple(
        ShownLink(
            one.message.agent_id, ego.agent_id, sent.get(one.message.agent_id, 0), 1e3 * age_s, one.last_arrival_ns
        )
        for one, age_s in zip(step.perception.received, step.ages_s)
    )
    numbers = {f"bytes/{agent_id}": float(count) for agent_id, count in sent.items()}
    numbers |= {f"age_ms/{link.sender}": link.age_ms for link in links}
    numbers |= {"stage_ms/perceive": 1e3 * step.perceive_seconds} | _numbers_of(step.perception)
    boxes, truth = _show_boxes(step.perception, ego, min_score), None
    if snapshot.truth is not None:
        listed = snapshot.truth.of_classes()
        others = listed.boxes[listed.seen.any(0) & (listed.boxes.id != ego.agent_id)]
        kinds, true_kinds = mark_errors(boxes.boxes, others)
        boxes, truth = ShownBoxes(boxes.boxes, kinds), ShownBoxes(others, true_kinds)
    return SpatialFrame(
        snapshot.index, ego.timestamp_ns, agents, boxes, truth, links, {}, numbers, _events_of(step.perception)
    )


def show_run(path: Path, make_agent: Callable[[RunConfig], Agent], min_score: float = 0.0) -> Iterator[SpatialFrame]:
    """Yield the frames of a recorded live run, computed again.

    Raises:
        RecordingError: the file is no whole recording of a live run.
    """
    for index, tick in enumerate(replay_run(path, make_agent)):
        yield _show_tick(index, tick, min_score)


def _show_tick(index: int, tick: ReplayedTick, min_score: float) -> SpatialFrame:
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
        _map_lines(perception.received),
        numbers | {"level": float(tick.level)} | _numbers_of(perception),
        events,
    )


def _show_agent(frame: AgentFrame, corrected: Transform | None = None) -> ShownAgent:
    points = frame.points
    intensity = points.intensity.reshape(-1).float().cpu().numpy()
    stated = frame.world_from_agent
    moved = None if corrected is None else _moved(stated, corrected)
    return ShownAgent(frame.agent_id, stated, points.xyz.float().cpu().numpy(), intensity, moved)


def _moved(stated: Transform, corrected: Transform) -> Transform | None:
    """Return the corrected pose where it differs from the stated one."""
    return None if torch.equal(stated.translation.double(), corrected.translation.double()) else corrected


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


def _map_lines(received: tuple[ReceivedMessage, ...]) -> dict[str, tuple[Floats, ...]]:
    """Return the elements of received local maps in the world, by kind."""
    lines: dict[str, list[Floats]] = {}
    for one in received:
        local_map = one.message.local_map
        if local_map is None:
            continue
        pose = one.message.world_from_agent
        x, y, _ = pose.translation.tolist()
        elements = local_map.elements.transform(x, y, float(pose.yaw))
        for row in range(len(elements)):
            lines.setdefault(KINDS[int(elements.kind[row])], []).append(elements.polyline(row))
    return {kind: tuple(found) for kind, found in lines.items()}
