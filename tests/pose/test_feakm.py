# SPDX-License-Identifier: Apache-2.0
"""FeaKM's solvers: rigid fit of Eq. 6, minimum pairs of 4 and 8, outliers, the comparison with the prior, the half pixel."""

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
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FORMAT, FeakmConfig, FeakmNet, Matches
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig, DetectorView
from manyeyes.models.pose.matcher import KeypointBatch, MatcherConfig
from manyeyes.pose import feakm
from manyeyes.pose.feakm import ConsensusConfig, FeakmCorrector, RansacConfig, solve_with_consensus, solve_with_ransac
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference

TRUTH = np.array([20.0, -7.0, 2.2])
SOLVERS = {"ransac": solve_with_ransac, "consensus": solve_with_consensus}


def make_landmarks(n: int, seed: int = 0) -> Landmarks:
    rng = np.random.default_rng(seed)
    ones = np.ones(n)
    xy = rng.uniform(-40, 40, (n, 2))
    size = np.column_stack((4.5 * ones, 1.9 * ones))
    return Landmarks(
        xy, rng.uniform(-3, 3, n), size, ones, 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(n, np.int64)
    )


def moved_back(pose, points: Landmarks, noise_m: float = 0.0, seed: int = 1) -> Landmarks:
    back = Transform.from_xyz_yaw(*map(float, (pose[0], pose[1], 0.0, pose[2]))).inverse()
    there = points.transform(np.array([*back.translation[:2].tolist(), float(back.yaw)]))
    return replace(there, xy=there.xy + noise_m * np.random.default_rng(seed).standard_normal(there.xy.shape))


def same(n: int) -> np.ndarray:
    return np.stack((np.arange(n), np.arange(n)), 1)


def make_prior(pose, sigma: float) -> PosePrior:
    return PosePrior.of(Transform.from_xyz_yaw(float(pose[0]), float(pose[1]), 0.0, float(pose[2])), sigma, sigma / 50)


@pytest.mark.parametrize("name", SOLVERS)
def test_pairs_give_the_pose_whatever_the_prior(name):
    ego = make_landmarks(6)
    other = moved_back(TRUTH, ego)
    for prior in (None, make_prior(TRUTH + [40.0, 3.0, 1.0], 0.5)):
        found = SOLVERS[name](ego, other, same(6), prior)
        np.testing.assert_allclose(pose_difference(found.pose, TRUTH), 0, atol=1e-6)
        assert found.status.has_estimate and found.inliers == 6


@pytest.mark.parametrize("name", SOLVERS)
def test_wrong_pairs_are_rejected(name):
    """Five pairs are correct, five are mismatches."""
    ego = make_landmarks(10)
    other = moved_back(TRUTH, ego, 0.1)
    pairs = same(10)
    pairs[5:, 1] = [6, 7, 8, 9, 5]
    found = SOLVERS[name](ego, other, pairs, None)
    off = pose_difference(found.pose, TRUTH)
    assert np.hypot(off[0], off[1]) < 0.3 and abs(off[2]) < 0.01
    assert found.pairs.tolist() == same(5).tolist()


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("min_pairs", [4, 8])
def test_fewer_than_min_pairs_keep_the_prior(name, min_pairs):
    solver = partial(SOLVERS[name], config=RansacConfig(min_pairs) if name == "ransac" else ConsensusConfig(min_pairs))
    ego, prior = make_landmarks(8), make_prior(TRUTH + [3.0, 0.0, 0.0], 0.2)
    other = moved_back(TRUTH, ego)
    kept = solver(ego, other, same(min_pairs - 1), prior)
    assert kept.status is PoseStatus.NO_MATCH
    np.testing.assert_allclose(kept.pose, prior.pose)
    assert solver(ego, other, same(min_pairs - 1), None).pose is None
    assert solver(ego, other, same(min_pairs), prior).status.has_estimate
    # Enough pairs, but two of them are mismatches.
    wrong = same(min_pairs)
    wrong[0, 1], wrong[1, 1] = 1, 0
    assert not solver(ego, other, wrong, prior).status.has_estimate


def test_ransac_compares_with_the_prior_only_where_limits_are_set():
    ego = make_landmarks(6)
    other = moved_back(TRUTH, ego)
    near, far = make_prior(TRUTH + [0.5, 0.0, 0.01], 0.1), make_prior(TRUTH + [1.5, 0.0, 0.0], 0.1)
    assert solve_with_ransac(ego, other, same(6), near).status is PoseStatus.CORRECTED
    compares = RansacConfig(significant_m=1.0, significant_deg=1.0)
    kept = solve_with_ransac(ego, other, same(6), near, compares)
    assert kept.status is PoseStatus.OK and kept.measured is not None
    np.testing.assert_allclose(kept.pose, near.pose)
    conflicting = solve_with_ransac(ego, other, same(6), far, compares)
    assert conflicting.status is PoseStatus.CONFLICT
    np.testing.assert_allclose(pose_difference(conflicting.pose, TRUTH), 0, atol=1e-6)


