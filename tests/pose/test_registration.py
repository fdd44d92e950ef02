# SPDX-License-Identifier: Apache-2.0
"""Clouds laid over each other: on a street of arithmetic, where it must not answer, and on two real scans."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, MissingExtraError, PointCloud, Transform
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.pose.baselines import gicp
from manyeyes.pose.registration import LikelihoodField, RegistrationConfig, extract_vertical_structures, register_clouds
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference, project_to_se2

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "lidar_pair"
FEW = RegistrationConfig(max_range_m=40.0, num_yaw_steps=90)


def street(seed: int, objects: int = 60) -> PointCloud:
    """Walls of 2 to 8 m and 2 m high at any angle, and flat ground."""
    rng = np.random.default_rng(seed)
    walls = []
    for _ in range(objects):
        (x, y), yaw, length = rng.uniform(-45, 45, 2), rng.uniform(0, np.pi), rng.uniform(2, 8)
        along, up = rng.uniform(-length / 2, length / 2, 150), rng.uniform(0, 2, 150)
        walls.append(np.column_stack((x + along * np.cos(yaw), y + along * np.sin(yaw), up)))
    ground = np.column_stack((rng.uniform(-45, 45, (4000, 2)), rng.normal(0, 0.02, 4000)))
    return PointCloud.of(torch.from_numpy(np.concatenate((*walls, ground))))


def error(found, truth) -> tuple[float, float]:
    off = pose_difference(found.pose, truth)
    return float(np.hypot(off[0], off[1])), math.degrees(abs(off[2]))


def some(cloud: PointCloud, fraction: float, seed: int) -> PointCloud:
    return cloud[torch.rand(len(cloud), generator=torch.Generator().manual_seed(seed)) < fraction]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (8.3, -5.1, 2.4), (-14.0, 3.0, -1.0)])
def test_the_pose_is_found_whatever_the_prior(pose):
    ego_from_other = Transform.from_xyz_yaw(pose[0], pose[1], 0.0, pose[2])
    world = street(0)
    ego, other = some(world, 0.7, 1), some(world, 0.7, 2).transform(ego_from_other.inverse())
    wrong_prior = PosePrior.of(Transform.from_xyz_yaw(30.0, 9.0, 1.5, 1.0), 0.1, 0.01)
    found, with_prior = register_clouds(ego, other, None, FEW), register_clouds(ego, other, wrong_prior, FEW)
    metres, degrees = error(found, np.array(pose))
    assert found.status is PoseStatus.CORRECTED and metres < 0.1 and degrees < 0.3 and found.margin > 0.1
    np.testing.assert_allclose(with_prior.pose, found.pose, atol=1e-9)
    assert float(with_prior.ego_from_other.translation[2]) == 1.5 and with_prior.mahalanobis_squared > 100


def test_clouds_of_other_places_and_places_that_repeat_give_no_pose():
    assert not register_clouds(street(1), street(2), None, FEW).status.has_estimate
    prior = PosePrior.of(Transform.identity(), 1.0, 0.1)
    empty = PointCloud.of(torch.zeros(0, 3))
    kept = register_clouds(street(1), empty, prior, FEW)
    assert kept.status is PoseStatus.NO_MATCH and kept.ego_from_other is prior.ego_from_other
    # A fence of posts every 5 m fits at every post.
    posts = np.concatenate(
        [np.column_stack((np.full(9, x), np.zeros(9), np.linspace(0, 2, 9))) for x in range(-40, 41, 5)]
    )
    fence = PointCloud.of(torch.from_numpy(posts))
    assert register_clouds(fence, fence, None, FEW).status is PoseStatus.AMBIGUOUS


def test_only_columns_that_stand_count():
    """A wall, the ground under it, and a roof's edge at one height."""
    wall = torch.tensor([[5.1, 0.1, z] for z in (0.0, 0.5, 1.0)])
    flat = torch.tensor([[x, 3.0, 0.0] for x in (1.0, 2.0, 3.0)])
    far = torch.tensor([[70.0, 0.0, 0.0], [70.0, 0.0, 2.0]])
    found = extract_vertical_structures(PointCloud.of(torch.cat((wall, flat, far))), RegistrationConfig())
    np.testing.assert_allclose(found, [[5.1, 0.1]], atol=1e-6)


