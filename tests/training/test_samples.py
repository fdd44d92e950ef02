# SPDX-License-Identifier: Apache-2.0
"""A sample is one scene in several frames: points, poses and boxes agree before and after every augmentation."""

import dataclasses
import math

import pytest
import torch

from manyeyes.agents.level_frame import move_frames
from manyeyes.datatypes import BevGrid, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.training.detector.samples import (
    AgentView,
    AugmentConfig,
    DegradationConfig,
    Sample,
    SampleStream,
    epoch_length,
    make_sample,
)

GRID = BevGrid(-51.2, -51.2, -3.0, 51.2, 51.2, 5.0)
TURN = AugmentConfig(max_yaw_rad=0.8, max_scale_change=0.0, flip=False, max_point_dropout=0.0, early_fusion_prob=0.0)
NONE = AugmentConfig.none()
AUGMENTS = {
    "none": NONE,
    "turn": TURN,
    "scale": AugmentConfig(0.0, 0.2, False, 0.0, 0.0),
    "flip": AugmentConfig(0.0, 0.0, True, 0.0, 0.0),
    "all": AugmentConfig(0.8, 0.1, True, 0.0, 0.0),
}
LATE = DegradationConfig(ego_history=2, delay_prob=1.0, max_delay_frames=3)


def inside(boxes: Boxes, points: torch.Tensor) -> torch.Tensor:
    return boxes.contains(points.to(boxes.center.dtype), 0.005).sum(1)


def sample(recording, config: AugmentConfig, number: int = 0, ego: int = 0) -> Sample:
    return make_sample([recording.snapshot("toy_0", 0)], ego, GRID, config, ("test", number))


def driven(
    recording, config: AugmentConfig = NONE, road: DegradationConfig = LATE, number: int = 0, moments: int = 5
) -> Sample:
    """With a past: the toy's moments up to this many."""
    seen = [recording.snapshot("toy_0", i) for i in range(moments)]
    return make_sample(seen, 0, GRID, config, ("test", number), road)


@pytest.mark.parametrize("name", AUGMENTS)
def test_every_box_still_holds_its_points(toy, name):
    for number in range(6):
        some = sample(toy(), AUGMENTS[name], number)
        for view in some.views:
            assert inside(view.visible_boxes, view.cloud.xyz).tolist() == [60] * 6, (name, number)
        assert inside(some.merged_gt_boxes, some.views[0].cloud.xyz).tolist() == [60] * 6


@pytest.mark.parametrize("name", AUGMENTS)
def test_points_of_others_lie_in_the_merged_boxes(toy, name):
    for number in range(6):
        some = sample(toy(), AUGMENTS[name], number)
        for view in some.views:
            assert inside(some.merged_gt_boxes, view.ego_from_view.apply(view.cloud.xyz.double())).tolist() == [60] * 6


def test_a_pose_that_was_not_mirrored_is_caught(toy):
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    some = sample(toy(), dataclasses.replace(AUGMENTS["flip"], max_agents=99), 0)
    assert len(some.views) == 3
    for view in some.views[1:]:
        motion = view.ego_from_view
        wrong = Transform(mirror @ motion.rotation @ mirror, mirror @ motion.translation)
        hits = [int(inside(some.merged_gt_boxes, m.apply(view.cloud.xyz.double())).sum()) for m in (motion, wrong)]
        assert hits[0] == 360 and hits[1] < 120


def test_motions_stay_rigid_and_the_ego_is_first(toy):
    for number in range(8):
        some = sample(toy(), AUGMENTS["all"], number, ego=2)
        assert torch.allclose(some.views[0].ego_from_view.matrix(), torch.eye(4).double(), atol=1e-9)
        for view in some.views:
            turn = view.ego_from_view.rotation
            assert torch.allclose(turn @ turn.mT, torch.eye(3).double(), atol=1e-9) and float(torch.det(turn)) > 0


