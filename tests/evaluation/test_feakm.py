# SPDX-License-Identifier: Apache-2.0
"""FeaKM evaluated: the ablation fuses what agents fuse, and correctors are evaluated on the same keypoints and claims."""

from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.comms.inbox import Inbox
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.pose.feakm_ablation import FeakmVariant, _CachedViews, run_ablation
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FeakmConfig, FeakmNet
from manyeyes.models.pose.matcher import MatcherConfig
from manyeyes.pose.feakm import FeakmCorrector, RansacConfig, solve_with_ransac

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

    def eval_indices(self, scenario):
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
        return Snapshot(scenario, index, frames, GroundTruth(boxes, torch.ones(2, 1, dtype=torch.bool), poses))


def make_variant(name="a", min_pairs=99) -> FeakmVariant:
    torch.manual_seed(0)
    detector = Detector(replace(COSTR_TINY, prune_threshold=0.0)).eval().requires_grad_(False)
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(CHANNELS, 8, 8, min_score=0.0), MatcherConfig(8, 8, 1, 1)))
    return FeakmVariant(
        name, detector, FeakmCorrector(net.eval(), partial(solve_with_ransac, config=RansacConfig(min_pairs)))
    )


def test_without_an_estimate_the_ablation_fuses_at_the_prior():
    one, snapshots = make_variant(), [Street().snapshot("street", i) for i in (0, 1)]
    noise = PoseNoise("all_agents", 1.0, 0.02)
    perturbed = [noise.apply(s, 0) for s in snapshots]
    perturbed[0] = replace(perturbed[0], frames=snapshots[0].frames)
    boxes, is_found = _CachedViews(one, snapshots).fuse_with_poses(perturbed[1].frames)
    ego, other = (Agent(one.detector, token_encoding="float32", budget_bytes=None) for _ in range(2))
    for snapshot in perturbed:
        # Odometry is not disturbed, so that what an agent saw before lies where it was.
        inbox = Inbox(one.detector.fingerprint)
        ego.share(snapshot.frames[0])
        packets = other.share(snapshot.frames[1])
        # The ablation knows one instant of the others.
        for packet in packets if snapshot is perturbed[-1] else ():
            inbox.push(packet)
        expected = ego.perceive(snapshot.frames[0], inbox).boxes
    assert is_found == [False] and len(boxes) == len(expected) > 0
    # The surest: what came as bytes is rounded, and among the many that an untrained net ranks alike two may change places.
    torch.testing.assert_close(boxes.center[:40], expected.center[:40], atol=1e-2, rtol=1e-3)
    clean, _ = _CachedViews(one, snapshots).fuse_with_poses(snapshots[1].frames)
    assert float((clean.center[:40] - boxes.center[:40]).abs().max()) > 1e-2


def test_a_row_for_each_variant_and_level():
    reported = []
    rows = run_ablation(
        Street(), [make_variant("a"), make_variant("b")], (0.0, 0.8), report=lambda *at: reported.append(at)
    )
    assert [(r.variant, r.sigma) for r in rows] == [("a", 0.0), ("a", 0.8), ("b", 0.0), ("b", 0.8)]
    assert all(
        r.num_frames == 2 and r.num_collaborators == 2 and r.found_fraction == 0.0 and len(r.ap) == 2 for r in rows
    )
    assert rows[0].ap == rows[2].ap and rows[1].ap == rows[3].ap
    assert reported == [("street", 1), ("street", 2)]
    assert len(run_ablation(Street(), [make_variant()], (0.0,), frame_stride=2)) == 1
    with pytest.raises(ConfigError, match="names of their own"):
        run_ablation(Street(), [make_variant("a"), make_variant("a")], (0.0,))


def test_a_net_of_another_detector_is_refused():
    one = make_variant()
    net = FeakmNet(replace(one.corrector.net.config, detector="00" * 8))
    FeakmVariant("a", one.detector, FeakmCorrector(net, solve_with_ransac))
    net = FeakmNet(replace(one.corrector.net.config, detector="ab" * 8))
    with pytest.raises(ConfigError, match="trained on views of the weights abab"):
        FeakmVariant("a", one.detector, FeakmCorrector(net, solve_with_ransac))
