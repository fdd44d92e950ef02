# SPDX-License-Identifier: Apache-2.0
"""FeaKM's solvers: the rigid fit of Eq. 6 on pairs, fewest pairs of 4 and 8, outliers, the rule that compares, the half pixel."""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch

from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import BevGrid, Boxes, ManyeyesError, Message, SparseBev, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models import checkpoint
from manyeyes.models.pose.box_descriptors import BoxKeypoints
from manyeyes.models.pose.feakm import FORMAT, FeakmConfig, FeakmNet, Matches
from manyeyes.models.pose.keypoint_net import DenseKeypoints, View
from manyeyes.models.pose.matcher import MatcherConfig, Points
from manyeyes.pose import feakm
from manyeyes.pose.feakm import ConsensusConfig, Feakm, RansacConfig, mended, published
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import corrector
from manyeyes.pose.types import PoseClaim, PoseStatus, difference

TRUTH = np.array([20.0, -7.0, 2.2])
SOLVERS = {"published": published, "mended": mended}


def marks(n: int, seed: int = 0) -> Landmarks:
    rng = np.random.default_rng(seed)
    ones = np.ones(n)
    xy = rng.uniform(-40, 40, (n, 2))
    size = np.column_stack((4.5 * ones, 1.9 * ones))
    return Landmarks(
        xy, rng.uniform(-3, 3, n), size, ones, 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(n, np.int64)
    )


def moved_back(pose, points: Landmarks, noise_m: float = 0.0, seed: int = 1) -> Landmarks:
    back = Transform.from_xyz_yaw(*map(float, (pose[0], pose[1], 0.0, pose[2]))).inverse()
    there = points.moved(np.array([*back.translation[:2].tolist(), float(back.yaw)]))
    return replace(there, xy=there.xy + noise_m * np.random.default_rng(seed).standard_normal(there.xy.shape))


def same(n: int) -> np.ndarray:
    return np.stack((np.arange(n), np.arange(n)), 1)


def claim(pose, sigma: float) -> PoseClaim:
    return PoseClaim.of(Transform.from_xyz_yaw(float(pose[0]), float(pose[1]), 0.0, float(pose[2])), sigma, sigma / 50)


@pytest.mark.parametrize("name", SOLVERS)
def test_pairs_give_the_pose_whatever_is_claimed(name):
    ego = marks(6)
    other = moved_back(TRUTH, ego)
    for claimed in (None, claim(TRUTH + [40.0, 3.0, 1.0], 0.5)):
        found = SOLVERS[name](ego, other, same(6), claimed)
        np.testing.assert_allclose(difference(found.pose, TRUTH), 0, atol=1e-6)
        assert found.status.answered and found.inliers == 6


@pytest.mark.parametrize("name", SOLVERS)
def test_wrong_pairs_are_outvoted(name):
    """Five pairs are right, five join strangers."""
    ego = marks(10)
    other = moved_back(TRUTH, ego, 0.1)
    pairs = same(10)
    pairs[5:, 1] = [6, 7, 8, 9, 5]
    found = SOLVERS[name](ego, other, pairs, None)
    off = difference(found.pose, TRUTH)
    assert np.hypot(off[0], off[1]) < 0.3 and abs(off[2]) < 0.01
    assert found.pairs.tolist() == same(5).tolist()


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("least", [4, 8])
def test_fewer_pairs_than_asked_keep_the_claim(name, least):
    solver = partial(SOLVERS[name], config=RansacConfig(least) if name == "published" else ConsensusConfig(least))
    ego, claimed = marks(8), claim(TRUTH + [3.0, 0.0, 0.0], 0.2)
    other = moved_back(TRUTH, ego)
    kept = solver(ego, other, same(least - 1), claimed)
    assert kept.status is PoseStatus.NO_MATCH
    np.testing.assert_allclose(kept.pose, claimed.pose)
    assert solver(ego, other, same(least - 1), None).pose is None
    assert solver(ego, other, same(least), claimed).status.answered
    # So many pairs, but one of them joins strangers.
    wrong = same(least)
    wrong[0, 1], wrong[1, 1] = 1, 0
    assert not solver(ego, other, wrong, claimed).status.answered


def test_as_published_nothing_is_compared_and_a_limit_compares():
    ego = marks(6)
    other = moved_back(TRUTH, ego)
    near, far = claim(TRUTH + [0.5, 0.0, 0.01], 0.1), claim(TRUTH + [1.5, 0.0, 0.0], 0.1)
    assert published(ego, other, same(6), near).status is PoseStatus.CORRECTED
    compares = RansacConfig(significant_m=1.0, significant_deg=1.0)
    kept = published(ego, other, same(6), near, compares)
    assert kept.status is PoseStatus.OK and kept.measured is not None
    np.testing.assert_allclose(kept.pose, near.pose)
    refuted = published(ego, other, same(6), far, compares)
    assert refuted.status is PoseStatus.CONFLICT
    np.testing.assert_allclose(difference(refuted.pose, TRUTH), 0, atol=1e-6)


