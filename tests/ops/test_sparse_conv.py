# SPDX-License-Identifier: Apache-2.0
from itertools import product

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d

from manyeyes.datatypes import BevGrid, ConfigError, ShapeError, Sites, SparseBev
from manyeyes.ops._sparse_conv_kernels import add_products, panels
from manyeyes.ops.sparse_conv import (
    coalesce,
    inverse_conv,
    local_maxima,
    max_pool,
    merge,
    same_sites_map,
    strided_conv,
    strided_map,
    strided_max_pool,
    submanifold_conv,
)
from manyeyes.ops.sparse_index import Window

DENSITIES = ("none", "one", 0.01, 0.1, 0.5, 1.0)


def grid_of(rows: int, columns: int, stride: int = 1) -> BevGrid:
    return BevGrid(0.0, 0.0, -3.0, columns * 0.4, rows * 0.4, 1.0, stride=stride)


def scene(
    density: float | str = 0.3, rows: int = 11, columns: int = 14, batch: int = 2, channels: int = 3, seed: int = 0
) -> SparseBev:
    random = torch.Generator().manual_seed(seed)
    grid = grid_of(rows, columns)
    chance = torch.rand(batch * rows * columns, generator=random)
    mask = (
        {"none": chance < 0, "one": chance == chance.max()}[density] if isinstance(density, str) else chance < density
    )
    key = mask.nonzero()[:, 0]
    features = torch.randn(len(key), channels, generator=random, dtype=torch.float64)
    return SparseBev(features, Sites(key, grid, batch))


