# SPDX-License-Identifier: Apache-2.0
"""Collects, step by step, what the player of a report shows."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from manyeyes.agents.replay import ReplayStep
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import Boxes, Snapshot
from manyeyes.evaluation.detection.average_precision import filter_detections, match_frame, select_ego_truth
from manyeyes.evaluation.detection.frame_match import FrameResult
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.viz.birds_eye import MAX_GROUND_HEIGHT_M, make_scene
from manyeyes.viz.scene_player import (
    MAX_FRAMES,
    MIN_SCORE,
    Floats,
    Ints,
    PlayerAgent,
    PlayerDetections,
    PlayerFrame,
    PlayerMethod,
    ScenePlayer,
    find_cells,
)

MATCH_IOU = 0.5
BOX_MARGIN_M = 0.1
"""By which a box is enlarged on every side where returns inside are counted."""


@dataclass
class SceneRecorder:
    """Frames and detections of one drive. titles: of methods, by name; min_scores: of their drawn boxes."""

    protocol: DetectionProtocol
    methods: Sequence[str]
    titles: Mapping[str, str]
    min_scores: Mapping[str, float]
    indices: Sequence[int]
    frames: dict[int, PlayerFrame] = field(default_factory=dict)
    detections: dict[tuple[str, int], PlayerDetections] = field(default_factory=dict)
    air_ms: dict[str, list[float]] = field(default_factory=dict)
    _clouds: list[Floats] = field(default_factory=list)

    def __post_init__(self) -> None:
        stride = -(-len(self.indices) // MAX_FRAMES)
        self._shown: Collection[int] = self.indices[::stride] if stride > 1 else self.indices

    @property
    def view(self) -> tuple[float, float, float, float]:
        """The evaluated range: x_min, y_min, x_max, y_max, metres."""
        x_min, y_min, _, x_max, y_max, _ = self.protocol.gt_range
        return x_min, y_min, x_max, y_max

    def add(self, step: ReplayStep) -> None:
        """Record one method at one instant; all methods of an instant come before the next instant."""
        index = step.snapshot.index
        if index not in self._shown:
            return
        if index not in self.frames:
            self.frames[index] = self._make_frame(step.snapshot, step.ego)
        frame = self.frames[index]
        boxes, truth_row = match_detections(step, frame.truth, self.protocol)
        is_shown = boxes.score >= MIN_SCORE
        boxes, truth_row = boxes[is_shown], truth_row[is_shown.numpy()]
        sent = sum(s.num_bytes for s in step.sent if s.agent_id != frame.agents[0].agent_id)
        self.air_ms.setdefault(step.method, []).extend(
            (reception.last_arrival_ns - reception.message.timestamp_ns) / 1e6
            for reception in step.perception.received
            if reception.last_arrival_ns is not None
        )
        received = tuple(reception.message.agent_id for reception in step.perception.received)
        counts = count_returns(boxes, self._clouds)
        self.detections[step.method, index] = PlayerDetections(boxes, truth_row, counts, received, sent)

    def finish(self, first_index: int) -> ScenePlayer:
        """Return the player. first_index: of the frame that is shown first."""
        indices = sorted(self.frames)
        frames = [self.frames[index] for index in indices]
        times = [frame.time_s for frame in frames]
        period_s = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.1
        methods = tuple(
            PlayerMethod(
                name,
                self.titles.get(name, name),
                max(MIN_SCORE, self.min_scores[name]),
                get_strategy(name).waits_for_messages,
                tuple(self.detections[name, index] for index in indices),
                float(np.mean(self.air_ms[name])) if self.air_ms.get(name) else None,
            )
            for name in self.methods
        )
        first = min(range(len(indices)), key=lambda row: abs(indices[row] - first_index))
        return ScenePlayer(self.view, period_s, tuple(frames), methods, first, len(self.indices) - len(indices))

    def _make_frame(self, snapshot: Snapshot, ego: int) -> PlayerFrame:
        """Return agents, ego first, and true boxes of an instant; keeps the clouds for its methods."""
        scene = make_scene(snapshot, Boxes.empty(), ego)
        order = sorted(range(len(scene.agents)), key=lambda row: row != ego)
        clouds, agents = [], []
        for row in order:
            agent = scene.agents[row]
            xyz = agent.cloud.xyz.double().numpy()
            clouds.append(xyz)
            x, y = agent.ego_from_agent.translation[:2].tolist()
            yaw = float(agent.ego_from_agent.yaw)
            cells = find_cells(xyz[xyz[:, 2] > MAX_GROUND_HEIGHT_M, :2], self.view)
            agents.append(PlayerAgent(agent.agent_id, agent.name, agent.is_infrastructure, x, y, yaw, cells))
        self._clouds = clouds
        truth = Boxes.empty(torch.float64) if snapshot.truth is None else select_ego_truth(snapshot, ego, self.protocol)
        time_s = snapshot.frames[ego].timestamp_ns / 1e9
        return PlayerFrame(snapshot.index, time_s, tuple(agents), truth, count_returns(truth, clouds))


def match_detections(step: ReplayStep, truth: Boxes, protocol: DetectionProtocol) -> tuple[Boxes, Ints]:
    """Return the detections that count, and (D,) the row of the true box that each one matches at IoU 0.5, -1 for none.

    A match depends on detections of greater score alone: above any score it is that of the detections above this score.
    """
    boxes, rows = [], []
    for row, name in enumerate(protocol.classes):
        one_class = protocol.with_classes((name,))
        of_class = (truth.class_rows(protocol.classes) == row).nonzero()[:, 0]
        result = FrameResult(step.snapshot.scenario, step.snapshot.index, step.boxes, truth[of_class])
        matched = match_frame(result, MATCH_IOU, one_class).truth_row
        boxes.append(filter_detections(step.boxes, one_class))
        found = torch.full_like(matched, -1)
        found[matched >= 0] = of_class[matched[matched >= 0]]
        rows.append(found)
    return Boxes.cat(boxes), torch.cat(rows).numpy()


def count_returns(boxes: Boxes, clouds: Sequence[Floats]) -> Ints:
    """Return (N, A) int64: the points of each cloud (P, 3) inside each box, which is enlarged by BOX_MARGIN_M.

    Points up to MAX_GROUND_HEIGHT_M above the bottom of a box are left out: they may lie on the road.
    """
    counts = np.zeros((len(boxes), len(clouds)), dtype=np.int64)
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    agent = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    order = np.argsort(points[:, 0], kind="stable")
    points, agent = points[order], agent[order]
    for row, (centre, size, yaw) in enumerate(zip(boxes.center.tolist(), boxes.size.tolist(), boxes.yaw.tolist())):
        half = np.asarray(size) / 2 + BOX_MARGIN_M
        reach = float(np.hypot(half[0], half[1]))
        c, s = np.cos(yaw), np.sin(yaw)
        low, high = np.searchsorted(points[:, 0], (centre[0] - reach, centre[0] + reach))
        near = low + np.flatnonzero(np.abs(points[low:high, 1] - centre[1]) <= reach)
        offset = points[near] - centre
        forward, left = offset[:, 0] * c + offset[:, 1] * s, offset[:, 1] * c - offset[:, 0] * s
        inside = (np.abs(forward) <= half[0]) & (np.abs(left) <= half[1]) & (offset[:, 2] <= half[2])
        inside &= offset[:, 2] > MAX_GROUND_HEIGHT_M - size[2] / 2
        counts[row] = np.bincount(agent[near[inside]], minlength=len(clouds))
    return counts
