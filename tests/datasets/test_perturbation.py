# SPDX-License-Identifier: Apache-2.0
import math
import multiprocessing
from dataclasses import replace

import pytest
import torch

from manyeyes.datasets.perturbation import FrameDelay, PoseNoise, opencood_offset
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform


def snapshot(index=0, agents=(7, -1, 30), scenario="town", speed=5.0):
    poses = [Transform.from_xyz_yaw(10.0 * k + speed * index, 3.0 * k, 0.5, 0.4 * k) for k in range(len(agents))]
    cloud = PointCloud.of(torch.ones(3, 3))
    frames = [AgentFrame.of(cloud, pose, a, 100_000_000 * index) for pose, a in zip(poses, agents, strict=True)]
    box = Boxes.of(torch.tensor([[20.0 + index, 5, 1]]).double(), torch.ones(1, 3).double(), torch.zeros(1).double())
    truth = GroundTruth(box, torch.ones(len(agents), 1).bool(), Transform.stack(poses))
    return Snapshot(scenario, index, tuple(frames), truth)


def moved(before, after):
    """(agents, 4): x, y, z, yaw by which prior poses changed."""
    rows = []
    for a, b in zip(before.frames, after.frames, strict=True):
        shift = b.world_from_agent.translation - a.world_from_agent.translation
        rows.append(torch.cat((shift, (b.world_from_agent.yaw - a.world_from_agent.yaw)[None])))
    return torch.stack(rows)


@pytest.mark.parametrize(
    ("seed", "xyz", "yaw"), [(20, (0.1768, 0.0392, 0.0715), -0.217), (25, (0.0457, 0.2054, -0.1679), -0.191)]
)
def test_legacy_draw_gives_the_published_codes_numbers(seed, xyz, yaw):
    assert opencood_offset(seed, 0.2, 0.2) == pytest.approx((*xyz, yaw), abs=5e-4)
    assert opencood_offset(seed, 0.8, 0.8) == pytest.approx([4 * v for v in opencood_offset(seed, 0.2, 0.2)])
    assert opencood_offset(seed, 0.2, 0.2) == opencood_offset(seed, 0.2, 0.2)


def test_legacy_noise_is_one_offset_for_all_collaborators_and_frames_in_our_axes():
    noise = PoseNoise("legacy_constant", 0.2, math.radians(0.2), seed=25)
    expected = [0.0457, -0.2054, -0.1679, math.radians(0.191)]  # y and yaw change sign with the hand of the axes
    for index in (0, 3):
        got = moved(snapshot(index), noise.apply(snapshot(index), ego=1))
        assert got[1].tolist() == [0, 0, 0, 0]
        for row in (0, 2):
            assert got[row].tolist() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("mode", ["collaborators", "all_agents"])
@pytest.mark.parametrize("in_time", ["autoregressive", "constant", "independent"])
def test_noise_displaces_the_configured_agents_in_each_frame(mode, in_time):
    noise = PoseNoise(mode, 0.4, 0.01, seed=1, in_time=in_time)
    first, second = (moved(snapshot(f), noise.apply(snapshot(f), ego=0)) for f in (0, 1))
    assert bool((first[0] == 0).all()) == (mode == "collaborators")
    assert (first[1:, [0, 1, 3]] != 0).all() and (first[:, 2] == 0).all()
    assert not torch.allclose(first[1], first[2])
    assert torch.allclose(first[1:], second[1:], atol=1e-12) == (in_time == "constant")


def test_the_same_unit_draw_at_every_level_and_in_both_modes():
    before = snapshot()
    low, high = (moved(before, PoseNoise("collaborators", s, s / 50, 3).apply(before, 0)) for s in (0.2, 0.8))
    torch.testing.assert_close(4 * low, high, atol=1e-12, rtol=0)
    everyone = moved(before, PoseNoise("all_agents", 0.2, 0.2 / 50, 3).apply(before, 0))
    torch.testing.assert_close(everyone[1:], low[1:])
    yaw_only = moved(before, PoseNoise("collaborators", 0.0, 0.004, 3).apply(before, 0))
    assert (yaw_only[:, :3] == 0).all() and torch.allclose(yaw_only[:, 3], low[:, 3], atol=1e-12)


def one(key):
    scenario, index, agent = key
    return PoseNoise("collaborators", 0.3, 0.01, 5).offset(scenario, index, agent, 100_000_000 * index).tolist()