def weights(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def read(dense: Tensor, sites: Sites) -> Tensor:
    """Rows of a dense map (B, C, rows, columns) at sites."""
    return dense.permute(0, 2, 3, 1).reshape(-1, dense.shape[1])[sites.key]


def occupied(x: SparseBev) -> Tensor:
    return x.with_features(torch.ones(len(x.sites), 1, dtype=x.features.dtype)).dense()


def assert_near(got: Tensor, wanted: Tensor, tolerance: float = 1e-12) -> None:
    assert got.shape == wanted.shape
    if wanted.numel():
        scale = wanted.abs().max().clamp_min(1e-30)
        assert ((got - wanted).abs().max() / scale) <= tolerance


def leaves(*values: Tensor) -> tuple[Tensor, ...]:
    return tuple(v.detach().clone().requires_grad_() for v in values)


def compare(fast, slow, *values: Tensor, tolerance: float = 1e-12) -> None:
    """Values and gradients of a fast function and its slow twin."""
    results = []
    for function in (fast, slow):
        inputs = leaves(*values)
        out = function(*inputs)
        (out * torch.linspace(0.5, 1.5, out.numel(), dtype=out.dtype).view_as(out)).sum().backward()
        results.append((out.detach(), *(v.grad if v.grad is not None else torch.zeros_like(v) for v in inputs)))
    for got, wanted in zip(*results, strict=True):
        assert_near(got, wanted, tolerance)


@pytest.mark.parametrize(("kernel", "dilation", "density"), [*product((1, 3, 5), (1, 2), DENSITIES)])
def test_submanifold_is_the_masked_dense_convolution(kernel, dilation, density):
    x = scene(density)
    compare(
        lambda f, w, b: submanifold_conv(x.with_features(f), w, b, dilation).features,
        lambda f, w, b: read(
            conv2d(x.with_features(f).dense(), w, b, padding=kernel // 2 * dilation, dilation=dilation), x.sites
        ),
        x.features,
        weights(4, 3, kernel, kernel),
        weights(4, seed=2),
    )
    found = submanifold_conv(x, weights(4, 3, kernel, kernel), None, dilation)
    assert torch.equal(found.sites.key, x.sites.key) and found.features.shape == (len(x.sites), 4)


def test_submanifold_in_float32():
    x = scene(0.4, 40, 50, channels=16)
    w = weights(16, 16, 3, 3)
    got = submanifold_conv(SparseBev(x.features.float(), x.sites), w.float())
    assert got.features.dtype == torch.float32
    assert_near(got.features.double(), read(conv2d(x.dense(), w, padding=1), x.sites), 1e-5)


@pytest.mark.parametrize(
    ("kernel", "stride", "shape", "density"),
    [*product((1, 3, 5), (1, 2), ((11, 14), (8, 7), (1, 1), (2, 9)), ("none", 0.15, 1.0))],
)
def test_dilating_strided_convolution_is_the_dense_one(kernel, stride, shape, density):
    x = scene(density, *shape)
    w, padding = weights(4, 3, kernel, kernel), kernel // 2
    y = strided_conv(x, w, stride=stride, padding=padding, dilating=True)
    reached = (
        conv2d(occupied(x), torch.ones(1, 1, kernel, kernel, dtype=torch.float64), stride=stride, padding=padding) > 0
    )
    assert torch.equal(y.sites.key, reached.flatten().nonzero()[:, 0])
    # Dense zeros outside: the whole maps agree, not only the active cells.
    assert_near(y.dense(), conv2d(x.dense(), w, stride=stride, padding=padding))
    compare(
        lambda f, w: strided_conv(x.with_features(f), w, stride=stride, padding=padding, dilating=True).features,
        lambda f, w: read(conv2d(x.with_features(f).dense(), w, stride=stride, padding=padding), y.sites),
        x.features,
        w,
    )


@pytest.mark.parametrize("shape", ((11, 14), (8, 7), (1, 5)))
def test_parents_are_a_subset_with_the_same_values(shape):
    x, w, b = scene(0.1, *shape), weights(4, 3, 3, 3), weights(4)
    y, wide = strided_conv(x, w, b), strided_conv(x, w, b, dilating=True)
    rows, columns = y.grid.shape
    parents = {(int(n) * rows + int(r) // 2) * columns + int(c) // 2 for n, (r, c) in zip(x.sites.batch, x.sites.yx)}
    assert y.sites.key.tolist() == sorted(parents)
    assert set(y.sites.key.tolist()) <= set(wide.sites.key.tolist())
    assert y.grid == x.grid.at(2)
    compare(
        lambda f, w, b: strided_conv(x.with_features(f), w, b).features,
        lambda f, w, b: read(conv2d(x.with_features(f).dense(), w, b, stride=2, padding=1), y.sites),
        x.features,
        w,
        b,
    )


@pytest.mark.parametrize(("shape", "dilating"), [*product(((11, 14), (8, 7), (1, 1), (6, 6)), (False, True))])
def test_inverse_is_the_transposed_convolution_at_the_finer_sites(shape, dilating):
    x = scene(0.2, *shape)
    y = strided_conv(x, weights(5, 3, 3, 3), dilating=dilating)
    spare = tuple(1 - n % 2 for n in shape)

    def dense(f: Tensor, w: Tensor, b: Tensor) -> Tensor:
        out = conv_transpose2d(y.with_features(f).dense(), w, b, stride=2, padding=1, output_padding=spare)
        assert out.shape[2:] == shape
        return read(out, x.sites)

    compare(
        lambda f, w, b: inverse_conv(y.with_features(f), w, x.sites, b).features,
        dense,
        y.features,
        weights(5, 4, 3, 3),
        weights(4),
    )


def test_inverse_to_sites_that_were_not_its_source():
    x, other = scene(0.3, seed=0), scene(0.3, seed=5)
    y, w = strided_conv(x, weights(5, 3, 3, 3)), weights(5, 4, 3, 3)
    wanted = read(conv_transpose2d(y.dense(), w, stride=2, padding=1, output_padding=(0, 1)), other.sites)
    assert_near(inverse_conv(y, w, other.sites).features, wanted)


def test_full_mask_is_dense_to_the_border():
    x, w = scene(1.0), weights(4, 3, 3, 3)
    assert len(x.sites) == 2 * 11 * 14
    assert_near(submanifold_conv(x, w).dense(), conv2d(x.dense(), w, padding=1))
    assert_near(strided_conv(x, w).dense(), conv2d(x.dense(), w, padding=1, stride=2))


def test_batches_do_not_meet():
    x, w = scene(0.5), weights(4, 3, 3, 3)
    size = 11 * 14

    def alone(n: int) -> SparseBev:
        mine = x.sites.batch == n
        return SparseBev(x.features[mine], Sites(x.sites.key[mine] - n * size, x.grid, 1))

    for layer in (
        lambda v: submanifold_conv(v, w),
        lambda v: strided_conv(v, w),
        lambda v: strided_conv(v, w, dilating=True),
        max_pool,
        strided_max_pool,
        lambda v: inverse_conv(strided_conv(v, w), weights(4, 2, 3, 3), v.sites),
    ):
        assert torch.equal(layer(x).dense(), torch.cat([layer(alone(n)).dense() for n in range(2)]))


def test_order_of_input_rows_does_not_matter():
    x, w = scene(0.5), weights(4, 3, 3, 3)
    order = torch.randperm(len(x.sites), generator=torch.Generator().manual_seed(3))
    y = coalesce(x.features[order], x.sites.key[order], x.grid, 2)
    assert torch.equal(y.sites.key, x.sites.key)
    assert torch.equal(submanifold_conv(y, w).features, submanifold_conv(x, w).features)


def test_no_neighbour_wraps_to_the_next_row_or_batch():
    # Last column of row 2 and first of row 3; last cell of batch 0 and first of batch 1.
    key = torch.tensor([2 * 14 + 13, 3 * 14, 11 * 14 - 1, 11 * 14])
    x = SparseBev(torch.ones(4, 1, dtype=torch.float64), Sites(key, grid_of(11, 14), 2))
    for kernel, dilation in ((3, 1), (5, 1), (3, 2)):
        out = submanifold_conv(x, torch.ones(1, 1, kernel, kernel, dtype=torch.float64), dilation=dilation)
        assert out.features.flatten().tolist() == [1.0] * 4
    assert max_pool(x.with_features(torch.arange(4.0)[:, None])).features.flatten().tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("dilating", (False, True))
def test_gradients_by_finite_differences(dilating):
    x = scene(0.3, 5, 6, channels=2)
    f, w, b = leaves(x.features, weights(2, 2, 3, 3), weights(2))

    def net(f: Tensor, w: Tensor, b: Tensor) -> Tensor:
        y = submanifold_conv(x.with_features(f), w, b)
        z = inverse_conv(strided_conv(y, w, b, dilating=dilating), w, x.sites, b)
        return max_pool(z).features

    assert torch.autograd.gradcheck(net, (f, w, b))
    assert torch.autograd.gradcheck(lambda f: strided_max_pool(x.with_features(f), dilating=dilating).features, (f,))


def brute_pool(f: Tensor, table: Tensor) -> Tensor:
    padded = torch.cat((f, f.new_full((1, f.shape[1]), -torch.inf)))
    return padded[table.long()].amax(1)


def has_ties(f: Tensor, table: Tensor) -> bool:
    """Whether two cells of one window share its maximum."""
    padded = torch.cat((f, f.new_full((1, f.shape[1]), -torch.inf)))[table.long()]
    return bool(((padded == padded.amax(1, keepdim=True)).sum(1) > 1).any())


def test_pools_take_active_cells_only_even_when_all_are_negative():
    x = scene(0.3)
    x = x.with_features(-x.features.abs() - 1)
    pooled = max_pool(x).features
    dense = torch.nn.functional.max_pool2d(
        x.dense().masked_fill(occupied(x) == 0, -torch.inf), kernel_size=3, stride=1, padding=1
    )
    assert bool((pooled <= -1).all())
    assert torch.equal(pooled, read(dense, x.sites))
    strided = strided_max_pool(x)
    dense = torch.nn.functional.max_pool2d(
        x.dense().masked_fill(occupied(x) == 0, -torch.inf), kernel_size=3, stride=2, padding=1
    )
    assert torch.equal(strided.features, read(dense, strided.sites))


def test_pool_gradients_are_shared_among_ties():
    x = scene(0.5)
    coarse = torch.randint(0, 3, x.features.shape, generator=torch.Generator().manual_seed(0)).double()
    table = same_sites_map(x.sites, 3).index
    assert has_ties(coarse, table)
    compare(lambda f: max_pool(x.with_features(f)).features, lambda f: brute_pool(f, table), coarse)
    table = strided_map(x.sites, Window(3, 2, 1))[1].index
    assert has_ties(coarse, table)
    compare(lambda f: strided_max_pool(x.with_features(f)).features, lambda f: brute_pool(f, table), coarse)


def brute_merge(levels: list[SparseBev]) -> dict[tuple[int, int, int], Tensor]:
    out: dict[tuple[int, int, int], Tensor] = {}
    for level in levels:
        ratio = level.grid.stride // levels[0].grid.stride
        for n, (r, c), f in zip(level.sites.batch.tolist(), level.sites.yx.tolist(), level.features, strict=True):
            at = (n, r * ratio, c * ratio)
            out[at] = out.get(at, torch.zeros_like(f)) + f
    return out


def test_merge_sums_coarser_levels_onto_the_finest_sites():
    w = weights(3, 3, 3, 3)
    fine = scene(0.05, 21, 30)
    middle = strided_conv(fine, w)
    coarse = strided_conv(middle, w)
    levels = [fine, middle, coarse]
    before = [(v.features.clone(), v.sites.key.clone()) for v in levels]
    got = merge(levels)
    wanted = brute_merge(levels)
    found = [(n, r, c) for n, (r, c) in zip(got.sites.batch.tolist(), got.sites.yx.tolist(), strict=True)]
    assert found == sorted(wanted)
    assert_near(got.features, torch.stack([wanted[k] for k in sorted(wanted)]))
    for level, (features, key) in zip(levels, before, strict=True):
        assert torch.equal(level.features, features) and torch.equal(level.sites.key, key)
    assert len(got.sites) > len(fine.sites)


@pytest.mark.parametrize("size", range(1, 71))
def test_merged_indices_are_in_range_on_every_grid(size):
    ground = grid_of(size, 71 - size, stride=1)
    for stride in (1, 2, 4, 8):
        rows, columns = ground.at(stride).shape
        for ratio in (2, 4):
            last_row, last_column = (n - 1 for n in ground.at(stride * ratio).shape)
            assert last_row * ratio < rows and last_column * ratio < columns


def test_merge_on_a_small_odd_grid_keeps_the_last_cell():
    ground = grid_of(9, 5)
    levels = []
    for stride in (1, 2, 4):
        rows, columns = ground.at(stride).shape
        sites = Sites(torch.tensor([rows * columns - 1]), ground.at(stride))
        levels.append(SparseBev(torch.full((1, 1), float(stride)), sites))
    got = merge(levels)
    assert got.sites.yx.tolist() == [[8, 4]] and got.features.tolist() == [[7.0]]


@pytest.mark.parametrize("stride", (1, 2, 4, 8, 16, 32))
def test_centres_round_trip_at_every_stride(stride):
    grid = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, stride=stride)
    rows, columns = grid.shape
    yx = torch.cartesian_prod(torch.arange(rows), torch.arange(columns))
    assert torch.equal(grid.cells(grid.centers(yx)), yx)


def test_a_pruned_or_merged_set_starts_without_maps():
    x, w = scene(0.5), weights(3, 3, 3, 3)
    submanifold_conv(x, w)
    down = strided_conv(x, w)
    assert same_sites_map(x.sites, 3) is same_sites_map(x.with_features(x.features + 1).sites, 3)
    assert strided_conv(x, w).sites is down.sites
    inverse_conv(down, w, x.sites)
    assert len([name for name in x.sites.cache if name[0] == "pair"]) == 1
    dilated = submanifold_conv(x, w, dilation=2)
    assert_near(dilated.features, read(conv2d(x.dense(), w, padding=2, dilation=2), x.sites))
    keep = torch.rand(len(x.sites), generator=torch.Generator().manual_seed(9)) < 0.5
    pruned = x.keep(keep)
    assert not pruned.sites.cache and x.sites.cache
    assert_near(submanifold_conv(pruned, w).features, read(conv2d(pruned.dense(), w, padding=1), pruned.sites))
    both = merge([x, down])
    assert not both.sites.cache
    assert_near(submanifold_conv(both, w).features, read(conv2d(both.dense(), w, padding=1), both.sites))


@pytest.mark.parametrize("reduce", ("sum", "mean", "max"))
def test_coalesce_reduces_duplicates_as_a_loop_does(reduce):
    random = torch.Generator().manual_seed(0)
    key = torch.randint(0, 2 * 5 * 6, (200,), generator=random)
    features = torch.randn(200, 3, generator=random, dtype=torch.float64) - 5

    def slow(f: Tensor) -> Tensor:
        how = {"sum": lambda v: v.sum(0), "mean": lambda v: v.mean(0), "max": lambda v: v.amax(0)}[reduce]
        return torch.stack([how(f[key == k]) for k in key.unique()])

    got = coalesce(features, key, grid_of(5, 6), 2, reduce)
    assert torch.equal(got.sites.key, key.unique())
    compare(lambda f: coalesce(f, key, grid_of(5, 6), 2, reduce).features, slow, features)
    if reduce == "sum":
        dense = torch.zeros(60, 3, dtype=torch.float64).index_add(0, key, features)
        assert_near(got.dense(), dense.view(2, 5, 6, 3).permute(0, 3, 1, 2))


def test_local_maxima_keep_one_of_equal_neighbours():
    x = scene(0.6)
    score = torch.randint(0, 4, (len(x.sites),), generator=torch.Generator().manual_seed(0)).float()
    batch, yx = x.sites.batch, x.sites.yx
    near = (batch[:, None] == batch) & ((yx[:, None] - yx).abs().amax(-1) <= 1)
    earlier = torch.arange(len(score))[None, :] < torch.arange(len(score))[:, None]
    beaten = near & ((score[None, :] > score[:, None]) | ((score[None, :] == score[:, None]) & earlier))
    got = local_maxima(score, x.sites)
    assert torch.equal(got, ~beaten.any(1))
    assert not (near & got[:, None] & got[None, :]).fill_diagonal_(False).any()


def test_empty_maps_pass_through_every_operation():
    x = scene("none")
    f, w = leaves(x.features, weights(3, 3, 3, 3))
    y = max_pool(submanifold_conv(x.with_features(f), w))
    down, pooled = strided_conv(y, w), strided_max_pool(y, dilating=True)
    up = inverse_conv(down, w, y.sites)
    total = merge([up, down, strided_conv(down, w, dilating=True)])
    assert total.features.shape == (0, 3) and total.grid == x.grid
    assert pooled.grid.stride == 2 and local_maxima(torch.zeros(0), x.sites).shape == (0,)
    (total.features.sum() + pooled.features.sum()).backward()
    assert w.grad is not None and not w.grad.any() and f.grad is not None


def test_backward_keeps_the_input_and_no_column_buffer():
    x, kept = scene(0.5, 40, 40, channels=8), []
    f, w = leaves(x.features, weights(8, 8, 3, 3))
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda t: t):
        submanifold_conv(x.with_features(f), w)
    assert max(kept) == x.features.numel() and sum(kept) <= x.features.numel() + 2 * w.numel()


def test_blocks_do_not_change_the_result(monkeypatch):
    x, w = scene(0.5), weights(4, 3, 3, 3)

    def run() -> list[Tensor]:
        f, v = leaves(x.features, w)
        y = max_pool(strided_conv(submanifold_conv(x.with_features(f), v[:3]), v, dilating=True))
        y.features.square().sum().backward()
        assert f.grad is not None and v.grad is not None
        return [y.features, f.grad, v.grad]

    whole = run()
    monkeypatch.setattr("manyeyes.ops.sparse_conv.BLOCK_ROWS", 7)
    for got, wanted in zip(run(), whole, strict=True):
        assert_near(got, wanted)


@pytest.mark.parametrize("inputs, outputs", [(5, 16), (1, 32), (32, 48), (64, 144), (12, 64)])
@pytest.mark.parametrize("layer", ["submanifold", "strided", "dilating"])
def test_compiled_loops_and_blocks_give_the_same(monkeypatch, layer, inputs, outputs):
    x, w = scene(0.5, channels=inputs), weights(outputs, inputs, 3, 3).float()
    x, b = x.with_features(x.features.float()), weights(outputs, seed=2).float()

    def run() -> list[Tensor]:
        f, v = leaves(x.features, w)
        with torch.inference_mode():
            inferred = convolved(f, v)
        learnt = convolved(f, v)
        learnt.square().sum().backward()
        assert f.grad is not None and v.grad is not None
        return [inferred, learnt.detach(), f.grad, v.grad]

    def convolved(f: Tensor, v: Tensor) -> Tensor:
        if layer == "submanifold":
            return submanifold_conv(x.with_features(f), v, b).features
        return strided_conv(x.with_features(f), v, b, dilating=layer == "dilating").features

    in_loops = run()
    with monkeypatch.context() as patch:
        patch.setattr("manyeyes.ops.sparse_conv._in_loops", lambda x, taps: False)
        in_blocks = run()
    for got, wanted in zip(in_loops, in_blocks, strict=True):
        assert_near(got, wanted, 1e-5)
    assert len(in_loops[0]) > 50 and float(in_blocks[0].abs().max()) > 0.1
    # Without what the loops add there is something else: they are what ran.
    with monkeypatch.context() as patch:
        patch.setattr("manyeyes.ops.sparse_conv.sum_outer_products", lambda *_: None)
        assert not run()[3].any()
    monkeypatch.setattr("manyeyes.ops.sparse_conv.convolve", lambda *given: given[-1].fill(0.0))
    assert not torch.allclose(run()[0], in_blocks[0], atol=1e-2)


@pytest.mark.parametrize("pairs", [0, 1, 5, 6, 7, 13, 604])
def test_the_loop_of_pairs_is_the_sum_over_them(pairs):
    generator = torch.Generator().manual_seed(pairs)
    x, w = torch.randn(700, 3, generator=generator), torch.randn(4, 3, 112, generator=generator)
    source, target = (torch.randperm(700, generator=generator)[:pairs].repeat(2) for _ in range(2))
    out = torch.randn(700, 112, generator=generator)
    wanted = out.double()
    for tap in (3, 1):
        wanted = wanted.index_add(0, target[:pairs], x[source[:pairs]].double() @ w[tap].double())
    counts = torch.tensor([pairs, pairs])
    add_products(x.numpy(), panels(w), 3, -2, source.numpy(), target.numpy(), counts.numpy(), out.numpy())
    assert_near(out.double(), wanted, 1e-6)


def test_wrong_arguments_are_named():
    x = scene(0.3)
    with pytest.raises(ConfigError, match="odd kernel; got 2"):
        submanifold_conv(x, weights(4, 3, 2, 2))
    with pytest.raises(ShapeError, match=r"needs 3 at axis 1.*\(4, 5, 3, 3\)"):
        submanifold_conv(x, weights(4, 5, 3, 3))
    with pytest.raises(ConfigError, match="kernel is odd, the padding half of it"):
        strided_conv(x, weights(4, 3, 3, 3), padding=0)
    with pytest.raises(ConfigError, match="does not reach all children"):
        strided_conv(x, weights(4, 3, 1, 1), padding=0)
    with pytest.raises(ConfigError, match="sum, mean, max; got 'median'"):
        coalesce(x.features, x.sites.key, x.grid, 2, "median")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ShapeError, match=r"keys in \[0, 308\)"):
        coalesce(x.features[:1], torch.tensor([308]), x.grid, 2)
    with pytest.raises(ShapeError, match="finest first"):
        merge([strided_conv(x, weights(3, 3, 3, 3)), x])
    with pytest.raises(ShapeError, match="target on the grid before it"):
        inverse_conv(x, weights(3, 3, 3, 3), x.sites)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: parity of devices is not tested here")
def test_cuda_agrees_with_the_cpu():
    x, w = scene(0.4, 40, 50, channels=16), weights(16, 16, 3, 3)

    def run(device: str) -> list[Tensor]:
        f, v = (t.detach().float().to(device).requires_grad_() for t in (x.features, w))
        y = submanifold_conv(SparseBev(f, Sites(x.sites.key.to(device), x.grid, 2)), v)
        y = inverse_conv(strided_conv(max_pool(y), v), v, y.sites)
        y.features.square().sum().backward()
        assert f.grad is not None and v.grad is not None
        return [t.detach().cpu() for t in (y.features, f.grad, v.grad)]

    torch.backends.cuda.matmul.allow_tf32 = False
    for got, wanted in zip(run("cuda"), run("cpu"), strict=True):
        assert_near(got, wanted, 1e-5)
