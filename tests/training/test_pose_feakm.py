# SPDX-License-Identifier: Apache-2.0
"""FeaKM's truth and loss by hand, its cache, its loop, and a batch learnt by heart."""

import copy
import json
import math
from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import BevGrid, Boxes, ConfigError, RecordingError, SparseBev, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FEAKM_PAPER, FeakmConfig, FeakmNet, load
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig, DetectorView
from manyeyes.models.pose.matcher import Assignment, KeypointBatch, MatcherConfig
from manyeyes.models.pose.neighbour_geometry import NeighbourGeometryConfig
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import project_to_se2
from manyeyes.training.pose.feakm import (
    FEAKM_TRAINING_PRESETS,
    FeakmTask,
    FeakmTrainConfig,
    KeypointAugmentConfig,
    match_ground_truth,
    matching_loss,
)
from manyeyes.training.pose.feakm_cache import (
    CachedSnapshot,
    FeatureCache,
    build_cache,
    make_pair,
    read_cached_snapshot,
    select_snapshots,
    write_cached_snapshot,
)
from manyeyes.training.trainer import Trainer

pytestmark = pytest.mark.training

CHANNELS = 8
GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0, stride=4)
TINY = FeakmTrainConfig(
    FeakmConfig(
        BoxKeypointConfig(CHANNELS, 16, 32),
        MatcherConfig(16, 32, 2, 2, position_unit_m=10.0, neighbour_geometry=NeighbourGeometryConfig(60.0, 16)),
    ),
    steps=4,
    batch=2,
    warmup_steps=2,
    save_every=2,
    match_radius_m=1.5,
)


def scene(number: int, agents: int = 2, objects: int = 8) -> CachedSnapshot:
    """Objects on a circle's disc, listed by each agent in an order of its own, and tokens of noise around them."""
    rng = keyed_generator("toy scene", number)
    numbers = torch.from_numpy(rng.uniform(-15, 15, (objects, 2)))
    center = torch.cat((numbers, torch.zeros(objects, 1)), 1)
    size = torch.tensor([4.5, 1.9, 1.6]).double() * torch.from_numpy(rng.uniform(0.9, 1.2, (objects, 1)))
    world = Boxes.of(center, size, torch.from_numpy(rng.uniform(-3, 3, objects)))
    poses = Transform.stack(
        [Transform.from_xyz_yaw(*rng.uniform(-4, 4, 2), 0.0, rng.uniform(-3, 3)) for _ in range(agents)]
    )
    views = []
    for i in range(agents):
        boxes = world[torch.from_numpy(rng.permutation(objects))].transform(poses[i].inverse()).to(torch.float32)
        yx = torch.stack(torch.meshgrid(torch.arange(10, 22), torch.arange(10, 22), indexing="ij"), -1).reshape(-1, 2)
        features = torch.from_numpy(rng.standard_normal((len(yx), CHANNELS))).float()
        tokens = SparseBev.from_cells(features, yx, GRID)
        views.append(DetectorView(tokens, torch.rand(len(yx), generator=torch.Generator().manual_seed(i)), boxes))
    return CachedSnapshot(tuple(views), poses)


@pytest.fixture
def cache(tmp_path) -> FeatureCache:
    made = FeatureCache(tmp_path / "views", (("toy", 0), ("toy", 1)))
    for number in range(2):
        write_cached_snapshot(tmp_path / "views" / "toy" / f"{number:06d}.safetensors", scene(number))
    return made


def points(places) -> Keypoints:
    xy = torch.tensor(places)
    center = torch.cat((xy, torch.zeros(len(xy), 1)), 1)
    return Keypoints(Boxes.of(center, torch.ones(len(xy), 3), torch.zeros(len(xy))), torch.ones(len(xy), 1))


def test_truth_by_hand():
    """The other stands at (10, 0), turned by half a turn: its (x, y) is the ego's (10 - x, -y)."""
    ego = points([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [2.0, -8.0], [-9.0, 0.0]])
    other = points([[9.4, 0.0], [5.0, -3.0], [8.0, 8.0], [40.0, 0.0]])
    motion = Transform.from_xyz_yaw(10.0, 0.0, 0.0, math.pi)
    truth = match_ground_truth([ego], [other], [motion], 1.5, 2.4)
    # 0.6 m lies nearest to 1, not 0; (5, 3) is 2 m off, neither found nor alone; (2, -8) is met exactly.
    assert truth.pairs[0].nonzero().tolist() == [[1, 0], [3, 2]]
    assert truth.unmatched_a[0].tolist() == [False, False, False, False, True]
    assert truth.unmatched_b[0].tolist() == [False, False, False, True]
    none = match_ground_truth([ego[:0], ego], [other, other[:0]], [motion, motion], 1.5, 2.4)
    assert (
        not none.pairs.any()
        and none.unmatched_a[1].all()
        and none.unmatched_b[0].all()
        and not none.unmatched_b[1].any()
    )