def test_noise_depends_on_the_key_alone():
    keys = [(s, f, a) for s in ("a", "b") for f in range(3) for a in (7, -1, 30)]
    here = [one(k) for k in keys]
    assert len({tuple(v) for v in here}) == len(keys)
    assert [one(k) for k in keys[::-1]] == here[::-1]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(one, keys) == here
    noise = PoseNoise("collaborators", 0.3, 0.01, 5)
    forward = moved(snapshot(), noise.apply(snapshot(), 0))
    turned = replace(snapshot(), frames=snapshot().frames[::-1])
    assert torch.equal(moved(turned, noise.apply(turned, 2)), forward.flip(0))
    assert not torch.allclose(moved(snapshot(), replace(noise, seed=6).apply(snapshot(), 0))[1:], forward[1:])


def test_only_the_reported_pose_changes():
    before = snapshot()
    after = PoseNoise("all_agents", 0.4, 0.02, claim="true").apply(before, 0)
    assert after.truth is before.truth and after.index == before.index
    for a, b in zip(before.frames, after.frames, strict=True):
        assert b.points is a.points and b.timestamp_ns == a.timestamp_ns and b.agent_id == a.agent_id
        assert torch.allclose(b.pose_covariance, torch.tensor([0.16, 0.16, 0.0004], dtype=torch.float64).diag())
        assert torch.allclose(
            b.world_from_agent.rotation.mT @ b.world_from_agent.rotation, torch.eye(3).double(), atol=1e-12
        )
    twice = PoseNoise("all_agents", 0.3, 0.0, claim="true").apply(after, 0)
    assert twice.frames[0].pose_covariance[0, 0].item() == pytest.approx(0.25)
    nothing = PoseNoise("collaborators").apply(before, 0)
    assert (moved(before, nothing) == 0).all() and (nothing.frames[1].pose_covariance == 0).all()


def test_yaw_turns_about_the_worlds_vertical_even_for_a_pitched_agent():
    angle = torch.tensor([0.05, -0.2, 1.0], dtype=torch.float64)
    pitched = Transform.from_rpy(torch.zeros(3, dtype=torch.float64), *angle)
    before = snapshot()
    before = replace(before, frames=(before.frames[0], replace(before.frames[1], world_from_agent=pitched)))
    noise = PoseNoise("collaborators", 0.0, 0.1)
    got = noise.apply(before, 0).frames[1].world_from_agent
    expected = Transform.from_rpy(
        torch.zeros(3, dtype=torch.float64), angle[0], angle[1], angle[2] + noise.offset("town", 0, -1, 0)[3]
    )
    torch.testing.assert_close(got.rotation, expected.rotation)


def errors_in_time(noise, agent=1, frames=2000, scenario="s"):
    """(frames, 4) at 10 Hz."""
    return torch.stack([noise.offset(scenario, f, agent, 100_000_000 * f) for f in range(frames)])


@pytest.mark.parametrize("in_time", ["autoregressive", "constant", "independent"])
def test_the_variance_is_that_of_sigma_however_errors_go_on_in_time(in_time):
    noise = PoseNoise("collaborators", 0.5, 0.1, in_time=in_time)
    draws = torch.stack([noise.offset("s", 3, agent, 300_000_000) for agent in range(1500)])
    assert draws.mean(0).abs().max() < 0.05
    assert draws.std(0).tolist() == pytest.approx([0.5, 0.5, 0.0, 0.1], rel=0.06)


def test_independent_errors_of_one_agent_have_the_moments_of_many():
    draws = errors_in_time(PoseNoise("collaborators", 0.5, 0.1, in_time="independent"))
    assert draws.std(0).tolist() == pytest.approx([0.5, 0.5, 0.0, 0.1], rel=0.08)
    assert abs(float((draws[1:, 0] * draws[:-1, 0]).mean() / draws[:, 0].var())) < 0.06


def test_errors_of_an_agent_depend_neither_on_who_else_is_there_nor_on_the_order_of_frames():
    noise = PoseNoise("all_agents", 0.5, 0.1, seed=3)
    full = [moved(snapshot(k), noise.apply(snapshot(k), 0)) for k in range(4)]
    for k in (3, 1):
        few = snapshot(k, agents=(7, -1))
        assert torch.equal(moved(few, noise.apply(few, 1)), full[k][:2])


