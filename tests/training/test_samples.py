# SPDX-License-Identifier: Apache-2.0
"""A sample is one scene in several frames: points, poses and boxes agree before and after every augmentation."""

import dataclasses

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, Transform
from manyeyes.training.samples import AugmentConfig, Sample, SampleStream, epoch_length, make_sample

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 5.0)
TURN = AugmentConfig(turn_rad=0.8, scale=0.0, flip=False, thin=0.0, early_share=0.0)
AUGMENTS = {
    "none": AugmentConfig.none(),
    "turn": TURN,
    "scale": AugmentConfig(0.0, 0.2, False, 0.0, 0.0),
    "flip": AugmentConfig(0.0, 0.0, True, 0.0, 0.0),
    "all": AugmentConfig(0.8, 0.1, True, 0.0, 0.0),
}


def inside(boxes: Boxes, points: torch.Tensor) -> torch.Tensor:
    return boxes.contains(points.to(boxes.center.dtype), 0.005).sum(1)


def sample(recording, config: AugmentConfig, number: int = 0, ego: int = 0) -> Sample:
    return make_sample(recording.snapshot("toy_0", 0), ego, GRID, config, ("test", number))


@pytest.mark.parametrize("name", AUGMENTS)
def test_every_box_still_holds_its_points(toy, name):
    for number in range(6):
        some = sample(toy(), AUGMENTS[name], number)
        for cloud, seen in zip(some.clouds, some.seen):
            assert inside(seen, cloud.xyz).tolist() == [60] * 6, (name, number)
        assert inside(some.union, some.clouds[0].xyz).tolist() == [60] * 6


@pytest.mark.parametrize("name", AUGMENTS)
def test_what_others_saw_lands_in_the_boxes_of_the_union(toy, name):
    for number in range(6):
        some = sample(toy(), AUGMENTS[name], number)
        for cloud, motion in zip(some.clouds, some.ego_from_agent):
            assert inside(some.union, motion.apply(cloud.xyz.double())).tolist() == [60] * 6


def test_a_pose_that_was_not_mirrored_is_caught(toy):
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    some = sample(toy(), dataclasses.replace(AUGMENTS["flip"], max_agents=99), 0)
    assert len(some.clouds) == 3
    for cloud, motion in zip(some.clouds[1:], some.ego_from_agent[1:]):
        wrong = Transform(mirror @ motion.rotation @ mirror, mirror @ motion.translation)
        hits = [int(inside(some.union, m.apply(cloud.xyz.double())).sum()) for m in (motion, wrong)]
        assert hits[0] == 360 and hits[1] < 120


def test_motions_stay_rigid_and_the_ego_is_first(toy):
    for number in range(8):
        some = sample(toy(), AUGMENTS["all"], number, ego=2)
        assert torch.allclose(some.ego_from_agent[0].matrix(), torch.eye(4).double(), atol=1e-9)
        for motion in some.ego_from_agent:
            eye = motion.rotation @ motion.rotation.mT
            assert torch.allclose(eye, torch.eye(3).double(), atol=1e-9) and float(torch.det(motion.rotation)) > 0


def test_turning_changes_relative_headings_and_scale_changes_sizes(toy):
    plain, turned = (sample(toy(), AUGMENTS[n], 3) for n in ("none", "turn"))
    yaw = [float(s.ego_from_agent[-1].yaw) for s in (plain, turned)]
    assert len(turned.clouds) > 1 and abs(yaw[0] - yaw[1]) > 0.01
    assert torch.allclose(plain.union.size, turned.union.size)
    larger = sample(toy(), AUGMENTS["scale"], 3)
    ratio = larger.union.size / plain.union.size
    assert torch.allclose(ratio, ratio[0, 0].expand_as(ratio)) and abs(float(ratio[0, 0]) - 1) > 0.01


def test_mirroring_happens_half_of_the_time(toy):
    plain = sample(toy(), AUGMENTS["none"])
    flips = 0
    for number in range(40):
        cloud = sample(toy(), AUGMENTS["flip"], number).clouds[0].xyz
        same, mirrored = (torch.equal(cloud, plain.clouds[0].xyz * torch.tensor([1.0, s, 1.0])) for s in (1.0, -1.0))
        assert same != mirrored
        flips += mirrored
    assert 10 <= flips <= 30


