# SPDX-License-Identifier: Apache-2.0
"""From snapshots with truth to what one training step sees; augmentation is one motion of each agent's frame.

What goes wrong on the road is drawn here too, for each collaborator by itself: it looked some frames ago, its claimed pose is
off, packets were lost, and a budget let it send a part of its tokens only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from manyeyes.datasets.base import Recording, judged_frames
from manyeyes.datatypes import BevGrid, Boxes, ConfigError, PointCloud, Snapshot, Transform, Truth
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
class RoadConfig:
    """What goes wrong, drawn anew for every sample (issue: training for the real world; detection.md 5.3).

    past: instants before now that the ego looks back at. said: messages of each collaborator before its last that the ego
    remembers. late_share: of collaborators that looked 1 … late_frames ago.
    astray_share: of samples whose collaborators' claims are off, with deviations uniform up to xy_m and yaw_rad, each of which
    is nothing half of the time. lost_share: of collaborators that lose packets, up to lost of their tokens. few_share: of
    collaborators under a budget, which leaves them from few tokens to all, uniform in the logarithm.
    """

    past: int = 0
    said: int = 0
    late_share: float = 0.0
    late_frames: int = 4
    astray_share: float = 0.0
    xy_m: float = 0.8
    yaw_rad: float = math.radians(0.8)
    lost_share: float = 0.0
    lost: float = 0.6
    few_share: float = 0.0
    few: int = 12


@dataclass(frozen=True)
class View:
    """One look of one agent. now and earlier: its last two sweeps, in its frame of then.

    ego_from_view: from there to the ego's frame of now, as claimed. age_s: how long ago. doubt_xy_m, doubt_yaw_rad: of the claim.
    seen: what the agent listed then, in its frame. lost: share of its tokens that do not arrive; keep: how many of them a
    budget lets it send, None for all.
    """

    now: PointCloud
    earlier: PointCloud
    ego_from_view: Transform
    age_s: float
    seen: Boxes
    doubt_xy_m: float = 0.0
    doubt_yaw_rad: float = 0.0
    lost: float = 0.0
    keep: int | None = None


@dataclass(frozen=True)
class Sample:
    """One ego and its collaborators: views[0] is the ego's own. past: the ego's own looks before, newest first.

    said: what each collaborator looked at before, newest first, agent by agent. union: what any of the agents lists now, in the
    ego's frame. key: of draws that follow.
    """

    views: tuple[View, ...]
    past: tuple[View, ...]
    said: tuple[View, ...]
    union: Boxes
    key: tuple[int | str, ...]


def make_sample(
    moments: Sequence[Snapshot],
    ego: int,
    grid: BevGrid,
    config: AugmentConfig,
    key: tuple[int | str, ...],
    road: RoadConfig | None = None,
) -> Sample:
    """The sample with this ego, a row of the last moment; every random choice follows from key.

    moments: consecutive snapshots, oldest first; the last is now. Where they reach back less far than asked, so does the sample.
    """
    road = road or RoadConfig()
    rng = keyed_generator("augment", *key)
    scene = _Scene(moments, rng, config)
    now = moments[-1]
    others = [i for i in range(len(now.frames)) if i != ego]
    most = min(len(others), config.max_agents - 1)
    # The larger of two draws: few collaborators are met too, many more often.
    wanted = int(rng.integers(0, most + 1, 2).max()) if config.max_agents < 99 else len(others)
    chosen = [ego, *(others[i] for i in rng.permutation(len(others))[:wanted])]
    ids = [now.frames[i].agent_id for i in chosen]
    flip = config.flip and rng.random() < 0.5
    scale = 1 + config.scale * rng.uniform(-1, 1)
    ego_pose = scene.pose(0, ids[0])
    assert ego_pose is not None
    truth = _truth(now)
    mine = truth.boxes.id != ids[0]
    union = truth.boxes[truth.seen[chosen].any(0) & mine].transform(ego_pose.inverse())
    astray = rng.random() < road.astray_share
    xy_m, yaw_rad = (astray * (rng.random() < 0.5) * top * rng.random() for top in (road.xy_m, road.yaw_rad))
    if not xy_m and not yaw_rad and astray:
        xy_m = road.xy_m * rng.random()
    views, said = [scene.view(0, ids[0], ego_pose)], list[View]()
    if rng.random() < config.early_share:
        views = [scene.merged(ids, ego_pose, union)]
    else:
        for who in ids[1:]:
            back = int(rng.integers(1, road.late_frames + 1)) if rng.random() < road.late_share else 0
            off = rng.standard_normal(3) * (xy_m, xy_m, yaw_rad)
            lost = road.lost * rng.random() * (rng.random() < road.lost_share)
            few = math.exp(rng.uniform(math.log(road.few), math.log(1500))) if rng.random() < road.few_share else None
            back = back if scene.pose(back, who) is not None else 0
            keep = None if few is None else int(few)
            instants = [k for k in range(back, back + 1 + road.said) if scene.pose(k, who) is not None]
            looks = (scene.view(k, who, ego_pose, off) for k in instants)
            told = [replace(v, doubt_xy_m=xy_m, doubt_yaw_rad=yaw_rad, lost=lost, keep=keep) for v in looks]
            views.append(told[0])
            said += told[1:]
    known = (k for k in range(1, road.past + 1) if scene.pose(k, ids[0]) is not None)
    past = tuple(scene.view(k, ids[0], ego_pose) for k in known) if len(views) > 1 or len(ids) == 1 else ()
    return Sample(
        tuple(_resize_view(view, scale, flip, grid) for view in views),
        tuple(_resize_view(view, scale, flip, grid) for view in past),
        tuple(_resize_view(view, scale, flip, grid) for view in said),
        _in_range(_resize_boxes(union, scale, flip), grid),
        key,
    )


class _Scene:
    """The moments of one sample, with every agent's frame turned by an angle of its own."""

    def __init__(self, moments: Sequence[Snapshot], rng: np.random.Generator, config: AugmentConfig) -> None:
        self._moments, self._rng, self._config = moments, rng, config
        self._turn = {
            frame.agent_id: Transform.from_xyz_yaw(0, 0, 0, config.turn_rad * rng.uniform(-1, 1))
            for frame in moments[-1].frames
        }

    def _row(self, back: int, who: int) -> int | None:
        if back >= len(self._moments):
            return None
        ids = [frame.agent_id for frame in self._moments[-1 - back].frames]
        return ids.index(who) if who in ids else None

    def pose(self, back: int, who: int) -> Transform | None:
        """World from the turned frame of an agent, so many moments ago; None where it was not there."""
        row = self._row(back, who)
        if row is None:
            return None
        return self._moments[-1 - back].frames[row].world_from_agent @ self._turn[who]

    def cloud(self, back: int, who: int) -> PointCloud | None:
        """Its sweep, in its turned frame of then, thinned."""
        row = self._row(back, who)
        if row is None:
            return None
        cloud = self._moments[-1 - back].frames[row].points.transform(self._turn[who].inverse())
        if self._config.thin:
            thin = self._config.thin * self._rng.random()
            cloud = cloud[torch.from_numpy(self._rng.random(len(cloud)) >= thin)]
        return cloud

    def view(self, back: int, who: int, ego: Transform, off: np.ndarray | None = None) -> View:
        """The look of an agent so many moments ago, which must be there; off: of its claim in x, y (m) and yaw (rad)."""
        snapshot, row = self._moments[-1 - back], self._row(back, who)
        pose, now = self.pose(back, who), self.cloud(back, who)
        assert row is not None
        assert pose is not None
        assert now is not None
        truth = _truth(snapshot)
        true = truth.world_from_agent[row] @ self._turn[who]
        seen = truth.boxes[truth.seen[row] & (truth.boxes.id != who)].transform(true.inverse())
        age_s = (self._moments[-1].frames[0].timestamp_ns - snapshot.frames[0].timestamp_ns) / 1e9
        return View(now, self._before(back, who, pose), ego.inverse() @ _displaced(pose, off), age_s, seen)

    def merged(self, who: Sequence[int], ego: Transform, union: Boxes) -> View:
        """The clouds of all agents as the ego's own, now and the moment before."""
        clouds, earlier = [], []
        for one in who:
            pose, cloud = self.pose(0, one), self.cloud(0, one)
            assert pose is not None
            assert cloud is not None
            clouds.append(cloud.transform(ego.inverse() @ pose))
            earlier.append(self._before(0, one, ego))
        return View(PointCloud.cat(clouds), PointCloud.cat(earlier), ego.inverse() @ ego, 0.0, union)

    def _before(self, back: int, who: int, frame: Transform) -> PointCloud:
        """An agent's sweep of the moment before, moved by its own motion into a frame; empty where there is none."""
        pose, cloud = self.pose(back + 1, who), self.cloud(back + 1, who)
        if pose is None or cloud is None:
            return PointCloud.of(torch.zeros(0, 3))
        return cloud.transform(frame.inverse() @ pose)


