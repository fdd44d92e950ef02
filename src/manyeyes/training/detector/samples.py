# SPDX-License-Identifier: Apache-2.0
"""Make training samples from snapshots with ground truth; augmentation moves each agent's frame.

Degradations are drawn per collaborator: delay, pose noise, packet loss, and a budget that limits the number of sent
tokens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch

from manyeyes.agents.level_frame import SnapshotLeveller, clean_frame
from manyeyes.datasets.base import Recording, iter_eval_frames
from manyeyes.datasets.deferred import read_deferred
from manyeyes.datasets.mixed import draw_scenario
from manyeyes.datatypes import VEHICLES, BevGrid, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.training.detector.sensor_augmentation import SensorAugmentation, SensorAugmentConfig
from manyeyes.training.mirroring import mirror_factors, resize_cloud, resize_transform

MAX_BUDGET_TOKENS = 1500
"""Maximum of random budgets, which is about all tokens of a view."""


@dataclass(frozen=True)
class AugmentConfig:
    """Augmentation of a sample.

    Attributes:
        max_yaw_rad: maximum rotation of each agent's frame, pose included, so that relative headings vary.
        max_scale_change: maximum deviation of the scale factor from 1.
        flip: mirror left to right with probability 0.5.
        max_point_dropout: maximum fraction of dropped points.
        early_fusion_prob: probability that all clouds are merged into the ego's, as in early fusion.
        max_agents: maximum number of agents, ego included, of a random number; from 99 on all agents.
        sensors: sensors of the agents, drawn anew for every sample; None for those of the recording.
    """

    max_yaw_rad: float = math.pi / 4
    max_scale_change: float = 0.05
    flip: bool = True
    max_point_dropout: float = 0.3
    early_fusion_prob: float = 0.15
    max_agents: int = 5
    sensors: SensorAugmentConfig | None = None

    @classmethod
    def none(cls) -> AugmentConfig:
        """Disable augmentation: recorded samples, all agents, each with its own cloud."""
        return cls(0.0, 0.0, False, 0.0, 0.0, 99)


@dataclass(frozen=True)
class DegradationConfig:
    """Degradation of communication and poses, drawn again for every sample.

    Attributes:
        ego_history: number of earlier instants of the ego in its fusion input.
        sender_history: number of earlier messages of each collaborator in the fusion input.
        delay_prob: probability that a collaborator is delayed.
        max_delay_frames: maximum delay; the minimum is one frame.
        pose_noise_prob: probability of pose noise in a sample.
        max_sigma_xy_m: maximum standard deviation of positions; zero for half of the noisy samples.
        max_sigma_yaw_rad: maximum standard deviation of headings; zero for half of the noisy samples.
        packet_loss_prob: probability that a collaborator loses packets.
        max_loss_fraction: maximum fraction of lost tokens.
        budget_prob: probability that a collaborator is under a budget.
        min_budget_tokens: minimum budget; budgets are log-uniform up to all tokens.
    """

    ego_history: int = 0
    sender_history: int = 0
    delay_prob: float = 0.0
    max_delay_frames: int = 4
    pose_noise_prob: float = 0.0
    max_sigma_xy_m: float = 0.8
    max_sigma_yaw_rad: float = math.radians(0.8)
    packet_loss_prob: float = 0.0
    max_loss_fraction: float = 0.6
    budget_prob: float = 0.0
    min_budget_tokens: int = 12


@dataclass(frozen=True)
class AgentView:
    """Observation of one agent at one instant.

    Attributes:
        cloud: its sweep, in its frame at that instant.
        previous_cloud: the sweep before, in the same frame.
        ego_from_view: from that frame to the ego's current frame, by the reported poses.
        age_s: time since the observation.
        visible_boxes: ground truth that the agent observed, in its frame.
        sigma_xy_m: standard deviation of the reported position.
        sigma_yaw_rad: standard deviation of the reported heading.
        loss_fraction: fraction of its tokens that are lost.
        max_tokens: budget in tokens, None without budget.
        is_infrastructure: whether the agent is a roadside unit.
    """

    cloud: PointCloud
    previous_cloud: PointCloud
    ego_from_view: Transform
    age_s: float
    visible_boxes: Boxes
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    loss_fraction: float = 0.0
    max_tokens: int | None = None
    is_infrastructure: bool = False


@dataclass(frozen=True)
class Sample:
    """One ego and its collaborators.

    Attributes:
        views: the ego's own view first.
        merged_gt_boxes: boxes that any of the agents observes now, in the ego's frame.
        ego_history: the ego's earlier views, newest first.
        sender_history: earlier views of each collaborator, newest first, agent by agent.
        key: of subsequent random draws.
    """

    views: tuple[AgentView, ...]
    ego_history: tuple[AgentView, ...]
    sender_history: tuple[AgentView, ...]
    merged_gt_boxes: Boxes
    key: tuple[int | str, ...]


def make_sample(
    snapshots: Sequence[Snapshot],
    ego: int,
    grid: BevGrid,
    config: AugmentConfig,
    key: tuple[int | str, ...],
    degradation: DegradationConfig | None = None,
    leveller: SnapshotLeveller | None = None,
    classes: Sequence[str] = VEHICLES,
) -> Sample:
    """Make the sample of this ego, a row of the last snapshot; key determines every random choice.

    snapshots: consecutive snapshots, oldest first; the last is the current one. Too few of them shorten the history.
    leveller: levels the frames that are used; None for frames that are level. classes: of the ground truth.
    """
    degradation = degradation or DegradationConfig()
    rng = keyed_generator("augment", *key)
    scene = _AugmentedScene([_select_truth(s, classes) for s in snapshots], rng, config, key, leveller)
    now = _select_truth(snapshots[-1], classes)
    chosen = _choose_agents(len(now.frames), ego, config.max_agents, rng)
    ids = [now.frames[i].agent_id for i in chosen]
    flip = config.flip and rng.random() < 0.5
    scale = 1 + config.max_scale_change * rng.uniform(-1, 1)
    ego_pose = scene.pose(0, ids[0])
    assert ego_pose is not None
    truth = _truth(now)
    mine = truth.boxes.id != ids[0]
    merged_gt_boxes = truth.boxes[truth.seen[chosen].any(0) & mine].transform(ego_pose.inverse())
    sigma_xy_m, sigma_yaw_rad = _draw_pose_noise(degradation, rng)
    views, sender_history = [scene.view(0, ids[0], ego_pose)], list[AgentView]()
    if rng.random() < config.early_fusion_prob:
        views = [scene.merge(ids, ego_pose, merged_gt_boxes)]
    else:
        for agent_id in ids[1:]:
            newest, *older = _degraded_views(scene, agent_id, ego_pose, (sigma_xy_m, sigma_yaw_rad), degradation, rng)
            views.append(newest)
            sender_history += older
    known = (k for k in range(1, degradation.ego_history + 1) if scene.pose(k, ids[0]) is not None)
    ego_history = [scene.view(k, ids[0], ego_pose) for k in known] if len(views) > 1 or len(ids) == 1 else []
    resize = partial(_resize_view, scale=scale, flip=flip, grid=grid)
    return Sample(
        tuple(map(resize, views)),
        tuple(map(resize, ego_history)),
        tuple(map(resize, sender_history)),
        _in_range(_resize_boxes(merged_gt_boxes, scale, flip), grid),
        key,
    )


def _choose_agents(count: int, ego: int, max_agents: int, rng: np.random.Generator) -> list[int]:
    """Choose the rows of the ego, first, and of random collaborators."""
    others = [i for i in range(count) if i != ego]
    # The larger of two draws: many collaborators are more frequent than few.
    max_others = min(len(others), max_agents - 1)
    num_others = int(rng.integers(0, max_others + 1, 2).max()) if max_agents < 99 else len(others)
    return [ego, *(others[i] for i in rng.permutation(len(others))[:num_others])]


def _draw_pose_noise(degradation: DegradationConfig, rng: np.random.Generator) -> tuple[float, float]:
    """Draw the standard deviations of positions and headings of a sample; a noisy sample has at least one of them."""
    is_noisy = rng.random() < degradation.pose_noise_prob
    sigma_xy_m, sigma_yaw_rad = (
        is_noisy * (rng.random() < 0.5) * top * rng.random()
        for top in (degradation.max_sigma_xy_m, degradation.max_sigma_yaw_rad)
    )
    if not sigma_xy_m and not sigma_yaw_rad and is_noisy:
        sigma_xy_m = degradation.max_sigma_xy_m * rng.random()
    return sigma_xy_m, sigma_yaw_rad


def _degraded_views(
    scene: _AugmentedScene,
    agent_id: int,
    ego_pose: Transform,
    sigmas: tuple[float, float],
    degradation: DegradationConfig,
    rng: np.random.Generator,
) -> list[AgentView]:
    """Draw the degradation of a collaborator, and return its received views, newest first."""
    delay = int(rng.integers(1, degradation.max_delay_frames + 1)) if rng.random() < degradation.delay_prob else 0
    off = rng.standard_normal(3) * (sigmas[0], sigmas[0], sigmas[1])
    loss_fraction = degradation.max_loss_fraction * rng.random() * (rng.random() < degradation.packet_loss_prob)
    max_tokens = None
    if rng.random() < degradation.budget_prob:
        max_tokens = int(math.exp(rng.uniform(math.log(degradation.min_budget_tokens), math.log(MAX_BUDGET_TOKENS))))
    first = delay if scene.pose(delay, agent_id) is not None else 0
    received = range(first, first + 1 + degradation.sender_history)
    views = [scene.view(k, agent_id, ego_pose, off) for k in received if scene.pose(k, agent_id) is not None]
    link = dict(zip(("sigma_xy_m", "sigma_yaw_rad"), sigmas), loss_fraction=loss_fraction, max_tokens=max_tokens)
    return [replace(view, **link) for view in views]


class _AugmentedScene:
    """The snapshots of one sample, with every agent's frame levelled, and rotated by its own angle."""

    def __init__(
        self,
        moments: Sequence[Snapshot],
        rng: np.random.Generator,
        config: AugmentConfig,
        key: tuple[int | str, ...],
        leveller: SnapshotLeveller | None,
    ) -> None:
        self._moments, self._rng, self._config, self._leveller = moments, rng, config, leveller
        ids = tuple(frame.agent_id for frame in moments[-1].frames)
        self._poses: dict[tuple[int, int], Transform] = {}
        self._agents_from_view: dict[tuple[int, int], Transform] = {}
        self._turn = {
            agent_id: Transform.from_xyz_yaw(0, 0, 0, config.max_yaw_rad * rng.uniform(-1, 1)) for agent_id in ids
        }
        self._sensors = None if config.sensors is None else SensorAugmentation(config.sensors, ids, key)
        if self._sensors is not None:
            self._turn = {
                agent_id: turn @ self._sensors.sensor(agent_id).frame_from_measured
                for agent_id, turn in self._turn.items()
            }

    def _row(self, back: int, agent_id: int) -> int | None:
        if back >= len(self._moments):
            return None
        ids = [frame.agent_id for frame in self._moments[-1 - back].frames]
        return ids.index(agent_id) if agent_id in ids else None

    def pose(self, back: int, agent_id: int) -> Transform | None:
        """Return the pose of an agent's rotated frame back snapshots ago; None where it was absent."""
        row = self._row(back, agent_id)
        if row is None:
            return None
        if (back, agent_id) not in self._poses:
            pose = self._moments[-1 - back].frames[row].world_from_agent
            self._poses[back, agent_id] = pose @ self._agent_from_view(back, row)
        return self._poses[back, agent_id]

    def _agent_from_view(self, back: int, row: int) -> Transform:
        """Return the motion from the levelled and rotated frame of an agent to its frame in the recording."""
        if (back, row) not in self._agents_from_view:
            snapshot = self._moments[-1 - back]
            frame = snapshot.frames[row]
            levelled_from_agent = None if self._leveller is None else self._leveller.find(snapshot, frame)
            turn = self._turn[frame.agent_id]
            motion = turn if levelled_from_agent is None else levelled_from_agent.inverse() @ turn
            self._agents_from_view[back, row] = motion
        return self._agents_from_view[back, row]

    def cloud(self, back: int, agent_id: int) -> PointCloud | None:
        """Return the agent's sweep in its rotated frame at that time, with points dropped out."""
        row = self._row(back, agent_id)
        if row is None:
            return None
        frame = clean_frame(self._moments[-1 - back].frames[row])
        points = frame.points if self._sensors is None else self._sensors.points(frame)
        cloud = points.transform(self._agent_from_view(back, row).inverse())
        if self._config.max_point_dropout:
            thin = self._config.max_point_dropout * self._rng.random()
            cloud = cloud[torch.from_numpy(self._rng.random(len(cloud)) >= thin)]
        return cloud

    def view(self, back: int, agent_id: int, ego: Transform, off: np.ndarray | None = None) -> AgentView:
        """Return the view of an agent back snapshots ago, which must exist; off: pose error in x, y (m) and yaw
        (rad).
        """
        snapshot, row = self._moments[-1 - back], self._row(back, agent_id)
        pose, now = self.pose(back, agent_id), self.cloud(back, agent_id)
        assert row is not None
        assert pose is not None
        assert now is not None
        truth = _truth(snapshot)
        true = truth.world_from_agent[row] @ self._agent_from_view(back, row)
        seen = truth.boxes[truth.seen[row] & (truth.boxes.id != agent_id)].transform(true.inverse())
        age_s = (self._moments[-1].frames[0].timestamp_ns - snapshot.frames[0].timestamp_ns) / 1e9
        earlier, motion = self._previous_cloud(back, agent_id, pose), ego.inverse() @ _displaced(pose, off)
        return AgentView(now, earlier, motion, age_s, seen, is_infrastructure=snapshot.frames[row].is_infrastructure)

    def merge(self, agent_ids: Sequence[int], ego: Transform, merged_gt_boxes: Boxes) -> AgentView:
        """Merge the current and previous clouds of all agents to one view of the ego."""
        clouds, earlier = [], []
        for one in agent_ids:
            pose, cloud = self.pose(0, one), self.cloud(0, one)
            assert pose is not None
            assert cloud is not None
            clouds.append(cloud.transform(ego.inverse() @ pose))
            earlier.append(self._previous_cloud(0, one, ego))
        return AgentView(PointCloud.cat(clouds), PointCloud.cat(earlier), ego.inverse() @ ego, 0.0, merged_gt_boxes)

    def _previous_cloud(self, back: int, agent_id: int, frame: Transform) -> PointCloud:
        """Return an agent's previous sweep, motion-compensated to a frame; empty where there is none."""
        pose, cloud = self.pose(back + 1, agent_id), self.cloud(back + 1, agent_id)
        is_single = self._sensors is not None and self._sensors.sensor(agent_id).is_single_sweep
        if pose is None or cloud is None or is_single:
            return PointCloud.of(torch.zeros(0, 3, device="cpu"))
        return cloud.transform(frame.inverse() @ pose)