def test_the_loss_by_hand():
    log_p = torch.tensor([[[0.5, 0.1], [0.2, 0.25]]]).log().requires_grad_(True)
    alone = torch.tensor([[0.5, 0.2]]).log(), torch.tensor([[0.5, 0.1]]).log()
    ego, other = points([[0.0, 0.0], [30.0, 0.0]]), points([[0.0, 0.0], [0.0, 30.0]])
    truth = match_ground_truth([ego], [other], [Transform.identity()], 1.0, 1.0)
    layer = Assignment(log_p, *alone)
    wanted_loss = (-math.log(0.5) - (math.log(0.2) + math.log(0.1)) / 2) / 2
    loss = matching_loss([layer, layer], truth)
    assert float(loss) == pytest.approx(wanted_loss, rel=1e-6)
    loss.backward()
    assert log_p.grad is not None and (log_p.grad != 0).tolist() == [[[True, False], [False, False]]]


def test_cached_snapshot_round_trip_and_damaged_file_error(tmp_path):
    made, path = scene(3, agents=3), tmp_path / "a" / "s.safetensors"
    write_cached_snapshot(path, made)
    read = read_cached_snapshot(path)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    for one, two in zip(read.views, made.views, strict=True):
        assert torch.equal(one.tokens.sites.key, two.tokens.sites.key) and one.tokens.grid == GRID
        torch.testing.assert_close(one.tokens.features, two.tokens.features, atol=2e-3, rtol=1e-3)
        assert torch.equal(one.boxes.center, two.boxes.center)
    assert torch.equal(read.world_from_agent.translation, made.world_from_agent.translation)
    both = make_pair(read, 1, 2)
    moved = both.ego_from_other.apply(both.other.boxes.center.double())[:, :2]
    assert float(torch.cdist(both.ego.boxes.center[:, :2].double(), moved).amin(1).max()) < 1e-4
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(RecordingError, match="not a whole file of views"):
        read_cached_snapshot(path)


def test_views_are_cached_once_per_detector_fingerprint(toy, tmp_path, monkeypatch):
    recording = toy(agents_n=2, frames=3, points_per_car=20, ground_points=60)
    assert select_snapshots(recording, 2) == [("toy_0", 0), ("toy_0", 2), ("toy_1", 0), ("toy_1", 2)]
    torch.manual_seed(0)
    detector = Detector(COSTR_TINY).eval()
    detector.fingerprint = bytes(range(8))
    first = next(build_cache(recording, detector, tmp_path, 2))
    assert first.folder.name == "0001020304050607" and len(first.snapshots) == 1
    cache = list(build_cache(recording, detector, tmp_path, 2))[-1]
    seen = cache.load_snapshot(1)
    assert len(seen.views) == 2 and seen.views[0].tokens.features.shape[1] == 32
    truth = recording.snapshot("toy_0", 2).truth
    assert torch.equal(seen.world_from_agent.translation, truth.world_from_agent.translation)
    monkeypatch.setattr("manyeyes.training.pose.feakm_cache.PerceptionCache.process", None)
    assert list(build_cache(recording, detector, tmp_path, 2))[-1] == cache
    with pytest.raises(RecordingError, match="matching needs two"):
        select_snapshots(toy(agents_n=1))


def test_an_interrupted_run_ends_with_the_same_result(cache, tmp_path, check_resumption):
    check_resumption(lambda: FeakmTask(TINY, cache, 3), tmp_path)