def _truth(snapshot: Snapshot) -> Truth:
    if snapshot.truth is None:
        raise ConfigError(
            f"Scenario {snapshot.scenario}, frame {snapshot.index} has no truth: it cannot train or judge a detector."
        )
    return snapshot.truth


def _displaced(pose: Transform, off: np.ndarray | None) -> Transform:
    if off is None:
        return pose
    turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(off[2])).rotation.to(pose.rotation.dtype)
    shift = torch.tensor([off[0], off[1], 0.0], dtype=pose.translation.dtype)
    return Transform(turn @ pose.rotation, pose.translation + shift)


def _in_range(boxes: Boxes, grid: BevGrid) -> Boxes:
    return boxes[grid.inside(boxes.center[:, :2])]


def _mirror(flip: bool, dtype: torch.dtype) -> Tensor:
    return torch.tensor([1.0, -1.0 if flip else 1.0, 1.0], dtype=dtype)


def _resize_view(view: View, scale: float, flip: bool, grid: BevGrid) -> View:
    return replace(
        view,
        now=_resize_cloud(view.now, scale, flip),
        earlier=_resize_cloud(view.earlier, scale, flip),
        ego_from_view=_resize_motion(view.ego_from_view, scale, flip),
        seen=_in_range(_resize_boxes(view.seen, scale, flip), grid),
    )


