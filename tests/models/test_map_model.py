# SPDX-License-Identifier: Apache-2.0
"""The map model: invariance to frame order and empty frames, shared ground of sensors, export, and round trips to
disk.
"""

import dataclasses
import math

import pytest
import torch

from manyeyes.datatypes import BevGrid, CheckpointError, ConfigError, PointCloud, Transform
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.models import checkpoint
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.image_encoder import ImageEncoderConfig
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.models.maps.presets import FORMAT, MAP_MODELS, get_map_model_config
from manyeyes.models.maps.view_transform import DepthBins

TINY = MapModelConfig(
    BevConfig(
        BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5),
        channels=16,
        raster_channels=8,
        raster_blocks=(1, 1),
        image_encoder=ImageEncoderConfig((1, 1), 8, channels=16),
        image_size=(48, 64),
        depth_bins=DepthBins(1.0, 13.0, 7),
    ),
    BevGrid(-16.0, -8.0, -1.0, 16.0, 8.0, 1.0, pillar=1.0),
    token_channels=8,
    neck_blocks=(1, 1),
    head=MapHeadConfig(
        num_queries=6, num_points=5, num_one_to_many_queries=4, channels=16, feedforward_channels=32, layers=2, heads=4
    ),
)


def clouds(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([3.0, 3.0, 0.2])
    return [PointCloud.of(torch.randn(150, 3, generator=generator) * scale) for _ in range(count)]


def poses(*values):
    return Transform.stack([Transform.from_xyz_yaw(*value) for value in values])


FOUR = poses((0, 0, 0, 0.1), (4, 1, 0, math.pi), (-5, 0, 0, 1.0), (2, -3, 0, -0.5))


@pytest.fixture
def photo():
    ahead = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    k = torch.tensor([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]], dtype=torch.float64)
    pose = Transform(ahead, torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64))
    return CameraImage(Camera(k, pose, 64, 48), torch.full((3, 48, 64), 100, dtype=torch.uint8))


@pytest.fixture(scope="module")
def mapper():
    torch.manual_seed(0)
    net = MapModel(TINY).requires_grad_(False)
    # Its norms know how features are spread, as after training; nothing else is learnt.
    for seed in range(30):
        net.predict_elements(
            net.fuse(net.extract_features(clouds(4, seed)).tokens, FOUR, torch.tensor([0, 0, 1, 1]), 2)
        )
    return net.eval()


def test_tokens_cover_the_observed_ground(mapper):
    features = mapper.extract_features(clouds(2))
    assert features.tokens.features.shape[1] == 8 and features.tokens.sites.batch_size == 2
    assert features.tokens.grid == TINY.bev.token_grid and 20 < len(features.tokens.sites) < 2 * 256
    assert features.line_logits.shape == (len(features.tokens.sites), 3) and bool(
        ((features.cell_score > 0) & (features.cell_score < 1)).all()
    )


def test_fusion_is_invariant_to_frame_order(mapper):
    seen, tile = clouds(4), torch.zeros(4, dtype=torch.int64)
    order = [2, 0, 3, 1]
    a = mapper.fuse(mapper.extract_features(seen).tokens, FOUR, tile, 1)
    shuffled = mapper.extract_features([seen[i] for i in order]).tokens
    b = mapper.fuse(shuffled, FOUR[torch.tensor(order)], tile, 1)
    assert torch.allclose(a, b, atol=1e-5) and float(a.std()) > 0


def test_frame_without_tile_coverage_changes_nothing(mapper):
    seen = clouds(3)
    a = mapper.fuse(mapper.extract_features(seen[:2]).tokens, FOUR[:2], torch.zeros(2, dtype=torch.int64), 1)
    away = poses((0, 0, 0, 0.1), (4, 1, 0, math.pi), (500, 0, 0, 0))
    b = mapper.fuse(mapper.extract_features(seen).tokens, away, torch.zeros(3, dtype=torch.int64), 1)
    assert torch.allclose(a, b, atol=1e-6)
    near = poses((0, 0, 0, 0.1), (4, 1, 0, math.pi), (-6, 0, 0, 0))
    assert not torch.allclose(
        a, mapper.fuse(mapper.extract_features(seen).tokens, near, torch.zeros(3, dtype=torch.int64), 1)
    )


def test_frames_of_other_tiles_change_nothing(mapper):
    seen = clouds(4)
    both = mapper.fuse(mapper.extract_features(seen).tokens, FOUR, torch.tensor([1, 0, 1, 0]), 3)
    one = mapper.fuse(
        mapper.extract_features([seen[1], seen[3]]).tokens,
        FOUR[torch.tensor([1, 3])],
        torch.zeros(2, dtype=torch.int64),
        1,
    )
    assert torch.allclose(both[0], one[0], atol=1e-5)
    # The last tile has no frame, so all of it is unobserved.
    blind = mapper.extract_features([PointCloud.of(torch.zeros(0, 3))]).tokens
    empty = mapper.fuse(blind, FOUR[:1], torch.zeros(1, dtype=torch.int64), 1)
    assert torch.allclose(both[2], empty[0], atol=1e-5)


