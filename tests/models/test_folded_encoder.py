# SPDX-License-Identifier: Apache-2.0
"""The chain of compiled calls gives what the folded layers give one by one: tokens, pruning decisions and sites."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from manyeyes.datatypes import BevGrid, PointCloud, SparseBev
from manyeyes.models.detector.encoder import EncoderConfig, EncoderOutput, SparseEncoder
from manyeyes.models.detector.layers import ActiveNorm, DownLayer, SubmanifoldLayer, SubmanifoldStage, UpLayer
from manyeyes.models.detector.pillars import PillarEncoder
from manyeyes.models.detector.pruning import FocalPrune

# Rows and columns are odd at several strides, and differ.
GRID = BevGrid(-25.6, -14.8, -3.0, 25.2, 25.2, 5.0)
CONFIG = EncoderConfig((16, 16, 32, 32, 32, 32), (0, 2, 1, 1, 2, 1), prune_strides=(2, 4), head_stride=4)


def _pillars(clouds: list[PointCloud]) -> SparseBev:
    torch.manual_seed(0)
    with torch.no_grad():
        return PillarEncoder(GRID, 16, "moments").eval()(clouds)


def _cloud(seed: int, n: int = 500) -> PointCloud:
    random = torch.Generator().manual_seed(seed)
    middles = torch.rand(12, 3, generator=random) * torch.tensor([48.0, 38.0, 1.0]) - torch.tensor([24.0, 14.0, 0.0])
    spread = torch.randn(n, 3, generator=random) * torch.tensor([1.5, 1.5, 0.3])
    return PointCloud.of(middles[torch.arange(n) % 12] + spread)


def _folded(config: EncoderConfig) -> SparseEncoder:
    torch.manual_seed(1)
    encoder = SparseEncoder(16, config).eval().requires_grad_(False)
    for layer in encoder.modules():
        if isinstance(layer, ActiveNorm):
            assert layer.running_mean is not None
            assert layer.running_var is not None
            layer.running_mean.normal_(0.0, 0.1)
            layer.running_var.uniform_(0.5, 1.5)
        if isinstance(layer, FocalPrune):
            layer.score.bias.zero_()
    for layer in reversed(list(encoder.modules())):
        if isinstance(layer, SubmanifoldLayer | SubmanifoldStage | DownLayer | UpLayer | SparseEncoder):
            layer.fold()
    return encoder


@torch.no_grad()
def _encode_twice(encoder: SparseEncoder, x: SparseBev, threshold: float) -> tuple[EncoderOutput, EncoderOutput]:
    """Return the outputs of the chain, and of the layers one by one."""
    chain = encoder(x, threshold)
    encoder.folded = None
    return chain, encoder(x, threshold)


@pytest.mark.parametrize("threshold", (0.0, 0.5))
@pytest.mark.parametrize(
    "change",
    (
        {},
        {"head_stride": 2},
        {"head_stride": 8},
        {"use_coarse_strides": False},
        {"token_channels": 16},
        {"prune_strides": (8, 16)},
    ),
)
def test_the_chain_equals_the_layers(change: dict[str, Any], threshold: float) -> None:
    encoder = _folded(replace(CONFIG, **change))
    assert encoder.folded is not None
    ours, theirs = _encode_twice(encoder, _pillars([_cloud(0), _cloud(1)]), threshold)
    assert torch.equal(ours.tokens.sites.key, theirs.tokens.sites.key)
    assert ours.tokens.grid == theirs.tokens.grid == GRID.at(encoder.config.head_stride)
    assert ours.tokens.sites.batch_size == 2
    assert torch.equal(ours.tokens.features, theirs.tokens.features)
    assert float(theirs.tokens.features.std()) > 0.01
    assert ours.sites_per_stride == theirs.sites_per_stride
    assert len(ours.pruned) == len(theirs.pruned) > 0
    for one, other in zip(ours.pruned, theirs.pruned):
        assert torch.equal(one.sites.key, other.sites.key)
        assert one.sites.grid == other.sites.grid
        assert torch.allclose(one.logit, other.logit, atol=1e-5)
    if threshold:
        whole = encoder(_pillars([_cloud(0), _cloud(1)]), 0.0)
        assert sum(theirs.sites_per_stride) < sum(whole.sites_per_stride)


def test_a_cloud_without_points_has_no_tokens() -> None:
    ours, theirs = _encode_twice(_folded(CONFIG), _pillars([PointCloud.of(torch.zeros(0, 3))]), 0.1)
    assert len(ours.tokens.sites) == len(theirs.tokens.sites) == 0
    assert ours.tokens.features.shape == theirs.tokens.features.shape


def test_sites_that_dilate_have_no_chain() -> None:
    assert _folded(replace(CONFIG, dilating=True)).folded is None


def test_gradients_take_the_layers() -> None:
    encoder = _folded(CONFIG)
    x = _pillars([_cloud(0)])
    features = x.features.clone().requires_grad_(True)
    encoder(x.with_features(features), 0.0).tokens.features.sum().backward()
    assert features.grad is not None
    assert float(features.grad.abs().sum()) > 0