def _resize_cloud(cloud: PointCloud, scale: float, flip: bool) -> PointCloud:
    return replace(cloud, xyz=cloud.xyz * (_mirror(flip, cloud.xyz.dtype) * scale))


def _resize_motion(motion: Transform, scale: float, flip: bool) -> Transform:
    mirror = _mirror(flip, motion.rotation.dtype)
    return Transform(mirror[:, None] * motion.rotation * mirror, motion.translation * mirror * scale)


def _resize_boxes(boxes: Boxes, scale: float, flip: bool) -> Boxes:
    mirror = _mirror(flip, boxes.center.dtype) * scale
    yaw = -boxes.yaw if flip else boxes.yaw
    return replace(
        boxes, center=boxes.center * mirror, size=boxes.size * scale, yaw=yaw, velocity=boxes.velocity * mirror[:2]
    )


@dataclass(frozen=True)
class SampleStream:
    """An endless, keyed stream: sample i of a run is the same whatever the number of processes that draw it."""

    recording: Recording
    grid: BevGrid
    augment: AugmentConfig
    seed: int
    road: RoadConfig = RoadConfig()

    def draw(self, number: int) -> Sample:
        """Sample of that number: a scenario, a frame with what the road asks for before it, and an ego, all uniform."""
        rng = keyed_generator("sample", self.seed, number)
        scenarios = self.recording.scenarios
        scenario = scenarios[int(rng.integers(len(scenarios)))]
        index = int(rng.integers(self.recording.length(scenario)))
        back = 1 + max(self.road.past, self.road.said + (self.road.late_frames if self.road.late_share else 0))
        moments = [self.recording.snapshot(scenario, i) for i in range(max(0, index - back), index + 1)]
        ego = int(rng.integers(len(moments[-1].frames)))
        return make_sample(moments, ego, self.grid, self.augment, (self.seed, number), self.road)


def epoch_length(recording: Recording) -> int:
    """Judged frames of a recording: one epoch."""
    return sum(1 for _ in judged_frames(recording))