def test_thinning_drops_points_and_never_boxes(toy):
    counts = [len(sample(toy(), AugmentConfig(0, 0, False, 0.3, 0.0), n).clouds[0]) for n in range(10)]
    assert max(counts) <= 660 and min(counts) < 640 and min(counts) > 400 and len(set(counts)) > 5


def test_early_fusion_merges_the_clouds_in_the_ego_frame(toy):
    early = sample(toy(), dataclasses.replace(TURN, early_share=1.0, max_agents=99), 1)
    assert len(early.clouds) == len(early.seen) == len(early.ego_from_agent) == 1
    assert len(early.clouds[0]) == 3 * 660
    assert inside(early.seen[0], early.clouds[0].xyz).tolist() == [180] * 6


def test_boxes_beyond_the_range_and_the_ego_itself_are_not_asked_for(toy):
    small = BevGrid(-8.0, -8.0, -3.0, 8.0, 8.0, 5.0)
    snapshot = toy().snapshot("toy_0", 0)
    some = make_sample(snapshot, 0, small, AugmentConfig.none(), ("test", 0))
    assert len(some.union) < 6 and bool((some.union.center[:, :2].abs() < 8).all())
    ids = snapshot.truth.boxes.id.clone()
    ids[2] = 0
    truth = dataclasses.replace(snapshot.truth, boxes=dataclasses.replace(snapshot.truth.boxes, id=ids))
    mine = make_sample(dataclasses.replace(snapshot, truth=truth), 0, GRID, AugmentConfig.none(), ("test", 0))
    assert 0 not in mine.union.id and len(mine.union) == 5 and [len(s) for s in mine.seen] == [5, 6, 6]


def test_the_union_is_what_any_chosen_agent_lists(toy):
    snapshot = toy().snapshot("toy_0", 0)
    seen = torch.zeros(3, 6, dtype=torch.bool)
    seen[0, :2], seen[1, 1:4], seen[2, 5] = True, True, True
    snapshot = dataclasses.replace(snapshot, truth=dataclasses.replace(snapshot.truth, seen=seen))
    some = make_sample(snapshot, 0, GRID, AugmentConfig.none(), ("test", 0))
    assert sorted(some.union.id.tolist()) == [100, 101, 102, 103, 105]
    alone = make_sample(snapshot, 1, GRID, dataclasses.replace(TURN, max_agents=1), ("test", 0))
    assert sorted(alone.union.id.tolist()) == [101, 102, 103] and len(alone.clouds) == 1


def test_a_snapshot_without_truth_is_refused(toy):
    blind = dataclasses.replace(toy().snapshot("toy_0", 1), truth=None)
    with pytest.raises(ConfigError, match="toy_0, frame 1 has no truth"):
        make_sample(blind, 0, GRID, TURN, ("test", 0))


def test_the_stream_is_a_function_of_the_number_alone(toy):
    stream = SampleStream(toy(), GRID, AugmentConfig(), seed=5)
    again = SampleStream(toy(), GRID, AugmentConfig(), seed=5)
    other = SampleStream(toy(), GRID, AugmentConfig(), seed=6)
    drawn = [stream.draw(n).clouds[0].xyz for n in range(5)]
    assert torch.equal(again.draw(3).clouds[0].xyz, drawn[3])
    assert not any(torch.equal(a, b) for i, a in enumerate(drawn) for b in drawn[:i])
    assert not torch.equal(other.draw(3).clouds[0].xyz, drawn[3])


def test_an_epoch_is_the_judged_frames(toy):
    assert epoch_length(toy(frames=3)) == 6


def test_claimed_poses_are_what_the_network_trains_with(toy):
    # A displaced claim moves the tokens, never the truth.
    snapshot = toy().snapshot("toy_0", 0)
    off = Transform.from_xyz_yaw(1.5, 0.0)
    frames = tuple(
        dataclasses.replace(f, world_from_agent=off @ f.world_from_agent) if i else f
        for i, f in enumerate(snapshot.frames)
    )
    right = make_sample(snapshot, 0, GRID, AugmentConfig.none(), ("test", 0))
    wrong = make_sample(dataclasses.replace(snapshot, frames=frames), 0, GRID, AugmentConfig.none(), ("test", 0))
    assert torch.equal(wrong.union.center, right.union.center)
    gap = wrong.ego_from_agent[1].translation - right.ego_from_agent[1].translation
    assert float(gap.norm()) == pytest.approx(1.5)