def test_consensus_fuses_an_honest_prior_and_rejects_a_wrong_one():
    ego = make_landmarks(6)
    other = moved_back(TRUTH, ego, 0.2)
    alone = solve_with_consensus(ego, other, same(6), None)
    both = solve_with_consensus(ego, other, same(6), make_prior(TRUTH + [0.05, 0.0, 0.0], 0.1))
    assert both.status is PoseStatus.OK
    assert np.linalg.det(both.covariance) < np.linalg.det(alone.covariance)
    assert (
        solve_with_consensus(ego, other, same(6), make_prior(TRUTH + [8.0, 0.0, 0.0], 0.1)).status
        is PoseStatus.CONFLICT
    )


def test_a_reflection_is_not_matched():
    ego = make_landmarks(6)
    mirrored = replace(ego, xy=ego.xy * [1.0, -1.0], yaw=-ego.yaw)
    for solver in SOLVERS.values():
        assert not solver(ego, mirrored, same(6), None).status.has_estimate


def test_two_poses_that_fit_equally_are_ambiguous():
    """Four pairs give one pose and four another."""
    ego = make_landmarks(8)
    one, two = moved_back(TRUTH, ego), moved_back(TRUTH + [15.0, 0.0, 1.0], ego)
    half = np.arange(8) < 4
    other = replace(one, xy=np.where(half[:, None], one.xy, two.xy), yaw=np.where(half, one.yaw, two.yaw))
    found = solve_with_consensus(ego, other, same(8), None)
    assert found.status is PoseStatus.AMBIGUOUS and found.runner_up == 4
    # The second pose is not found where only one hypothesis may be refined.
    bounded = solve_with_consensus(ego, other, same(8), None, ConsensusConfig(max_refined=1))
    assert bounded.runner_up == 0 and bounded.pairs.tolist() in (same(8)[:4].tolist(), same(8)[4:].tolist())


def test_at_most_max_refined_hypotheses_are_refined(monkeypatch):
    ego, other, calls = make_landmarks(40), make_landmarks(40, seed=7), []
    monkeypatch.setattr(feakm, "_refine", lambda *arguments: calls.append(arguments))
    for max_refined in (2, 4):
        calls.clear()
        assert (
            solve_with_consensus(ego, other, same(40), None, ConsensusConfig(max_refined=max_refined)).status
            is PoseStatus.NO_MATCH
        )
        assert len(calls) == max_refined


def test_draws_are_keyed_and_equivariant():
    ego = make_landmarks(12)
    other = moved_back(TRUTH, ego, 0.3)
    other = replace(other, xy=np.where(np.arange(12)[:, None] < 5, other.xy + 30, other.xy))
    first = solve_with_ransac(ego, other, same(12), None)
    assert np.array_equal(first.pose, solve_with_ransac(ego, other, same(12), None).pose)
    step = np.array([5.0, 1.0, 0.7])
    for solver in SOLVERS.values():
        before, after = solver(ego, other, same(12), None), solver(ego.transform(step), other, same(12), None)
        c, s = math.cos(step[2]), math.sin(step[2])
        x, y, yaw = before.pose
        expected = np.array([c * x - s * y + step[0], s * x + c * y + step[1], yaw + step[2]])
        np.testing.assert_allclose(pose_difference(after.pose, expected), 0, atol=1e-6)


@dataclass(frozen=True)
class FixedMatches:
    """A net whose matches are known."""

    net: FeakmNet
    pairs: torch.Tensor

    @property
    def config(self) -> FeakmConfig:
        return self.net.config

    def match(self, ego: KeypointBatch, other: KeypointBatch) -> Matches:
        return Matches(self.pairs, torch.ones(len(self.pairs)))


def test_a_pose_is_found_from_decoded_bytes():
    """25 objects with a descriptor each: 46 bytes an object and one header; places come back to a centimetre."""
    n, rng = 25, torch.Generator().manual_seed(2)
    seen = make_landmarks(n)
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
    assert len(packets) == 1 and 46 * n < len(packets[0]) <= 46 * n + 80
    inbox = Inbox(bytes(8))
    inbox.push(packets[0])
    (received,) = inbox.received_messages()
    other = Keypoints(received.message.objects, received.message.descriptors)
    alike = (ego.descriptor @ other.descriptor.T).argmax(1)
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    by_descriptors = FeakmCorrector.of(FixedMatches(net, torch.stack((torch.arange(n), alike), 1)))
    found = by_descriptors(Landmarks.of_keypoints(ego), Landmarks.of_keypoints(other), None)
    assert found.inliers == n
    off = pose_difference(found.pose, TRUTH)
    assert np.hypot(off[0], off[1]) < 0.02 and abs(off[2]) < 1e-3


