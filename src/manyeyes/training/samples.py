# SPDX-License-Identifier: Apache-2.0
"""From a snapshot with truth to what one training step sees; augmentation is one motion of each agent's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datasets.recording import Recording, judged_frames
from manyeyes.datatypes import BevGrid, Boxes, ConfigError, PointCloud, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_generator


@dataclass(frozen=True)
class AugmentConfig:
    """turn_rad: each agent's frame is turned by a uniform angle up to this, its pose with it, so that relative headings vary.

    scale: everything is enlarged by a uniform factor within 1 ± scale; flip: mirrored left to right half of the time.
    thin: share of points dropped, uniform up to this. early_share: samples whose clouds are merged into the ego's, as early
    fusion does. max_agents: at most so many, ego included, a random number of them; from 99 on all that there are.
    """

    turn_rad: float = math.pi / 4
    scale: float = 0.05
    flip: bool = True
    thin: float = 0.3
    early_share: float = 0.15
    max_agents: int = 5

    @classmethod
    def none(cls) -> AugmentConfig:
        """Samples as they were recorded, all agents, each with its own cloud."""
        return cls(0.0, 0.0, False, 0.0, 0.0, 99)


@dataclass(frozen=True)
class Sample:
    """One ego and its collaborators. clouds[0] is the ego's; each cloud in its agent's frame.

    ego_from_agent: one motion an agent, the first the identity. seen: what each agent lists, in its own frame.
    union: what any of them lists, in the ego's frame.
    """

    clouds: tuple[PointCloud, ...]
    ego_from_agent: tuple[Transform, ...]
    seen: tuple[Boxes, ...]
    union: Boxes


def make_sample(
    snapshot: Snapshot, ego: int, grid: BevGrid, config: AugmentConfig, key: tuple[int | str, ...]
) -> Sample:
    """The sample with this ego; every random choice follows from key."""
    truth = snapshot.truth
    if truth is None:
        raise ConfigError(
            f"Scenario {snapshot.scenario}, frame {snapshot.index} has no truth: it cannot train or judge a detector."
        )
    rng = keyed_generator("augment", *key)
    others = [i for i in range(len(snapshot.frames)) if i != ego]
    wanted = (
        int(rng.integers(0, min(len(others), config.max_agents - 1) + 1)) if config.max_agents < 99 else len(others)
    )
    chosen = [ego, *(others[i] for i in rng.permutation(len(others))[:wanted])]
    flip = config.flip and rng.random() < 0.5
    scale = 1 + config.scale * rng.uniform(-1, 1)
    clouds, poses, seen = [], [], []
    for i in chosen:
        turn = Transform.from_xyz_yaw(0, 0, 0, config.turn_rad * rng.uniform(-1, 1))
        frame = snapshot.frames[i]
        agent_from_world = (truth.world_from_agent[i] @ turn).inverse()
        cloud = frame.points.transform(turn.inverse())
        if config.thin:
            cloud = cloud[torch.from_numpy(rng.random(len(cloud)) >= config.thin * rng.random())]
        clouds.append(cloud)
        poses.append(frame.world_from_agent @ turn)
        others_boxes = truth.boxes.id != frame.agent_id
        seen.append(truth.boxes[truth.seen[i] & others_boxes].transform(agent_from_world))
    mine = truth.boxes.id != snapshot.frames[ego].agent_id
    ego_from_world = poses[0].inverse()
    union = truth.boxes[truth.seen[chosen].any(0) & mine].transform(ego_from_world)
    ego_from_agent = [ego_from_world @ pose for pose in poses]
    if rng.random() < config.early_share:
        clouds = [PointCloud.cat([cloud.transform(t) for cloud, t in zip(clouds, ego_from_agent)])]
        ego_from_agent, seen = ego_from_agent[:1], [union]
    return Sample(
        tuple(_resize_cloud(cloud, scale, flip) for cloud in clouds),
        tuple(_resize_motion(motion, scale, flip) for motion in ego_from_agent),
        tuple(_in_range(_resize_boxes(boxes, scale, flip), grid) for boxes in seen),
        _in_range(_resize_boxes(union, scale, flip), grid),
    )


def _in_range(boxes: Boxes, grid: BevGrid) -> Boxes:
    return boxes[grid.inside(boxes.center[:, :2])]


def _mirror(flip: bool, dtype: torch.dtype) -> Tensor:
    return torch.tensor([1.0, -1.0 if flip else 1.0, 1.0], dtype=dtype)


def _resize_cloud(cloud: PointCloud, scale: float, flip: bool) -> PointCloud:
    return replace(cloud, xyz=cloud.xyz * (_mirror(flip, cloud.xyz.dtype) * scale))


def _resize_motion(motion: Transform, scale: float, flip: bool) -> Transform:
    mirror = _mirror(flip, motion.rotation.dtype)
    return Transform(mirror[:, None] * motion.rotation * mirror, motion.translation * mirror * scale)


def _resize_boxes(boxes: Boxes, scale: float, flip: bool) -> Boxes:
    center = boxes.center * (_mirror(flip, boxes.center.dtype) * scale)
    return replace(boxes, center=center, size=boxes.size * scale, yaw=-boxes.yaw if flip else boxes.yaw)


@dataclass(frozen=True)
class SampleStream:
    """An endless, keyed stream: sample i of a run is the same whatever the number of processes that draw it."""

    recording: Recording
    grid: BevGrid
    augment: AugmentConfig
    seed: int

    def draw(self, number: int) -> Sample:
        """Sample of that number: a scenario, a frame with a history and an ego, all uniform."""
        rng = keyed_generator("sample", self.seed, number)
        scenarios = self.recording.scenarios
        scenario = scenarios[int(rng.integers(len(scenarios)))]
        index = int(rng.integers(self.recording.length(scenario)))
        snapshot = self.recording.snapshot(scenario, index)
        ego = int(rng.integers(len(snapshot.frames)))
        return make_sample(snapshot, ego, self.grid, self.augment, (self.seed, number))


def epoch_length(recording: Recording) -> int:
    """Judged frames of a recording: one epoch."""
    return sum(1 for _ in judged_frames(recording))