def test_rotation_changes_relative_headings_and_scale_changes_sizes(toy):
    plain, turned = (sample(toy(), AUGMENTS[n], 3) for n in ("none", "turn"))
    yaw = [float(s.views[-1].ego_from_view.yaw) for s in (plain, turned)]
    assert len(turned.views) > 1 and abs(yaw[0] - yaw[1]) > 0.01
    assert torch.allclose(plain.merged_gt_boxes.size, turned.merged_gt_boxes.size)
    larger = sample(toy(), AUGMENTS["scale"], 3)
    ratio = larger.merged_gt_boxes.size / plain.merged_gt_boxes.size
    assert torch.allclose(ratio, ratio[0, 0].expand_as(ratio)) and abs(float(ratio[0, 0]) - 1) > 0.01


def test_mirroring_happens_half_of_the_time(toy):
    plain = sample(toy(), NONE).views[0].cloud.xyz
    flips = 0
    for number in range(40):
        cloud = sample(toy(), AUGMENTS["flip"], number).views[0].cloud.xyz
        same, mirrored = (torch.equal(cloud, plain * torch.tensor([1.0, s, 1.0])) for s in (1.0, -1.0))
        assert same != mirrored
        flips += mirrored
    assert 10 <= flips <= 30


def test_thinning_drops_points_and_never_boxes(toy):
    counts = [len(sample(toy(), AugmentConfig(0, 0, False, 0.3, 0.0), n).views[0].cloud) for n in range(10)]
    assert max(counts) <= 660 and min(counts) < 640 and min(counts) > 400 and len(set(counts)) > 5


def test_early_fusion_merges_the_clouds_in_the_ego_frame_now_and_before(toy):
    early = driven(toy(), dataclasses.replace(TURN, early_fusion_prob=1.0, max_agents=99))
    (view,) = early.views
    assert not early.ego_history and len(view.cloud) == len(view.previous_cloud) == 3 * 660
    assert inside(view.visible_boxes, view.cloud.xyz).tolist() == [180] * 6
    # The sweeps of the moment before, moved by each agent's own drive: what moves lies a tenth of a second back.
    assert inside(view.visible_boxes.after(-0.1), view.previous_cloud.xyz).tolist() == [180] * 6


def test_boxes_out_of_range_and_the_ego_itself_are_no_targets(toy):
    small = BevGrid(-8.0, -8.0, -3.0, 8.0, 8.0, 5.0)
    snapshot = toy().snapshot("toy_0", 0)
    some = make_sample([snapshot], 0, small, NONE, ("test", 0))
    assert len(some.merged_gt_boxes) < 6 and bool((some.merged_gt_boxes.center[:, :2].abs() < 8).all())
    ids = snapshot.truth.boxes.id.clone()
    ids[2] = 0
    truth = dataclasses.replace(snapshot.truth, boxes=dataclasses.replace(snapshot.truth.boxes, id=ids))
    mine = make_sample([dataclasses.replace(snapshot, truth=truth)], 0, GRID, NONE, ("test", 0))
    assert 0 not in mine.merged_gt_boxes.id and len(mine.merged_gt_boxes) == 5
    assert sorted(len(view.visible_boxes) for view in mine.views) == [5, 6, 6] and len(mine.views[0].visible_boxes) == 5


def test_the_union_is_what_any_chosen_agent_lists(toy):
    snapshot = toy().snapshot("toy_0", 0)
    seen = torch.zeros(3, 6, dtype=torch.bool)
    seen[0, :2], seen[1, 1:4], seen[2, 5] = True, True, True
    snapshot = dataclasses.replace(snapshot, truth=dataclasses.replace(snapshot.truth, seen=seen))
    some = make_sample([snapshot], 0, GRID, NONE, ("test", 0))
    assert sorted(some.merged_gt_boxes.id.tolist()) == [100, 101, 102, 103, 105]
    alone = make_sample([snapshot], 1, GRID, dataclasses.replace(TURN, max_agents=1), ("test", 0))
    assert sorted(alone.merged_gt_boxes.id.tolist()) == [101, 102, 103] and len(alone.views) == 1


