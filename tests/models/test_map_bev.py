# SPDX-License-Identifier: Apache-2.0
"""An agent's sensors to its ground: the raster, and what counts as seen."""

import pytest
import torch

from manyeyes.datatypes import BevGrid, ConfigError, PointCloud, Transform
from manyeyes.datatypes.camera import Camera, CameraImage
from manyeyes.models.maps.bev import BevConfig, CameraBev, LidarBev, rasterise_clouds
from manyeyes.models.maps.image_encoder import ImageEncoderConfig
from manyeyes.models.maps.view_transform import DepthBins
from manyeyes.ops.voxelize import MOMENTS

GRID = BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5)
CONFIG = BevConfig(
    GRID,
    ("lidar", "camera"),
    channels=16,
    raster_channels=8,
    raster_blocks=(1, 1),
    image_encoder=ImageEncoderConfig((1, 1), 8, channels=16),
    image_size=(48, 64),
    depth_bins=DepthBins(1.0, 13.0, 7),
)


def photo(value=100):
    ahead = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    k = torch.tensor([[32.0, 0, 32], [0, 32.0, 24], [0, 0, 1]], dtype=torch.float64)
    pose = Transform(ahead, torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64))
    return CameraImage(Camera(k, pose, 64, 48), torch.full((3, 48, 64), value, dtype=torch.uint8))


def test_the_raster_holds_moments_where_there_are_returns():
    bright = PointCloud.of(torch.tensor([[0.1, 0.2, 0.0], [0.3, 0.2, 0.5]]), torch.tensor([0.2, 0.6]))
    raster, hit = rasterise_clouds([PointCloud.of(torch.zeros(0, 3)), bright], GRID)
    assert raster.shape == (2, len(MOMENTS) + 1, 32, 32) and int(hit.sum()) == 1 and bool(hit[1, 16, 16])
    cell = dict(zip(MOMENTS, raster[1, :, 16, 16].tolist()))
    assert cell["mean_intensity"] == pytest.approx(4 * 0.4) and cell["max_intensity"] == pytest.approx(3 * 0.6)
    assert cell["max_z"] == pytest.approx(0.5 * 0.5) and float(raster[1, -1].sum()) == 1
    assert float(raster[0].abs().max()) == 0


def test_a_cell_is_observed_where_a_return_lies_in_or_beside_it():
    net = LidarBev(CONFIG)
    features, seen = net([PointCloud.of(torch.tensor([[0.1, 0.1, 0.0]])), PointCloud.of(torch.zeros(0, 3))])
    assert features.shape == (2, 16, 16, 16) and seen.shape == (2, 16, 16)
    # The return lies in pillar 16, the middle of token 8; tokens 7 and 9 lie two pillars away.
    assert sorted(map(tuple, seen[0].nonzero().tolist())) == [(r, c) for r in (7, 8, 9) for c in (7, 8, 9)]
    assert not bool(seen[1].any())


def test_frame_is_independent_of_the_rest_of_its_batch():
    generator = torch.Generator().manual_seed(1)
    clouds = [PointCloud.of(torch.randn(200, 3, generator=generator) * 3) for _ in range(3)]
    net = LidarBev(CONFIG).eval()
    assert torch.allclose(net(clouds)[0][1], net(clouds[1:2])[0][0], atol=1e-5)


@pytest.mark.parametrize("view_transform", ["depth", "ground"])
def test_image_features_reach_the_ground_ahead_and_have_gradients(view_transform):
    net = CameraBev(BevConfig(**{**vars(CONFIG), "view_transform": view_transform}))
    features, seen = net([[photo()], [], [photo(10), photo(200)]])
    assert features.shape == (3, 16, 16, 16)
    assert not bool(seen[1].any()) and bool(seen[0].any()) and not bool(seen[0, :, :8].any())
    features.square().sum().backward()
    first = next(net.encoder.parameters())
    assert first.grad is not None and float(first.grad.abs().max()) > 0


def test_batch_without_images():
    features, seen = CameraBev(CONFIG)([[], []])
    assert features.shape == (2, 16, 16, 16) and not bool(seen.any())


def test_unknown_sensors_and_strided_grids_are_refused():
    with pytest.raises(ConfigError, match="lidar, camera"):
        BevConfig(GRID, ("radar",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="stride 1"):
        BevConfig(GRID.at(2))
