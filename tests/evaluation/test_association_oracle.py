# SPDX-License-Identifier: Apache-2.0
"""The joint oracle: its system is that of poses and stations together; exact lines make poses agree, a wrong drive is let go."""

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.evaluation.maps.association_oracle import (
    AssociatedRows,
    _eliminate_stations,
    _linearize,
    _move,
    estimate_poses_with_true_association,
    fuse_with_true_association,
    make_associated_rows,
)
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.simulator.fleet.config import CROWDS

EXACT = replace(CROWDS["perfect"], pose_sigma_m=0.4, yaw_sigma_rad=np.radians(0.5))


def station_offsets(rows: AssociatedRows, poses: np.ndarray) -> np.ndarray:
    """The offset of each row, less the mean of its station; rows of stations that one observation alone saw are left out."""
    offset = _linearize(rows, poses)[1]
    count = int(rows.station.max()) + 1
    mean = np.bincount(rows.station, offset, count) / np.maximum(np.bincount(rows.station, minlength=count), 1)
    pairs = np.unique(np.stack((rows.station, rows.observation)), axis=1)
    shared = np.bincount(pairs[0], minlength=count)[rows.station] > 1
    return (offset - mean[rows.station])[shared]


def test_poses_are_those_of_one_system_with_the_stations() -> None:
    """The slow twin: poses and stations as unknowns of one dense system."""
    random = np.random.default_rng(4)
    m, n, k = 60, 4, 7
    angle = random.uniform(0, 2 * np.pi, m)
    rows = AssociatedRows(
        random.integers(0, n, m), random.normal(0, 10, (m, 2)), random.normal(0, 10, (m, 2)),
        np.stack((np.cos(angle), np.sin(angle)), 1), random.integers(0, k, m), random.uniform(0.01, 0.2, m),
    )  # fmt: skip
    poses = random.normal(0, 1, (n, 3))
    jacobian, offset = _linearize(rows, poses)
    prior = np.diag(np.tile([4.0, 4.0, 900.0], n))
    normal, right_side = _eliminate_stations(rows, jacobian, offset, 1 / rows.variance, n)
    dense = np.zeros((m, 3 * n + k))
    for i in range(m):
        dense[i, 3 * rows.observation[i] : 3 * rows.observation[i] + 3] = jacobian[i]
        dense[i, 3 * n + rows.station[i]] = -1
    full = dense.T @ (dense / rows.variance[:, None])
    full[: 3 * n, : 3 * n] += prior
    expected = np.linalg.solve(full, -dense.T @ (offset / rows.variance))[: 3 * n]
    np.testing.assert_allclose(np.linalg.solve(normal + prior, right_side), expected, atol=1e-9)


def test_derivatives_are_those_of_the_offsets() -> None:
    random = np.random.default_rng(5)
    rows = AssociatedRows(
        np.zeros(5, np.int64), random.normal(0, 10, (5, 2)), random.normal(0, 10, (5, 2)),
        np.tile([[0.6, 0.8]], (5, 1)), np.arange(5), np.ones(5),
    )  # fmt: skip
    pose, step = np.array([[3.0, -2.0, 0.7]]), 1e-6
    jacobian, offset = _linearize(rows, pose)
    for column in range(3):
        moved = pose.copy()
        moved[0, column] += step
        np.testing.assert_allclose((_linearize(rows, moved)[1] - offset) / step, jacobian[:, column], atol=1e-4)


@pytest.fixture(scope="module")
def exact():
    return run_trial(FleetTrial("cross", 20, 5, 160.0, fleet_config=EXACT))


def test_observations_of_exact_lines_agree_afterwards(exact) -> None:
    rows = make_associated_rows(exact)
    priors = np.array([o.pose for o in exact.observations])
    before, after = (station_offsets(rows, p) for p in (priors, estimate_poses_with_true_association(exact)))
    assert np.sqrt((before**2).mean()) > 0.15
    assert np.sqrt((after**2).mean()) < 0.1 * np.sqrt((before**2).mean())


def test_at_true_poses_every_row_is_on_its_line(exact) -> None:
    rows = make_associated_rows(exact)
    assert len(rows.station) > 100
    assert np.abs(_linearize(rows, exact.fleet.true_poses)[1]).max() < 0.05
    map_at_truth = fuse_with_true_association(exact, exact.fleet.true_poses)
    divider = evaluate_map(exact.cut_policy(map_at_truth), exact.truth).get_kind("divider")
    assert divider.lateral_median_m < 0.01 and divider.lateral_p95_m < 0.05


def test_a_drive_with_a_wrong_prior_is_brought_to_the_others() -> None:
    trial = FleetTrial("cross", 20, 5, 160.0, fleet_config=replace(EXACT, pose_sigma_m=0.1))
    experiment = run_trial(trial)
    first = experiment.observations[0]
    drive = [(o.agent, o.pass_id) == (first.agent, first.pass_id) for o in experiment.observations]
    wrong = [
        replace(o, pose=o.pose + [2.0, -1.5, 0.0]) if moved else o for o, moved in zip(experiment.observations, drive)
    ]
    moved = replace(experiment, fleet=replace(experiment.fleet, observations=tuple(wrong)))
    error = np.hypot(*(estimate_poses_with_true_association(moved) - experiment.fleet.true_poses)[:, :2].T)
    assert error[np.array(drive)].max() < 0.5
    assert np.median(error) < 0.2


def test_points_move_with_a_pose() -> None:
    np.testing.assert_allclose(_move(np.array([[2.0, 0.0]]), np.array([1.0, 1.0, np.pi / 2])), [[1.0, 3.0]], atol=1e-12)