def test_mended_pairs_and_an_honest_claim_are_joined_and_a_lie_is_refuted():
    ego = marks(6)
    other = moved_back(TRUTH, ego, 0.2)
    alone = mended(ego, other, same(6), None)
    both = mended(ego, other, same(6), claim(TRUTH + [0.05, 0.0, 0.0], 0.1))
    assert both.status is PoseStatus.OK
    assert np.linalg.det(both.covariance) < np.linalg.det(alone.covariance)
    assert mended(ego, other, same(6), claim(TRUTH + [8.0, 0.0, 0.0], 0.1)).status is PoseStatus.CONFLICT


def test_a_reflection_is_no_pose():
    ego = marks(6)
    mirrored = replace(ego, xy=ego.xy * [1.0, -1.0], yaw=-ego.yaw)
    for solver in SOLVERS.values():
        assert not solver(ego, mirrored, same(6), None).status.answered


def test_two_answers_that_fit_alike_are_ambiguous():
    """Four pairs say one pose and four another."""
    ego = marks(8)
    one, two = moved_back(TRUTH, ego), moved_back(TRUTH + [15.0, 0.0, 1.0], ego)
    half = np.arange(8) < 4
    other = replace(one, xy=np.where(half[:, None], one.xy, two.xy), yaw=np.where(half, one.yaw, two.yaw))
    found = mended(ego, other, same(8), None)
    assert found.status is PoseStatus.AMBIGUOUS and found.runner_up == 4
    # The second answer is never looked at where one hypothesis is all that may be refined.
    bounded = mended(ego, other, same(8), None, ConsensusConfig(refined=1))
    assert bounded.runner_up == 0 and bounded.pairs.tolist() in (same(8)[:4].tolist(), same(8)[4:].tolist())


def test_where_nothing_holds_only_so_many_hypotheses_are_refined(monkeypatch):
    ego, other, calls = marks(40), marks(40, seed=7), []
    monkeypatch.setattr(feakm, "_refined", lambda *arguments: calls.append(arguments))
    for most in (2, 4):
        calls.clear()
        assert mended(ego, other, same(40), None, ConsensusConfig(refined=most)).status is PoseStatus.NO_MATCH
        assert len(calls) == most


def test_draws_are_keyed_and_equivariant():
    ego = marks(12)
    other = moved_back(TRUTH, ego, 0.3)
    other = replace(other, xy=np.where(np.arange(12)[:, None] < 5, other.xy + 30, other.xy))
    first = published(ego, other, same(12), None)
    assert np.array_equal(first.pose, published(ego, other, same(12), None).pose)
    step = np.array([5.0, 1.0, 0.7])
    for solver in SOLVERS.values():
        before, after = solver(ego, other, same(12), None), solver(ego.moved(step), other, same(12), None)
        c, s = math.cos(step[2]), math.sin(step[2])
        x, y, yaw = before.pose
        wanted = np.array([c * x - s * y + step[0], s * x + c * y + step[1], yaw + step[2]])
        np.testing.assert_allclose(difference(after.pose, wanted), 0, atol=1e-6)


@dataclass(frozen=True)
class Drawn:
    """A net whose matches are known."""

    net: FeakmNet
    pairs: torch.Tensor

    @property
    def config(self) -> FeakmConfig:
        return self.net.config

    def match(self, ego: Points, other: Points) -> Matches:
        return Matches(self.pairs, torch.ones(len(self.pairs)))


