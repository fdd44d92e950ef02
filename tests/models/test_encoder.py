# SPDX-License-Identifier: Apache-2.0
"""The sparse encoder: the merge of Eq. 3, every head stride, pruning inside it, and clouds without points."""

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import BevGrid, ConfigError, PointCloud, SparseBev
from manyeyes.models.detector.encoder import STRIDES, EncoderConfig, SparseEncoder
from manyeyes.models.detector.pillars import PillarEncoder

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0)
CONFIG = EncoderConfig((8, 8, 12, 16, 16, 16), (1, 1, 1, 1, 1, 1), prune_strides=(4,), head_stride=8)


def pillars(clouds: list[PointCloud]) -> SparseBev:
    torch.manual_seed(0)
    return PillarEncoder(GRID, 8, "moments").eval()(clouds)


def clumps(seed: int, n: int = 400) -> PointCloud:
    random = torch.Generator().manual_seed(seed)
    middles = torch.rand(8, 3, generator=random) * torch.tensor([44.0, 44.0, 1.0]) - torch.tensor([22.0, 22.0, 0.0])
    spread = torch.randn(n, 3, generator=random) * torch.tensor([1.5, 1.5, 0.3])
    return PointCloud.of(middles[torch.arange(n) % 8] + spread)


def encoder(config: EncoderConfig) -> SparseEncoder:
    torch.manual_seed(1)
    return SparseEncoder(8, config).eval().requires_grad_(False)


def test_the_merge_sums_three_strides_on_the_finest():
    model, caught = encoder(CONFIG), {}
    for stride, stage in zip(STRIDES, model.stages):
        stage.register_forward_hook(lambda _, __, out, s=stride: caught.__setitem__(s, out))
    model.post_merge.register_forward_pre_hook(lambda _, args: caught.__setitem__("merged", args[0]))
    encoded = model(pillars([clumps(0), clumps(1)]), 0.0)
    wanted: dict[tuple[int, int, int], torch.Tensor] = {}
    for stride in (8, 16, 32):
        level = caught[stride]
        for b, (y, x), f in zip(level.sites.batch.tolist(), level.sites.yx.tolist(), level.features):
            at = (b, y * stride // 8, x * stride // 8)
            wanted[at] = wanted.get(at, torch.zeros(16)) + f
    merged = caught["merged"]
    assert merged.grid == GRID.at(8)
    got = [(b, *yx) for b, yx in zip(merged.sites.batch.tolist(), merged.sites.yx.tolist())]
    assert got == sorted(wanted)
    assert torch.allclose(merged.features, torch.stack([wanted[at] for at in got]), atol=1e-5)
    assert encoded.sites_per_stride[3:] == tuple(len(caught[s].sites) for s in (8, 16, 32))
    # Tokens of the two coarsest strides stand where the finer have none: the merge must have added sites.
    assert len(merged.sites) > len(caught[8].sites)


@pytest.mark.parametrize("head_stride", (2, 4, 8))
def test_tokens_stand_where_the_points_are(head_stride):
    model = encoder(replace(CONFIG, head_stride=head_stride))
    place = torch.tensor([[7.3, -11.9, 0.5], [7.35, -11.85, 0.7]])
    encoded = model(pillars([PointCloud.of(place)]), 0.0)
    assert encoded.tokens.grid == GRID.at(head_stride)
    assert encoded.tokens.features.shape[1] == model.out_channels == CONFIG.channels[STRIDES.index(head_stride)]
    off = (encoded.tokens.sites.xy - place[0, :2]).abs().max(1).values
    assert float(off.min()) <= head_stride * GRID.pillar
    if head_stride < 8:
        assert len(off) == 1


@pytest.mark.parametrize("dilating", (False, True))
def test_batches_do_not_mix(dilating):
    model = encoder(replace(CONFIG, head_stride=4, dilating=dilating))
    together = model(pillars([clumps(0), clumps(1)]), 0.0).tokens
    for b in (0, 1):
        alone = model(pillars([clumps(b)]), 0.0).tokens
        rows = together.sites.batch == b
        assert torch.equal(together.sites.yx[rows], alone.sites.yx)
        assert torch.allclose(together.features[rows], alone.features, atol=1e-5)


def test_dilating_has_more_sites():
    counts = [encoder(replace(CONFIG, dilating=d))(pillars([clumps(0)]), 0.0).sites_per_stride for d in (False, True)]
    assert counts[0][0] == counts[1][0] and all(a < b for a, b in zip(counts[0][1:], counts[1][1:]))


def test_pruned_cells_are_absent_at_all_coarser_strides():
    model = encoder(CONFIG)
    x = pillars([clumps(0)])
    whole = model(x, 0.0)
    logit = whole.pruned[0].logit.detach()
    threshold = float(torch.sigmoid(logit.median()))
    some = model(x, threshold)
    kept = int((torch.sigmoid(logit) > threshold).sum())
    assert some.sites_per_stride[:3] == (*whole.sites_per_stride[:2], kept) and kept == len(logit) // 2
    assert all(a <= b for a, b in zip(some.sites_per_stride[3:], whole.sites_per_stride[3:]))
    assert len(some.pruned[0].sites) == len(logit)


@pytest.mark.parametrize("head_stride", (2, 4, 8))
def test_empty_or_fully_pruned_input_gives_no_tokens(head_stride):
    model = encoder(replace(CONFIG, head_stride=head_stride))
    for cloud, threshold in ((PointCloud.of(torch.zeros(0, 3)), 0.0), (clumps(0), 1.0)):
        tokens = model(pillars([cloud]), threshold).tokens
        if head_stride > 2:
            assert len(tokens.sites) == 0
        assert tokens.features.shape[1] == model.out_channels and bool(torch.isfinite(tokens.features).all())


def test_settings_that_do_not_fit_are_named():
    with pytest.raises(ConfigError, match="six channels"):
        EncoderConfig(channels=(1, 2, 3))
    with pytest.raises(ConfigError, match=r"must be equal; got \(128, 64, 128\)"):
        EncoderConfig(channels=(32, 64, 128, 128, 64, 128))
    with pytest.raises(ConfigError, match="head_stride is 2, 4 or 8; got 16"):
        EncoderConfig(head_stride=16)