def test_fusion_is_invariant_to_a_common_motion(mapper):
    tokens, tile = mapper.extract_features(clouds(4)).tokens, torch.zeros(4, dtype=torch.int64)
    world_from_tile = Transform.from_xyz_yaw(3000.0, -900.0, 0.0, 2.2)
    world_from_agent = world_from_tile @ FOUR
    back = world_from_tile.inverse() @ world_from_agent
    assert torch.allclose(mapper.fuse(tokens, FOUR, tile, 1), mapper.fuse(tokens, back, tile, 1), atol=1e-4)


def test_predicted_elements_depend_on_the_input(mapper):
    tokens = mapper.extract_features(clouds(2)).tokens
    ground = mapper.fuse(tokens, FOUR[:2], torch.tensor([0, 1]), 2)
    raw = mapper.predict_elements(ground)[-1]
    assert raw.logit.shape == (2, 6, 3) and not torch.allclose(raw.logit[0], raw.logit[1], atol=1e-3)
    assert mapper.predict_elements(ground, "many")[-1].logit.shape == (2, 4, 3)


def test_scores_are_calibrated_in_evaluation_and_not_in_training():
    net = MapModel(TINY).eval().requires_grad_(False)
    ground = torch.randn(1, TINY.head.channels, 16, 32)
    plain = net.predict_elements(ground)
    net.logit_scale.copy_(torch.tensor([1.0, 2.0, 0.5]))
    net.logit_shift.copy_(torch.tensor([0.0, 0.3, -1.0]))
    *before, last = net.predict_elements(ground)
    assert torch.equal(last.logit, plain[-1].logit * net.logit_scale + net.logit_shift) and torch.equal(
        last.point, plain[-1].point
    )
    assert all(torch.equal(a.logit, b.logit) for a, b in zip(before, plain))
    # Training uses uncalibrated logits. The norms stay in evaluation mode, so that nothing else differs.
    net.training = True
    assert torch.equal(net.predict_elements(ground)[-1].logit, plain[-1].logit)


def test_either_sensor_suffices(photo):
    torch.manual_seed(1)
    both = MapModel(dataclasses.replace(TINY, bev=dataclasses.replace(TINY.bev, sensors=("lidar", "camera"))))
    seen = clouds(1)
    together = both.extract_features(seen, [[photo]]).tokens.sites.key
    lidar, camera = both.extract_features(seen).tokens.sites.key, both.extract_features((), [[photo]]).tokens.sites.key
    assert set(together.tolist()) == set(lidar.tolist()) | set(camera.tolist())
    assert len(camera) > 0 and len(together) > len(lidar)
    with pytest.raises(ConfigError, match="lidar, camera"):
        both.extract_features()


@pytest.mark.slow
def test_the_tile_part_exports(mapper):
    generator = torch.Generator().manual_seed(4)
    features = torch.randn(1, 10, 8, 16, 32, generator=generator)
    seen = torch.rand(1, 10, 16, 32, generator=generator) > 0.5
    program = torch.export.export(mapper, (features, seen))
    for mine, theirs in zip(program.module()(features, seen), mapper(features, seen), strict=True):
        assert torch.allclose(mine, theirs, atol=1e-5)


def test_weights_round_trip_and_are_no_detector(mapper, tmp_path):
    path = tmp_path / "weights.safetensors"
    checkpoint.save(mapper, path, {"towns": ["Town01"]}, format=FORMAT)
    again = checkpoint.load_as(path, FORMAT, MapModelConfig, MapModel)
    assert again.config == TINY and checkpoint.fingerprint(again) == checkpoint.fingerprint(mapper)
    assert checkpoint.read_card(path, FORMAT)["towns"] == ["Town01"]
    with pytest.raises(CheckpointError, match="format"):
        checkpoint.load(path)


def test_presets_have_the_paper_s_sizes():
    paper = get_map_model_config("paper", ("camera",))
    assert paper.tile.shape == (100, 200) and (paper.head.num_queries, paper.head.num_points) == (100, 20)
    assert paper.bev.image_encoder.blocks == (3, 4, 6, 3) and paper.bev.image_encoder.bottleneck
    for config in MAP_MODELS.values():
        tile = config.tile
        assert (tile.x_max - tile.x_min, tile.y_max - tile.y_min) == (120.0, 60.0)
    with pytest.raises(ConfigError, match="tiny, small, paper"):
        get_map_model_config("large")