def _truth(snapshot: Snapshot) -> GroundTruth:
    if snapshot.truth is None:
        raise ConfigError(
            f"Scenario {snapshot.scenario}, frame {snapshot.index} has no truth: it cannot be used for training or evaluation."
        )
    return snapshot.truth


def _select_truth(snapshot: Snapshot, classes: Sequence[str]) -> Snapshot:
    """Return the snapshot with the truth of some classes."""
    return snapshot if snapshot.truth is None else replace(snapshot, truth=snapshot.truth.of_classes(classes))


def _displaced(pose: Transform, off: np.ndarray | None) -> Transform:
    if off is None:
        return pose
    turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(off[2])).rotation.to(pose.rotation.dtype)
    shift = torch.tensor([off[0], off[1], 0.0], dtype=pose.translation.dtype, device="cpu")
    return Transform(turn @ pose.rotation, pose.translation + shift)


def _in_range(boxes: Boxes, grid: BevGrid) -> Boxes:
    return boxes[grid.contains(boxes.center[:, :2])]


def _resize_view(view: AgentView, scale: float, flip: bool, grid: BevGrid) -> AgentView:
    return replace(
        view,
        cloud=resize_cloud(view.cloud, scale, flip),
        previous_cloud=resize_cloud(view.previous_cloud, scale, flip),
        ego_from_view=resize_transform(view.ego_from_view, scale, flip),
        visible_boxes=_in_range(_resize_boxes(view.visible_boxes, scale, flip), grid),
    )