def test_a_short_correlation_time_is_independent_and_a_long_one_constant():
    short, long = (
        errors_in_time(PoseNoise("collaborators", 1.0, 0.0, correlation_time_s=t), frames=400)[:, 0]
        for t in (0.01, 1e6)
    )
    assert abs(float((short[1:] * short[:-1]).mean())) < 0.15 and float((long - long[0]).abs().max()) < 0.05


@pytest.mark.parametrize(("claim", "sigma_m"), [("none", 0.0), ("half", 0.2), ("true", 0.4), ("double", 0.8)])
def test_the_claimed_covariance_is_no_part_of_the_noise(claim, sigma_m):
    before = snapshot()
    noise = PoseNoise("collaborators", 0.4, 0.02, claim=claim)
    after = noise.apply(before, 0)
    claimed = after.frames[1].pose_covariance.diagonal().sqrt().tolist()
    assert claimed == pytest.approx([sigma_m, sigma_m, sigma_m / 20]) and claim in noise.description
    assert torch.equal(moved(before, after), moved(before, replace(noise, claim="true").apply(before, 0)))
    assert float(after.frames[0].pose_covariance.sum()) == 0, "an agent with a true pose claims no error"


def test_unknown_modes_and_negative_sigmas_are_refused():
    with pytest.raises(ConfigError, match="collaborators, all_agents, legacy_constant"):
        PoseNoise("iid")  # pyright: ignore
    with pytest.raises(ConfigError, match="none, half, true, double"):
        PoseNoise(claim="some")  # pyright: ignore
    with pytest.raises(ConfigError, match="above 0; got 0"):
        PoseNoise(correlation_time_s=0.0)
    with pytest.raises(ConfigError, match="-1"):
        PoseNoise(sigma_xy_m=-1)
    with pytest.raises(ConfigError, match="at least 0"):
        FrameDelay(-1)


def test_staleness_takes_collaborators_from_earlier_and_leaves_ego_and_truth():
    drive = [snapshot(k) for k in range(5)]
    got = FrameDelay(2).apply(drive[4], 1, drive[:4])
    assert got.frames[1] is drive[4].frames[1] and got.truth is drive[4].truth and got.index == 4
    assert got.frames[0] is drive[2].frames[0] and got.frames[2] is drive[2].frames[2]
    assert FrameDelay(0).apply(drive[4], 1, drive[:4]).frames == drive[4].frames


def test_staleness_is_clipped_at_the_start_of_the_scenario_and_of_an_agents_presence():
    drive = [snapshot(k) for k in range(3)]
    assert FrameDelay(9).apply(drive[2], 0, drive[:2]).frames[1] is drive[0].frames[1]
    assert FrameDelay(9).apply(drive[0], 0, []).frames == drive[0].frames
    late = [replace(drive[0], frames=drive[0].frames[:2]), drive[1]]
    got = FrameDelay(2).apply(drive[2], 0, late)
    assert got.frames[1] is drive[0].frames[1] and got.frames[2] is drive[1].frames[2]


def test_an_outdated_pose_is_exact_for_stationary_objects():
    """A wall seen by the collaborator two frames ago is where it is, in the ego's current frame: both poses count."""
    wall = torch.tensor([[40.0, 8.0, 1.0]], dtype=torch.float64)
    drive = [snapshot(k) for k in range(3)]
    drive = [
        replace(
            s,
            frames=tuple(replace(f, points=PointCloud.of(f.world_from_agent.inverse().apply(wall))) for f in s.frames),
        )
        for s in drive
    ]
    got = FrameDelay(2).apply(drive[2], 0, drive[:2])
    ego, other = got.frames[0], got.frames[1]
    assert other.timestamp_ns == 0 and ego.timestamp_ns == 200_000_000
    placed = (ego.world_from_agent.inverse() @ other.world_from_agent).apply(other.points.xyz)
    torch.testing.assert_close(placed, ego.points.xyz, atol=1e-5, rtol=0)
    current = (ego.world_from_agent.inverse() @ drive[2].frames[1].world_from_agent).apply(other.points.xyz)
    assert (current - ego.points.xyz).norm() > 5


def test_a_stale_message_carries_the_noisy_pose_of_its_own_instant():
    noise = PoseNoise("collaborators", 0.5, 0.01)
    drive = [noise.apply(snapshot(k), 0) for k in range(3)]
    got = FrameDelay(1).apply(drive[2], 0, drive[:2])
    shift = got.frames[1].world_from_agent.translation - snapshot(1).frames[1].world_from_agent.translation
    assert torch.allclose(shift, noise.offset("town", 1, -1, 100_000_000)[:3])
