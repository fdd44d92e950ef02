# SPDX-License-Identifier: Apache-2.0
"""Odometry drifts as a random walk of an agent's motion; nothing else of a recording changes."""

import math
from dataclasses import replace

import pytest
import torch

from manyeyes.datasets.odometry_drift import DriftingOdometry, OdometryDrift
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Snapshot, Transform

CLOUD = PointCloud.of(torch.ones(2, 3))


def snapshot(index, agents=(3, 8), x=None, dt_ns=100_000_000):
    """Agents turn on the spot of a circle at 10 m/s, or stand at x."""
    frames = []
    for a in agents:
        angle = 0.05 * index + a
        pose = Transform.from_xyz_yaw(20 * math.cos(angle), 20 * math.sin(angle), 0.0, angle + math.pi / 2)
        frames.append(AgentFrame.of(CLOUD, pose if x is None else Transform.from_xyz_yaw(x, 0), a, index * dt_ns))
    return Snapshot("town", index, tuple(frames))


def play(drift, indices, **options):
    odometry = DriftingOdometry(drift)
    return [odometry.apply(snapshot(k, **options)) for k in indices]


def motion_error(then, now, row=0):
    """x, y, yaw of the measured motion between two frames after the true one."""
    true = then.frames[row].world_from_agent.inverse() @ now.frames[row].world_from_agent
    error = true.inverse() @ now.frames[row].now_from_earlier(then.frames[row]).inverse()
    return torch.tensor([*error.translation[:2].tolist(), float(error.yaw)])


def test_the_error_of_one_step_is_the_drawn_one():
    drift = OdometryDrift(0.1, 0.01, seed=2)
    first, second = play(drift, range(2))
    drawn = drift.error("town", 3, 100_000_000, 0.1)
    expected = [*drawn.translation[:2].tolist(), float(drawn.yaw)]
    assert motion_error(first, second).tolist() == pytest.approx(expected, abs=1e-8)
    assert max(map(abs, expected)) > 1e-3
    assert first.frames[0].odometry is not None and torch.equal(first.frames[0].points.xyz, CLOUD.xyz)
    assert torch.equal(second.frames[0].world_from_agent.matrix(), snapshot(1).frames[0].world_from_agent.matrix())


def test_the_variance_of_the_drift_grows_linearly_with_time():
    drift = OdometryDrift(0.02, math.radians(0.02))
    for steps in (1, 9):
        runs = [play(replace(drift, seed=s), range(steps + 1), agents=(3,), x=0.0) for s in range(150)]
        errors = torch.stack([motion_error(run[0], run[-1]) for run in runs])
        scale = math.sqrt(0.1 * steps)
        expected = [0.02 * scale, 0.02 * scale, math.radians(0.02) * scale]
        assert errors.std(0).tolist() == pytest.approx(expected, rel=0.2)


def test_the_error_of_a_motion_does_not_depend_on_where_a_replay_begins_or_on_other_agents():
    drift = OdometryDrift(0.1, 0.01)
    whole, late = play(drift, range(8)), play(drift, range(4, 8), agents=(8,))
    expected = motion_error(whole[5], whole[7], row=1)
    assert motion_error(late[1], late[3]).tolist() == pytest.approx(expected.tolist(), abs=1e-8)


def test_time_that_runs_back_begins_at_the_true_odometry():
    first, again = play(OdometryDrift(0.5, 0.1), (5, 0))
    for step in (first, again):
        assert torch.equal(step.frames[0].odometry.matrix(), step.frames[0].world_from_agent.matrix())


def test_noise_of_prior_poses_leaves_the_drifting_odometry():
    (_, drifted) = play(OdometryDrift(0.1, 0.01), range(2))
    noisy = PoseNoise("all_agents", 1.0, 0.1).apply(drifted, 0)
    assert all(a.odometry is b.odometry for a, b in zip(noisy.frames, drifted.frames))


def test_without_size_odometry_is_true_and_negative_sizes_are_refused():
    first, second = play(OdometryDrift(0.0, 0.0), range(2))
    assert motion_error(first, second).tolist() == pytest.approx([0, 0, 0], abs=1e-12)
    with pytest.raises(ConfigError, match="-1"):
        OdometryDrift(-1.0)