def test_the_field_is_a_gaussian_around_the_nearest_column():
    field = LikelihoodField.of(np.array([[0.1, 0.1], [4.1, 0.1]]), 10.0, 0.2, 0.4)
    for away in (0.0, 0.2, 0.6, 1.0):
        assert field.sample(np.array([0.1, 0.1 + away])) == pytest.approx(math.exp(-(away**2) / (2 * 0.4**2)), abs=1e-6)
    # Bilinear between cells, nothing outside.
    assert field.sample(np.array([0.2, 0.1])) == pytest.approx((1 + math.exp(-0.125)) / 2, abs=1e-6)
    assert field.sample(np.array([[2.1, 0.1], [30.0, 0.0]])).tolist() == [0.0, 0.0]
    with pytest.raises(ConfigError, match="num_candidates >= 2"):
        replace(FEW, num_candidates=1)


def read_ply(path: Path) -> PointCloud:
    raw = path.read_bytes()
    start = raw.index(b"end_header\n") + len(b"end_header\n")
    return PointCloud.of(torch.from_numpy(np.frombuffer(raw[start:], "<f4").reshape(-1, 4)[:, :3].copy()))


def scans() -> tuple[PointCloud, PointCloud, Transform]:
    matrix = np.loadtxt(SHARED / "T_target_source.txt")
    return (
        read_ply(SHARED / "target.ply"),
        read_ply(SHARED / "source.ply"),
        Transform.from_matrix(torch.from_numpy(matrix)),
    )


def start(number: int) -> Transform:
    """Any yaw and up to 20 m."""
    turn, towards, far = keyed_uniform((3,), 0, "start", number).tolist()
    angle = 2 * math.pi * towards
    return Transform.from_xyz_yaw(20 * far * math.cos(angle), 20 * far * math.sin(angle), 0.0, 2 * math.pi * turn)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason=f"{SHARED} is absent: the real scans are not in this project")
@pytest.mark.parametrize("starts", [5, pytest.param(100, marks=pytest.mark.slow)])
def test_two_real_scans_from_random_starts(starts):
    """At least 80 in 100 right (1 m, 1 degree), none wrong."""
    target, source, target_from_source = scans()
    right = wrong = 0
    for number in range(starts):
        moved = start(number)
        found = register_clouds(target, source.transform(moved), None)
        if found.status.has_estimate:
            metres, degrees = error(found, project_to_se2(target_from_source @ moved.inverse()))
            good = metres < 1.0 and degrees < 1.0
            right, wrong = right + good, wrong + (not good)
    assert right >= 0.8 * starts and wrong == 0, (right, wrong)


def test_gicp_names_the_extra_to_install(monkeypatch):
    def absent(name: str):
        raise ImportError(name)

    monkeypatch.setattr(gicp.importlib, "import_module", absent)
    with pytest.raises(MissingExtraError, match=r"manyeyes\[icp\]"):
        gicp.correct(street(0), street(0), PosePrior.of(Transform.identity(), 1.0, 0.1))


def test_gicp_corrects_a_near_prior_and_needs_one():
    pytest.importorskip("small_gicp", reason="small_gicp is absent: pip install 'manyeyes[icp]'")
    truth = Transform.from_xyz_yaw(3.0, -2.0, 0.0, 0.3)
    world = street(0)
    ego, other = some(world, 0.7, 1), some(world, 0.7, 2).transform(truth.inverse())
    near = PosePrior.of(Transform.from_xyz_yaw(3.5, -2.4, 0.0, 0.32), 0.5, 0.03)
    found = gicp.correct(ego, other, near)
    metres, degrees = error(found, project_to_se2(truth))
    assert found.status is PoseStatus.CORRECTED and metres < 0.1 and degrees < 0.5
    assert gicp.correct(ego, other, None).pose is None
    assert not gicp.correct(
        street(1), street(2).transform(Transform.from_xyz_yaw(300.0, 0.0)), near
    ).status.has_estimate