def test_a_snapshot_without_truth_is_refused(toy):
    blind = dataclasses.replace(toy().snapshot("toy_0", 1), truth=None)
    with pytest.raises(ConfigError, match="toy_0, frame 1 has no truth"):
        make_sample([blind], 0, GRID, TURN, ("test", 0))


def test_the_stream_is_a_function_of_the_number_alone(toy):
    stream, again, other = (SampleStream(toy(frames=6), GRID, AugmentConfig(), seed, LATE) for seed in (5, 5, 6))
    drawn = [stream.draw(n) for n in range(5)]
    clouds = [some.views[0].cloud.xyz for some in drawn]
    assert torch.equal(again.draw(3).views[0].cloud.xyz, clouds[3])
    for mine, theirs in zip(again.draw(3).views, drawn[3].views, strict=True):
        assert torch.equal(mine.ego_from_view.matrix(), theirs.ego_from_view.matrix())
        assert (mine.age_s, mine.loss_fraction, mine.max_tokens, mine.sigma_xy_m) == (
            theirs.age_s,
            theirs.loss_fraction,
            theirs.max_tokens,
            theirs.sigma_xy_m,
        )
    assert not any(torch.equal(a, b) for i, a in enumerate(clouds) for b in clouds[:i])
    assert not torch.equal(other.draw(3).views[0].cloud.xyz, clouds[3])


def test_an_epoch_is_all_evaluated_frames(toy):
    assert epoch_length(toy(frames=3)) == 6


def test_training_uses_reported_poses(toy):
    # A displaced claim moves the tokens, never the truth.
    snapshot = toy().snapshot("toy_0", 0)
    off = Transform.from_xyz_yaw(1.5, 0.0)
    frames = tuple(
        dataclasses.replace(f, world_from_agent=off @ f.world_from_agent) if i else f
        for i, f in enumerate(snapshot.frames)
    )
    right = make_sample([snapshot], 0, GRID, NONE, ("test", 0))
    wrong = make_sample([dataclasses.replace(snapshot, frames=frames)], 0, GRID, NONE, ("test", 0))
    assert torch.equal(wrong.merged_gt_boxes.center, right.merged_gt_boxes.center)
    gap = wrong.views[1].ego_from_view.translation - right.views[1].ego_from_view.translation
    assert float(gap.norm()) == pytest.approx(1.5)


# What goes wrong on the road.


@pytest.mark.parametrize("name", AUGMENTS)
def test_delayed_view_equals_the_view_at_that_time(toy, name):
    ages = []
    for number in range(6):
        some = driven(toy(), AUGMENTS[name], number=number)
        assert some.views[0].age_s == 0
        for view in some.views:
            assert inside(view.visible_boxes, view.cloud.xyz).tolist() == [60] * 6
            assert inside(view.visible_boxes.after(-0.1), view.previous_cloud.xyz).tolist() == [60] * 6
        for view in some.views[1:]:
            ages.append(round(view.age_s, 6))
            # Boxes of then, driven on and moved, are those of now: velocities are mirrored and scaled as places are.
            now = view.visible_boxes.after(view.age_s).transform(view.ego_from_view)
            assert torch.allclose(now.center, some.merged_gt_boxes.center, atol=1e-6)
            assert not torch.allclose(
                view.visible_boxes.transform(view.ego_from_view).center,
                some.merged_gt_boxes.center,
                atol=0.1 * view.age_s,
            )
    assert set(ages) == {0.1, 0.2, 0.3}


def test_without_delays_every_view_is_of_now(toy):
    for number in range(4):
        some = driven(toy(), AUGMENTS["none"], dataclasses.replace(LATE, delay_prob=0.0), number=number)
        assert len(some.views) > 1 and {view.age_s for view in some.views} == {0.0}


