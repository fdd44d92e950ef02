# SPDX-License-Identifier: Apache-2.0
"""Density-aware routing (CoSTr Eq. 5): what shared weights do not notice and separate ones do."""

import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.models.detector.transformer import (
    AttentionConfig,
    RoutedBlock,
    WindowBlock,
    WindowTransformer,
    density_levels,
)
from manyeyes.ops.window_attention import attention_cost, plan_windows, window_ids

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
THIN, DENSE = 6, 40


def places(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Windows of 12.8 m with 6, 12 and 40 tokens each, and one with more than its 64 cells, at places on no lattice."""
    random = torch.Generator().manual_seed(seed)
    corners = [(0, 0), (1, 0), (2, 0), (0, 1), (3, 3)]
    many = [THIN, 12, DENSE, THIN, 80]
    parts = [torch.rand(n, 2, generator=random) * 12.8 + torch.tensor(c) * 12.8 - 25.6 for c, n in zip(corners, many)]
    xy = torch.cat(parts)
    return xy, torch.zeros(len(xy), dtype=torch.int64)


def features(n: int) -> Tensor:
    return torch.randn(n, CHANNELS, generator=torch.Generator().manual_seed(1))


def transformer(**settings) -> WindowTransformer:
    torch.manual_seed(0)
    return WindowTransformer(CHANNELS, AttentionConfig(heads=2, **settings)).eval()


def test_levels_by_hand():
    # Of 64 cells up to 8 tokens are Low, up to 16 Medium.
    window = torch.repeat_interleave(torch.tensor([5, 2, 9, 7, 1]), torch.tensor([8, 9, 16, 17, 70]))
    wanted = torch.repeat_interleave(torch.tensor([0, 1, 1, 2, 2]), torch.tensor([8, 9, 16, 17, 70]))
    assert torch.equal(density_levels(window, 64, (0.125, 0.25)), wanted)
    assert density_levels(window, 64, (9.0, 9.0)).max() == 0 and density_levels(window, 64, (0.0, 0.0)).min() == 2
    assert len(density_levels(window[:0], 64, (0.125, 0.25))) == 0


@pytest.mark.parametrize("gradients", (False, True))
def test_with_shared_weights_moving_the_thresholds_changes_nothing(gradients):
    xy, batch = places()
    x = features(len(xy))
    with torch.set_grad_enabled(gradients):
        outs = [
            transformer(density_thresholds=levels)(x, xy, batch, GRID)
            for levels in ((0.125, 0.25), (0.0, 0.01), (0.6, 2.0))
        ]
    assert all(torch.equal(outs[0], out) for out in outs[1:])


@pytest.mark.parametrize("gradients", (False, True))
def test_three_levels_of_equal_weights_are_one(gradients):
    """The letter with one set of weights is the default, window by window, whatever the thresholds."""
    xy, batch = places()
    shared, x = transformer(), features(len(xy))
    for levels in ((0.125, 0.25), (0.05, 0.9)):
        routed = transformer(separate_weights=True, density_thresholds=levels)
        for one, three in zip(shared.blocks, routed.blocks):
            assert isinstance(one, WindowBlock) and isinstance(three, RoutedBlock)
            for block in three.levels:
                block.load_state_dict(one.state_dict())
        with torch.set_grad_enabled(gradients):
            assert torch.allclose(routed(x, xy, batch, GRID), shared(x, xy, batch, GRID), atol=1e-6)


def test_each_windows_tokens_go_through_the_weights_of_its_level():
    xy, batch = places()
    x = features(len(xy))
    (block,) = transformer(separate_weights=True, blocks=1).blocks
    assert isinstance(block, RoutedBlock)
    ids = window_ids(xy, batch, (GRID.x_min, GRID.y_min), 8 * GRID.cell_size_m)
    level = density_levels(ids, 64, (0.125, 0.25))
    assert torch.bincount(level).tolist() == [2 * THIN, 12, DENSE + 80]
    with torch.no_grad():
        out = block(x, xy, batch, GRID)
        for number, one in enumerate(block.levels):
            alone = one(x, xy, batch, GRID)
            same = (alone - out).abs().amax(1) < 1e-5
            assert torch.equal(same, level == number)


def test_a_threshold_that_moves_sends_a_window_through_other_weights():
    xy, batch = places()
    x = features(len(xy))
    a, b = (
        transformer(separate_weights=True, blocks=1),
        transformer(separate_weights=True, blocks=1, density_thresholds=(0.2, 0.25)),
    )
    with torch.no_grad():
        moved = (a(x, xy, batch, GRID) - b(x, xy, batch, GRID)).abs().amax(1) > 1e-4
    middle = torch.zeros(len(xy), dtype=torch.bool)
    middle[THIN : THIN + 12] = True
    assert torch.equal(moved, middle)


def test_every_level_learns_from_its_own_windows_alone():
    xy, batch = places()
    model = transformer(separate_weights=True, blocks=1)
    model(features(len(xy))[:THIN], xy[:THIN], batch[:THIN], GRID).sum().backward()
    low, medium, high = model.blocks[0].levels
    assert all(p.grad is not None for p in low.parameters())
    assert not any(p.grad is not None for p in [*medium.parameters(), *high.parameters()])


@pytest.mark.parametrize("separate", (False, True))
def test_no_tokens_and_one_token(separate):
    model = transformer(separate_weights=separate)
    xy, batch = places()
    x = features(len(xy))
    with torch.no_grad():
        assert model(x[:0], xy[:0], batch[:0], GRID).shape == (0, CHANNELS)
        assert bool(torch.isfinite(model(x[:1], xy[:1], batch[:1], GRID)).all())


@pytest.mark.parametrize("separate", (False, True))
def test_invariant_to_permutation_and_shifts_by_whole_windows(separate):
    """Outputs do not depend on token order, and only on the position within the window."""
    model, (xy, batch) = transformer(separate_weights=separate), places()
    x, order = features(len(xy)), torch.randperm(len(xy), generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        out = model(x, xy, batch, GRID)
        assert torch.allclose(model(x[order], xy[order], batch, GRID), out[order], atol=1e-5)
        moved = xy + torch.tensor([3.0, -2.0]) * 8 * GRID.cell_size_m
        assert torch.allclose(model(x, moved, batch, GRID), out, atol=1e-3)
        aside = xy + torch.tensor([1.0, 0.0])
        assert not torch.allclose(model(x, aside, batch, GRID), out, atol=1e-3)


def test_gradients_and_inference_agree():
    """A1: padded batches, where gradients are asked for, and compiled loops, where not, are the same attention."""
    model, (xy, batch) = transformer(), places()
    x = features(len(xy))
    with torch.no_grad():
        fast = model(x, xy, batch, GRID)
    assert torch.allclose(model(x, xy, batch, GRID), fast, atol=1e-5)


def test_the_counters_of_eq_14_order_as_they_must():
    xy, batch = places()
    ids = window_ids(xy, batch, (GRID.x_min, GRID.y_min), 8 * GRID.cell_size_m)
    cost = attention_cost(plan_windows(ids, ids), 8, math.prod(GRID.shape))
    assert cost.exact == 2 * THIN**2 + 12**2 + DENSE**2 + 80**2
    assert cost.exact <= cost.padded and cost.bound == 64 * len(xy) and cost.dense == 64 * 32 * 32


def test_levels_that_fall_are_an_error():
    with pytest.raises(
        ConfigError, match=r"density_thresholds are two ascending fractions of a window's cells; got \(0.3, 0.2\)"
    ):
        AttentionConfig(density_thresholds=(0.3, 0.2))