def _resize_boxes(boxes: Boxes, scale: float, flip: bool) -> Boxes:
    mirror = mirror_factors(flip, boxes.center.dtype) * scale
    yaw = -boxes.yaw if flip else boxes.yaw
    return replace(
        boxes, center=boxes.center * mirror, size=boxes.size * scale, yaw=yaw, velocity=boxes.velocity * mirror[:2]
    )


@dataclass(frozen=True)
class SampleStream:
    """An endless, keyed stream: sample i of a run does not depend on the number of processes. Frames are levelled, as by agents."""

    recording: Recording
    grid: BevGrid
    augment: AugmentConfig
    seed: int
    degradation: DegradationConfig = DegradationConfig()
    classes: tuple[str, ...] = VEHICLES
    _leveller: SnapshotLeveller = field(default_factory=SnapshotLeveller, repr=False, compare=False)

    def draw(self, number: int) -> Sample:
        """Draw the sample of this number: scenario, frame with the required history, and ego, all uniform but for the
        weights of a mixture.
        """
        rng = keyed_generator("sample", self.seed, number)
        scenario = draw_scenario(self.recording, rng)
        index = int(rng.integers(self.recording.length(scenario)))
        back = 1 + max(
            self.degradation.ego_history,
            self.degradation.sender_history + (self.degradation.max_delay_frames if self.degradation.delay_prob else 0),
        )
        moments = [read_deferred(self.recording, scenario, i) for i in range(max(0, index - back), index + 1)]
        ego = int(rng.integers(len(moments[-1].frames)))
        key = self.seed, number
        return make_sample(moments, ego, self.grid, self.augment, key, self.degradation, self._leveller, self.classes)


def epoch_length(recording: Recording) -> int:
    """Return the number of evaluated frames of a recording: one epoch."""
    return sum(1 for _ in iter_eval_frames(recording))