@pytest.mark.parametrize("name", ("none", "all"))
def test_ego_history_is_newest_first_and_without_pose_noise(toy, name):
    road = dataclasses.replace(LATE, pose_noise_prob=1.0, max_sigma_xy_m=5.0)
    some = driven(toy(), AUGMENTS[name], road)
    assert [round(view.age_s, 6) for view in some.ego_history] == [0.1, 0.2]
    for view in some.ego_history:
        assert inside(view.visible_boxes, view.cloud.xyz).tolist() == [60] * 6
        now = view.visible_boxes.after(view.age_s).transform(view.ego_from_view)
        assert torch.allclose(now.center, some.merged_gt_boxes.center, atol=1e-6)
        assert (view.sigma_xy_m, view.sigma_yaw_rad, view.loss_fraction, view.max_tokens) == (0, 0, 0, None)


def test_history_is_shorter_and_undelayed_at_the_start_of_a_recording(toy):
    for moments, past, earlier in ((1, 0, False), (2, 1, True), (3, 2, True)):
        some = driven(toy(), moments=moments)
        assert len(some.ego_history) == past and (len(some.views[0].previous_cloud) > 0) == earlier
        assert all(view.age_s < 0.1 * moments - 0.05 for view in some.views)
    assert not len(driven(toy(), moments=2).ego_history[0].previous_cloud)


def without(snapshot: Snapshot, row: int) -> Snapshot:
    """The snapshot before an agent came."""
    keep = [i for i in range(len(snapshot.frames)) if i != row]
    truth = snapshot.truth
    assert truth is not None
    left = GroundTruth(truth.boxes, truth.seen[keep], truth.world_from_agent[torch.tensor(keep)])
    return dataclasses.replace(snapshot, frames=tuple(snapshot.frames[i] for i in keep), truth=left)


def test_agent_absent_in_the_past_is_undelayed(toy):
    moments = [without(toy().snapshot("toy_0", i), 1) for i in range(4)] + [toy().snapshot("toy_0", 4)]
    some = make_sample(moments, 0, GRID, NONE, ("test", 0), LATE)
    (fresh,) = (view for view in some.views[1:] if view.age_s == 0)
    assert not len(fresh.previous_cloud) and inside(fresh.visible_boxes, fresh.cloud.xyz).tolist() == [60] * 6
    assert len(some.views) == 3 and any(view.age_s > 0 for view in some.views)


def test_ego_absent_in_the_past_has_no_history(toy):
    moments = [without(toy().snapshot("toy_0", i), 0) for i in range(4)] + [toy().snapshot("toy_0", 4)]
    some = make_sample(moments, 0, GRID, NONE, ("test", 0), LATE)
    assert some.ego_history == () and not len(some.views[0].previous_cloud)


def pose_error(view: AgentView, true: Transform) -> tuple[list[float], float]:
    """How far a claim of now lies from the truth, in the world's axes, and its error in heading."""
    gap = view.ego_from_view.translation - true.translation
    turn = view.ego_from_view.rotation @ true.rotation.mT
    return gap.tolist(), float(torch.atan2(turn[1, 0], turn[0, 0]))


def test_pose_errors_match_their_reported_sigmas(toy):
    recording = toy(cars=1, points_per_car=1, ground_points=1)
    snapshot, road = (
        recording.snapshot("toy_0", 0),
        DegradationConfig(pose_noise_prob=0.75, max_sigma_xy_m=0.8, max_sigma_yaw_rad=0.02),
    )
    ego = snapshot.frames[0].world_from_agent
    true = [ego.inverse() @ frame.world_from_agent for frame in snapshot.frames]
    place, turn, sigmas = [], [], []
    for number in range(200):
        some = make_sample([snapshot], 0, GRID, NONE, ("test", number), road)
        assert some.views[0].sigma_xy_m == some.views[0].sigma_yaw_rad == 0
        spread = {(view.sigma_xy_m, view.sigma_yaw_rad) for view in some.views[1:]}
        assert len(spread) == 1
        sigmas.append(spread.pop())
        for view in some.views[1:]:
            nearest = min(true, key=lambda t: float((t.rotation - view.ego_from_view.rotation).abs().max()))
            gap, angle = pose_error(view, nearest)
            assert abs(gap[2]) < 1e-9
            for errors, error, sigma in ((place, gap[:2], view.sigma_xy_m), (turn, [angle], view.sigma_yaw_rad)):
                if sigma:
                    errors += [e / sigma for e in error]
                else:
                    assert max(map(abs, error)) < 1e-9
    for errors in (place, turn):
        z = torch.tensor(errors)
        assert len(z) > 100 and abs(float(z.mean())) < 0.12 and float(z.std()) == pytest.approx(1, abs=0.08)
    xy, yaw = torch.tensor(sigmas).T
    assert float(xy.max()) <= 0.8 and float(yaw.max()) <= 0.02 and float(xy.max()) > 0.75
    # A quarter claims well; of the others half are off in place, half in heading, and who would be off in neither is in place.
    assert float(((xy == 0) & (yaw == 0)).float().mean()) == pytest.approx(0.25, abs=0.06)
    assert float((xy > 0).float().mean()) == pytest.approx(0.75 * 0.75, abs=0.07)
    assert float((yaw > 0).float().mean()) == pytest.approx(0.75 * 0.5, abs=0.07)