def test_objects_without_descriptors_are_not_matched():
    ego = make_landmarks(6)
    descriptor = np.eye(6, 32)
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    by_descriptors, prior = FeakmCorrector.of(FixedMatches(net, torch.from_numpy(same(6)))), make_prior(TRUTH, 0.5)
    other = moved_back(TRUTH, ego)
    for pair in ((ego, replace(other, descriptor=descriptor)), (replace(ego, descriptor=descriptor), other)):
        assert by_descriptors(*pair, prior).status is PoseStatus.NO_MATCH
    found = by_descriptors(replace(ego, descriptor=descriptor), replace(other, descriptor=descriptor), None)
    np.testing.assert_allclose(pose_difference(found.pose, TRUTH), 0, atol=1e-6)


def test_the_matcher_gets_equal_inputs_from_landmarks_and_keypoints():
    """Landmarks give the matcher the same inputs as the keypoints that they were made of."""
    torch.manual_seed(0)
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(4, 32, 8), MatcherConfig(32, 16, 1, 1, min_match_prob=0.0))).eval()
    seen = make_landmarks(5)
    boxes = Boxes.of(
        torch.from_numpy(np.column_stack((seen.xy, np.ones(5)))).float(),
        torch.tensor([4.5, 1.9, 1.6]).expand(5, 3),
        torch.from_numpy(seen.yaw).float(),
    )
    points = [Keypoints(boxes, torch.nn.functional.normalize(torch.randn(5, 32))) for _ in range(2)]
    expected = net.match(KeypointBatch.of(points[:1]), KeypointBatch.of(points[1:]))
    received = []
    by_descriptors = FeakmCorrector(net, lambda ego, other, pairs, prior: received.append(pairs))
    by_descriptors(*map(Landmarks.of_keypoints, points), None)
    assert len(expected.pairs) and torch.equal(torch.from_numpy(received[0]), expected.pairs)


def test_names_select_weights_and_number_of_pairs(tmp_path):
    path = tmp_path / "net.safetensors"
    net = FeakmNet(FeakmConfig(BoxKeypointConfig(4, 32, 8), MatcherConfig(32, 8, 1, 1)))
    checkpoint.save(net, path, {}, format=FORMAT)
    four, eight = load_corrector(str(path)), load_corrector(f"{path}@8")
    assert load_corrector(f"{path}@4").net is four.net and load_corrector(str(path)) is not eight
    ego = make_landmarks(6)
    for min_pairs, loaded in ((4, four), (8, eight)):
        assert loaded.solver(ego, moved_back(TRUTH, ego), same(6), None).status.has_estimate == (min_pairs == 4)
    for name, why in (
        (f"{path}@x", "4 or 8"),
        ("magic", "known: clipper, coalign"),
        (str(tmp_path / "no.safetensors"), "no such file"),
    ):
        with pytest.raises(ManyeyesError, match=why):
            load_corrector(name)


def test_box_centres_avoid_the_half_pixel_error_of_cell_corners():
    """A map turned by half a turn: the published corner of a cell costs 2 |(0.4, 0.4)| m at cells of 0.8 m, box centres
    nothing.
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
        views.append(DetectorView(tokens, torch.linspace(0.9, 0.5, len(yx))[yx.argsort(0).argsort(0)[:, 0]], boxes))
    errors = {}
    for name, kind in {
        "ransac": DenseKeypointConfig(4, (4, 4, 4), 8, num_keypoints=6),
        "consensus": BoxKeypointConfig(4, 8, 8),
    }.items():
        torch.manual_seed(0)
        net = FeakmNet(FeakmConfig(kind, MatcherConfig(8, 8, 1, 1))).eval().requires_grad_(False)
        points = net.describe(views)
        mirrored = torch.tensor([2 * middle, 2 * middle]) - points[1].xy
        pairs = torch.cdist(points[0].xy, mirrored).argmin(1)
        by_descriptors = FeakmCorrector.of(FixedMatches(net, torch.stack((torch.arange(6), pairs), 1)))
        off = pose_difference(by_descriptors(*map(Landmarks.of_keypoints, points), None).pose, truth)
        errors[name] = float(np.hypot(off[0], off[1]))
        assert abs(off[2]) < 1e-6
    assert errors["consensus"] < 1e-3
    assert errors["ransac"] == pytest.approx(2 * math.hypot(0.4, 0.4), abs=1e-3)