def test_a_pose_is_found_from_what_comes_as_bytes():
    """25 objects with a descriptor each: 45 bytes an object and one header; places come back to a centimetre."""
    n, rng = 25, torch.Generator().manual_seed(2)
    seen = marks(n)
    boxes = Boxes.of(
        torch.from_numpy(np.column_stack((seen.xy, np.zeros(n)))).float(),
        torch.tensor([4.5, 1.9, 1.6]).expand(n, 3),
        torch.from_numpy(seen.yaw).float(),
        torch.rand(n, generator=rng),
    )
    descriptor = torch.nn.functional.normalize(torch.randn(n, 32, generator=rng))
    move = Transform.from_xyz_yaw(*map(float, (TRUTH[0], TRUTH[1], 0.0, TRUTH[2])))
    ego = Keypoints(boxes.transform(move), descriptor)
    message = Message(3, 0, Transform.identity(), torch.zeros(3, 3), objects=boxes, descriptors=descriptor)
    packets = wire.encode(message)
    assert len(packets) == 1 and 45 * n < len(packets[0]) <= 45 * n + 80
    inbox = Inbox(bytes(8))
    inbox.push(packets[0])
    (heard,) = inbox.receptions()
    other = Keypoints(heard.message.objects, heard.message.descriptors)
    alike = (ego.descriptor @ other.descriptor.T).argmax(1)
    net = FeakmNet(FeakmConfig(BoxKeypoints(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    by_looks = Feakm.of(Drawn(net, torch.stack((torch.arange(n), alike), 1)))
    found = by_looks(Landmarks.of_keypoints(ego), Landmarks.of_keypoints(other), None)
    assert found.inliers == n
    off = difference(found.pose, TRUTH)
    assert np.hypot(off[0], off[1]) < 0.02 and abs(off[2]) < 1e-3


def test_objects_that_nobody_described_are_recognised_by_nobody():
    ego = marks(6)
    look = np.eye(6, 32)
    net = FeakmNet(FeakmConfig(BoxKeypoints(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    by_looks, claimed = Feakm.of(Drawn(net, torch.from_numpy(same(6)))), claim(TRUTH, 0.5)
    other = moved_back(TRUTH, ego)
    for pair in ((ego, replace(other, look=look)), (replace(ego, look=look), other)):
        assert by_looks(*pair, claimed).status is PoseStatus.NO_MATCH
    found = by_looks(replace(ego, look=look), replace(other, look=look), None)
    np.testing.assert_allclose(difference(found.pose, TRUTH), 0, atol=1e-6)


def test_a_net_is_told_what_landmarks_say():
    """The matcher gets of landmarks what it gets of the keypoints that they were made of."""
    torch.manual_seed(0)
    net = FeakmNet(FeakmConfig(BoxKeypoints(4, 32, 8), MatcherConfig(32, 16, 1, 1, threshold=0.0))).eval()
    seen = marks(5)
    boxes = Boxes.of(
        torch.from_numpy(np.column_stack((seen.xy, np.ones(5)))).float(),
        torch.tensor([4.5, 1.9, 1.6]).expand(5, 3),
        torch.from_numpy(seen.yaw).float(),
    )
    points = [Keypoints(boxes, torch.nn.functional.normalize(torch.randn(5, 32))) for _ in range(2)]
    wanted = net.match(Points.of(points[:1]), Points.of(points[1:]))
    heard = []
    by_looks = Feakm(net, lambda ego, other, pairs, claimed: heard.append(pairs))
    by_looks(*map(Landmarks.of_keypoints, points), None)
    assert len(wanted.pairs) and torch.equal(torch.from_numpy(heard[0]), wanted.pairs)


def test_names_say_whose_weights_and_how_many_pairs(tmp_path):
    path = tmp_path / "net.safetensors"
    net = FeakmNet(FeakmConfig(BoxKeypoints(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    checkpoint.save(net, path, {}, format=FORMAT)
    four, eight = corrector(str(path)), corrector(f"{path}@8")
    assert corrector(f"{path}@4").net is four.net and corrector(str(path)) is not eight
    ego = marks(6)
    for least, said in ((4, four), (8, eight)):
        assert said.solver(ego, moved_back(TRUTH, ego), same(6), None).status.answered == (least == 4)
    for name, why in (
        (f"{path}@x", "4 or 8"),
        ("magic", "known: vote"),
        (str(tmp_path / "no.safetensors"), "no such file"),
    ):
        with pytest.raises(ManyeyesError, match=why):
            corrector(name)


def test_the_half_pixel():
    """A map turned by half a turn: the published corner of a cell costs 2 |(0.4, 0.4)| m at cells of 0.8 m, box centres
    nothing (specs/pose.md 0.4).
    """
    grid = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0, stride=2)
    last = torch.tensor(grid.shape) - 1
    cells = torch.tensor([[10, 40], [20, 12], [44, 30], [50, 50], [33, 22], [12, 22]])
    # Centres lie at -25.4 + 0.8 k: half a turn about (-0.2, -0.2), the middle of the lattice of centres.
    middle = -0.2
    truth = np.array([2 * middle, 2 * middle, math.pi])
    views = []
    for yx in (cells, last - cells):
        tokens = SparseBev.from_cells(torch.rand(len(yx), 4), yx, grid)
        centres = grid.centers(yx)
        boxes = Boxes.of(
            torch.cat((centres, torch.zeros(len(yx), 1)), 1), torch.ones(len(yx), 3) * 4, torch.zeros(len(yx))
        )
        views.append(View(tokens, torch.linspace(0.9, 0.5, len(yx))[yx.argsort(0).argsort(0)[:, 0]], boxes))
    errors = {}
    for name, kind in {
        "published": DenseKeypoints(4, (4, 4, 4), 8, most=6),
        "mended": BoxKeypoints(4, 8, 8),
    }.items():
        torch.manual_seed(0)
        net = FeakmNet(FeakmConfig(kind, MatcherConfig(8, 8, 1, 1))).eval().requires_grad_(False)
        points = net.describe(views)
        mirrored = torch.tensor([2 * middle, 2 * middle]) - points[1].xy
        pairs = torch.cdist(points[0].xy, mirrored).argmin(1)
        by_looks = Feakm.of(Drawn(net, torch.stack((torch.arange(6), pairs), 1)))
        off = difference(by_looks(*map(Landmarks.of_keypoints, points), None).pose, truth)
        errors[name] = float(np.hypot(off[0], off[1]))
        assert abs(off[2]) < 1e-6
    assert errors["mended"] < 1e-3
    assert errors["published"] == pytest.approx(2 * math.hypot(0.4, 0.4), abs=1e-3)
