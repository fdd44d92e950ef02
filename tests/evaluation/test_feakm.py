# SPDX-License-Identifier: Apache-2.0
"""FeaKM judged: the ablation fuses what agents fuse, and correctors are judged on the same keypoints and claims."""

import math
from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.comms.inbox import Inbox
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, PointCloud, Snapshot, Transform, Truth
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose.feakm_ablation import Branch, _Scene, ablation
from manyeyes.evaluation.pose.feakm_pose import described, pose_frames
from manyeyes.evaluation.pose.metrics import ClaimNoise, score
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypoints
from manyeyes.models.pose.feakm import FeakmConfig, FeakmNet
from manyeyes.models.pose.keypoint_net import View
from manyeyes.models.pose.matcher import MatcherConfig
from manyeyes.pose.corrector import correct
from manyeyes.pose.feakm import Feakm, RansacConfig, published
from manyeyes.pose.types import unanswered
from manyeyes.simulator.fleet.landmark_scenes import LandmarkSpec, make_landmark_scene

CHANNELS = COSTR_TINY.encoder.channels[2]


def frame(agent: int, index: int) -> AgentFrame:
    rng = torch.Generator().manual_seed(10 * agent + index)
    xyz = (torch.rand(120, 3, generator=rng) - 0.5) * torch.tensor([50.0, 50.0, 4.0])
    pose = Transform.from_xyz_yaw(12.0 * agent + index, 2.0, 0.0, 0.5 * agent)
    return AgentFrame.of(PointCloud.of(xyz), pose, agent, 100_000_000 * index)


@dataclass(frozen=True)
class Street:
    """Two agents among points that mean nothing, and one true box."""

    scenarios: tuple[str, ...] = ("street",)

    def length(self, scenario):
        return 3

    def judged(self, scenario):
        return range(1, 3)

    def agents(self, scenario):
        return (1, 2)

    def snapshot(self, scenario, index):
        frames = tuple(frame(agent, index) for agent in (1, 2))
        boxes = Boxes.of(
            torch.tensor([[20.0, 5.0, 0.8]]).double(),
            torch.tensor([[4.5, 1.9, 1.6]]).double(),
            torch.zeros(1).double(),
            id=torch.tensor([9]),
        )
        poses = Transform.stack([f.world_from_agent for f in frames])
        return Snapshot(scenario, index, frames, Truth(boxes, torch.ones(2, 1, dtype=torch.bool), poses))


def branch(name="a", least=99) -> Branch:
    torch.manual_seed(0)
    detector = Detector(replace(COSTR_TINY, prune_threshold=0.0)).eval().requires_grad_(False)
    net = FeakmNet(FeakmConfig(BoxKeypoints(CHANNELS, 8, 8, score_min=0.0), MatcherConfig(8, 8, 1, 1)))
    return Branch(name, detector, Feakm(net.eval(), partial(published, config=RansacConfig(least))))


def test_where_no_pose_is_found_the_ablation_fuses_what_agents_fuse():
    one, snapshots = branch(), [Street().snapshot("street", i) for i in (0, 1)]
    noise = PoseNoise("all_agents_iid", 1.0, 0.02)
    told = [noise.apply(s, 0) for s in snapshots]
    told[0] = replace(told[0], frames=snapshots[0].frames)
    boxes, answers = _Scene(one, snapshots).perceive(told[1].frames)
    ego, other = (Agent(one.detector, precision="float32", budget_bytes=None) for _ in range(2))
    for snapshot in told:
        # Odometry is not disturbed, so that what an agent saw before lies where it was.
        inbox = Inbox(one.detector.fingerprint)
        ego.share(snapshot.frames[0])
        packets = other.share(snapshot.frames[1])
        # The ablation knows one instant of the others.
        for packet in packets if snapshot is told[-1] else ():
            inbox.push(packet)
        heard = ego.perceive(snapshot.frames[0], inbox).boxes
    assert answers == [False] and len(boxes) == len(heard) > 0
    # The surest: what came as bytes is rounded, and among the many that an untrained net ranks alike two may change places.
    torch.testing.assert_close(boxes.center[:40], heard.center[:40], atol=1e-2, rtol=1e-3)
    clean, _ = _Scene(one, snapshots).perceive(snapshots[1].frames)
    assert float((clean.center[:40] - boxes.center[:40]).abs().max()) > 1e-2


def test_a_row_for_each_branch_and_level():
    heard = []
    rows = ablation(Street(), [branch("a"), branch("b")], (0.0, 0.8), report=lambda *at: heard.append(at))
    assert [(r.branch, r.sigma) for r in rows] == [("a", 0.0), ("a", 0.8), ("b", 0.0), ("b", 0.8)]
    assert all(r.frames == 2 and r.asked == 2 and r.answered == 0.0 and len(r.ap) == 2 for r in rows)
    assert rows[0].ap == rows[2].ap and rows[1].ap == rows[3].ap
    assert heard == [("street", 1), ("street", 2)]
    assert len(ablation(Street(), [branch()], (0.0,), every=2)) == 1
    with pytest.raises(ConfigError, match="names of their own"):
        ablation(Street(), [branch("a"), branch("a")], (0.0,))


def test_a_net_of_another_detector_is_refused():
    one = branch()
    net = FeakmNet(replace(one.corrector.net.config, detector="00" * 8))
    Branch("a", one.detector, Feakm(net, published))
    net = FeakmNet(replace(one.corrector.net.config, detector="ab" * 8))
    with pytest.raises(ConfigError, match="taught on views of the weights abab"):
        Branch("a", one.detector, Feakm(net, published))


def test_correctors_are_judged_on_the_same_pairs_and_claims():
    pairs = []
    for scene in range(4):
        made = make_landmark_scene(LandmarkSpec(8, 6, 6), 5, scene)
        x, y, yaw = made.ego_from_other.tolist()
        points = [Keypoints(boxes, torch.zeros(len(boxes), 1)) for boxes in (made.ego[0], made.other[0])]
        pairs.append((*points, Transform.from_xyz_yaw(x, y, 0.0, yaw)))
    finders = {"vote": correct, "claim": lambda ego, other, claimed: unanswered(claimed)}
    found = pose_frames(pairs, finders, ClaimNoise("gaussian", 1.0, 1.0))
    assert all(len(frames) == 4 for frames in found.values())
    assert [f.common for f in found["vote"]] == [f.common for f in found["claim"]] and found["vote"][0].common >= 6
    assert score(found["vote"]).success[0] == 1.0 and score(found["claim"]).success[0] == 0.0
    assert 0.2 < found["claim"][0].metres < 5
    nothing = pose_frames([(pairs[0][0][:0], pairs[0][1], pairs[0][2])], finders, ClaimNoise("none"))
    assert nothing["vote"][0].common == 0 and math.isinf(nothing["claim"][0].metres)


def test_views_are_described_in_pairs():
    one, snapshot = branch(), Street().snapshot("street", 1)
    eyes = [Agent(one.detector).eyes.see(f) for f in snapshot.frames]
    views = [View.of(sight.told, sight.boxes) for sight in eyes]
    truth = snapshot.frames[0].world_from_agent.inverse() @ snapshot.frames[1].world_from_agent
    ((ego, other, same),) = described(one.corrector.net, [(views[0], views[1], truth)])
    assert torch.equal(ego.descriptor, one.corrector.net.describe([views[0]])[0].descriptor)
    assert same is truth and len(other) <= 64 and not ego.descriptor.requires_grad