@pytest.mark.slow
def test_frequencies_of_delay_loss_and_budget(toy):
    recording = toy(cars=1, points_per_car=1, ground_points=1)
    moments = [recording.snapshot("toy_0", i) for i in range(5)]
    road = DegradationConfig(
        delay_prob=0.4,
        max_delay_frames=4,
        packet_loss_prob=0.25,
        max_loss_fraction=0.6,
        budget_prob=0.5,
        min_budget_tokens=12,
    )
    views = [
        view for number in range(300) for view in make_sample(moments, 0, GRID, NONE, ("test", number), road).views[1:]
    ]
    late = [view.age_s for view in views if view.age_s]
    lost, few = (
        [view.loss_fraction for view in views if view.loss_fraction],
        [view.max_tokens for view in views if view.max_tokens is not None],
    )
    for got, share in ((late, 0.4), (lost, 0.25), (few, 0.5)):
        assert len(got) / len(views) == pytest.approx(share, abs=0.06)
    assert {round(age, 6) for age in late} == {0.1, 0.2, 0.3, 0.4}
    assert max(lost) < 0.6 and sum(lost) / len(lost) == pytest.approx(0.3, abs=0.04)
    # Uniform in the logarithm between twelve and 1500: as many below the geometric mean as above.
    assert min(few) >= 12 and max(few) < 1500
    below = sum(keep < math.sqrt(12 * 1500) for keep in few) / len(few)
    assert below == pytest.approx(0.5, abs=0.08)


def test_no_degradation_changes_nothing(toy):
    for view in driven(toy(), TURN, DegradationConfig()).views:
        assert (view.age_s, view.sigma_xy_m, view.sigma_yaw_rad, view.loss_fraction, view.max_tokens) == (
            0,
            0,
            0,
            0,
            None,
        )
    assert driven(toy(), TURN, DegradationConfig()).ego_history == ()


def test_a_stream_levels_frames_as_agents_do(toy):
    zero = torch.zeros((), dtype=torch.float64)
    tilt = Transform.from_rpy(torch.zeros(3).double(), zero + 0.04, zero - 0.02, zero)

    class Tilted(toy):
        def snapshot(self, scenario: str, index: int) -> Snapshot:
            rng = torch.Generator().manual_seed(index)
            radius, angle = torch.rand(4000, generator=rng) * 45 + 3, torch.rand(4000, generator=rng) * 6.2832
            ground = PointCloud.of(torch.stack((radius * angle.cos(), radius * angle.sin(), torch.zeros(4000)), 1))
            snapshot = super().snapshot(scenario, index)
            frames = [dataclasses.replace(f, points=PointCloud.cat([f.points, ground])) for f in snapshot.frames]
            return move_frames(dataclasses.replace(snapshot, frames=tuple(frames)), [tilt] * len(frames))

    for view in SampleStream(Tilted(frames=3), GRID, NONE, 1, LATE).draw(2).views:
        assert float(view.cloud.xyz[-4000:, 2].abs().max()) < 0.1
        assert inside(view.visible_boxes, view.cloud.xyz).min() >= 50