def test_training_writes_weights_and_a_log(cache, tmp_path):
    reports = []
    path = Trainer(FeakmTask(TINY, cache, 1), tmp_path / "run").run({"command": "x"}, reports.append)
    lines = [json.loads(line) for line in (path.parent / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4] == [p.step for p in reports]
    assert set(lines[0]) == {"step", "loss", "lr", "recall", "precision"}
    assert load(path).config == TINY.net
    assert {p.name for p in path.parent.iterdir()} == {"last.pt", "log.jsonl", "weights.safetensors"}


def test_augmentation_moves_points_and_keeps_truth(cache):
    plain = FeakmTask(TINY, cache)
    task = FeakmTask(replace(TINY, augment=KeypointAugmentConfig(max_drop_fraction=0.5)), cache)
    torch.manual_seed(0)
    model = task.make_model()
    pairs = [cache.draw(0, i) for i in range(2)]
    ego, other, motions = task._keypoints(model, pairs, 0)
    full = plain._keypoints(model, pairs, 0)[0]
    assert sum(map(len, ego)) < sum(map(len, full))
    truth = match_ground_truth(ego, other, motions, 1.5, 2.4)
    assert truth.pairs.any() and truth.unmatched_a.any()
    moved = task._perturb(ego, "ego", 0)
    assert float((moved[0].xy - ego[0].xy).abs().max()) > 1
    assert float((torch.cdist(moved[0].xy, moved[0].xy) - torch.cdist(ego[0].xy, ego[0].xy)).abs().max()) < 2
    assert all(torch.equal(a.xy, b.xy) for a, b in zip(plain._perturb(full, "ego", 0), full, strict=True))


def test_batch_can_be_overfitted_and_gives_the_pose(cache, tmp_path):
    config = replace(TINY, steps=150, batch=4, learning_rate=3e-3, warmup_steps=5, ema_decay=0.9)
    run = Trainer(FeakmTask(config, cache, 0), tmp_path)
    first, *_, last = [run.advance() for _ in range(150)]
    assert first.loss > 3 * last.loss and min(last.terms.values()) > 0.95
    net = run.average.eval()
    for both in cache.pairs():
        ego, other = (Landmarks.of_keypoints(points) for points in net.describe([both.ego, both.other]))
        estimate = FeakmCorrector.of(net)(ego, other, None)
        assert estimate.status.has_estimate
        off = estimate.pose - project_to_se2(both.ego_from_other)
        assert math.hypot(off[0], off[1]) < 0.2


def test_the_published_net_takes_a_step_and_resumes(cache, tmp_path):
    """All its layers and widths but the lists' length, which costs time alone."""
    net = replace(FEAKM_PAPER, keypoints=DenseKeypointConfig(CHANNELS, num_keypoints=12))
    config = replace(FEAKM_TRAINING_PRESETS["feakm-paper"], net=net, batch=1, steps=2)
    run = Trainer(FeakmTask(config, cache, 0), tmp_path)
    assert sum(p.numel() for p in run.model.parameters()) > 14_900_000
    before = run.model.matcher.self_blocks[0].qkv.weight.clone()
    assert math.isfinite(run.advance().loss)
    assert not torch.equal(before, run.model.matcher.self_blocks[0].qkv.weight)
    run.save()
    assert Trainer(FeakmTask(config, cache, 0), tmp_path).advance().step == 2


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match="match_radius_m <= unmatched_radius_m"):
        replace(TINY, match_radius_m=3.0)


DENSE = DenseKeypointConfig(CHANNELS, (8, 8, 16), 16, min_score=0.0, num_keypoints=16)


@pytest.mark.parametrize("keypoints", [TINY.net.keypoints, DENSE], ids=["boxes", "dense"])
def test_a_run_goes_on_on_another_device_and_back(cache, tmp_path, device, keypoints):
    config = replace(TINY, net=replace(TINY.net, keypoints=keypoints), augment=KeypointAugmentConfig())
    whole = Trainer(FeakmTask(config, cache, 3), tmp_path / "whole")
    progress = [whole.advance() for _ in range(3)]
    moved = []
    for kind in ("cpu", device, "cpu"):
        run = Trainer(FeakmTask(config, cache, 3), tmp_path / "moved", kind)
        assert run.step == len(moved) and all(p.device == run.device for p in run.model.parameters())
        moved.append(run.advance())
        run.save()
    assert [p.loss for p in moved] == pytest.approx([p.loss for p in progress], rel=1e-3)
    assert moved[1].terms == progress[1].terms


@pytest.mark.parametrize("keypoints", [TINY.net.keypoints, DENSE], ids=["boxes", "dense"])
def test_views_enter_and_keypoints_and_matches_leave_on_the_cpu(cache, device, keypoints):
    torch.manual_seed(0)
    ours = FeakmNet(replace(TINY.net, keypoints=keypoints)).eval()
    theirs = copy.deepcopy(ours).to(device)
    both = cache.draw(0, 0)
    found = []
    for net in (ours, theirs):
        with torch.no_grad():
            points = net.describe([both.ego, both.other])
        batches = [KeypointBatch.of([one]) for one in points]
        found.append((points, net.match(*batches)))
    (mine, matched), (its, rematched) = found
    assert theirs.device == device and len(mine[0]) > 5
    for a, b in zip(mine, its, strict=True):
        assert b.descriptor.device.type == b.boxes.center.device.type == "cpu" and type(b.descriptor) is torch.Tensor
        assert torch.equal(a.xy, b.xy) and torch.allclose(a.descriptor, b.descriptor, atol=1e-5)
    assert rematched.pairs.device.type == "cpu" and torch.equal(matched.pairs, rematched.pairs)
    assert torch.allclose(matched.probability, rematched.probability, atol=1e-5)
