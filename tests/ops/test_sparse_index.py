# SPDX-License-Identifier: Apache-2.0
from itertools import product

import pytest
import torch
from torch.nn.functional import conv2d

from manyeyes.ops.sparse_index import (
    NeighbourMap,
    Window,
    dilated_sites,
    distinct,
    finer_keys,
    neighbours,
    parent_sites,
    split,
)

BATCH = 2


def keys(shape: tuple[int, int], density: float = 0.3) -> torch.Tensor:
    chance = torch.rand(BATCH * shape[0] * shape[1], generator=torch.Generator().manual_seed(0))
    return (chance < density).nonzero()[:, 0]


def dense(values: torch.Tensor, key: torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
    out = values.new_zeros(BATCH * shape[0] * shape[1], values.shape[1])
    out[key] = values
    return out.view(BATCH, *shape, -1).permute(0, 3, 1, 2)


def brute(out_key, out_shape, in_key, in_shape, window: Window) -> torch.Tensor:
    """The map by a loop over outputs and taps, straight from its definition."""
    place = {(int(b), int(y), int(x)): i for i, (b, y, x) in enumerate(zip(*split(in_key, in_shape)))}
    table = []
    for b, y, x in zip(*split(out_key, out_shape)):
        first = [int(v) * window.stride - window.padding for v in (y, x)]
        taps = product(range(window.kernel), range(window.kernel))
        table.append(
            [
                place.get((int(b), first[0] + ty * window.dilation, first[1] + tx * window.dilation), len(place))
                for ty, tx in taps
            ]
        )
    return torch.tensor(table, dtype=torch.int32).view(len(out_key), window.kernel**2)


@pytest.mark.parametrize(
    ("kernel", "stride", "padding", "shape"), [*product((2, 3, 5), (1, 2, 3), (0, 1, 2), ((9, 12), (7, 8), (6, 5)))]
)
def test_strided_sets_and_maps_of_any_window(kernel, stride, padding, shape):
    window, key = Window(kernel, stride, padding), keys(shape)
    out_shape = window.out_shape(shape)
    ones = torch.ones(1, 1, kernel, kernel, dtype=torch.float64)
    mask = dense(torch.ones(len(key), 1, dtype=torch.float64), key, shape)
    reached = conv2d(mask, ones, stride=stride, padding=padding)
    assert tuple(reached.shape[2:]) == out_shape
    found = dilated_sites(key, shape, BATCH, window)
    assert torch.equal(found, (reached > 0).flatten().nonzero()[:, 0])
    index = neighbours(found, out_shape, key, shape, BATCH, window)
    assert torch.equal(index, brute(found, out_shape, key, shape, window))
    random = torch.Generator().manual_seed(1)
    features = torch.randn(len(key), 2, generator=random, dtype=torch.float64)
    weight = torch.randn(3, 2, kernel, kernel, generator=random, dtype=torch.float64)
    padded = torch.cat((features, torch.zeros(1, 2, dtype=torch.float64)))
    values = torch.einsum("ntc,dct->nd", padded[index.long()], weight.flatten(2))
    wanted = conv2d(dense(features, key, shape), weight, stride=stride, padding=padding)
    assert torch.allclose(dense(values, found, out_shape), wanted, rtol=0, atol=1e-12 * float(wanted.abs().max()))


@pytest.mark.parametrize("dilation", (2, 3))
def test_dilated_windows(dilation):
    shape, window = (11, 9), Window(3, 2, 2, dilation)
    key, out_shape = keys(shape), window.out_shape(shape)
    found = dilated_sites(key, shape, BATCH, window)
    mask = dense(torch.ones(len(key), 1), key, shape)
    reached = conv2d(mask, torch.ones(1, 1, 3, 3), stride=2, padding=2, dilation=dilation)
    assert torch.equal(found, (reached > 0).flatten().nonzero()[:, 0])
    assert torch.equal(
        neighbours(found, out_shape, key, shape, BATCH, window), brute(found, out_shape, key, shape, window)
    )


def test_back_holds_each_meeting_once_and_from_the_other_side():
    shape, window = (9, 10), Window(3, 2, 1)
    key = keys(shape)
    found = parent_sites(key, shape, BATCH, 2)
    table = NeighbourMap(found, window.out_shape(shape), key, shape, BATCH, window)
    wanted = {(o, t, i) for o, row in enumerate(table.index.tolist()) for t, i in enumerate(row) if i < len(key)}
    back = {(o, t, i) for i, row in enumerate(table.back.tolist()) for t, o in enumerate(row) if o < len(found)}
    assert back == wanted
    for reverse in (False, True):
        blocks = table.blocks(1000, reverse)[1]
        pairs = [(b.tap, *ends) for b in blocks for ends in zip(b.source.tolist(), b.target.tolist(), strict=True)]
        assert len(pairs) == len(wanted)
        assert {(t, b, a) if reverse else (t, a, b) for t, a, b in pairs} == {(t, i, o) for o, t, i in wanted}
        assert all(len(b.source.unique()) == len(b.target.unique()) == b.size for b in blocks)


def test_a_map_of_one_set_is_its_own_transpose_flipped():
    shape, key = (9, 10), keys((9, 10))
    symmetric, plain = (NeighbourMap(out, shape, key, shape, BATCH, Window(5, 1, 4, 2)) for out in (key, key.clone()))
    assert symmetric.is_symmetric and not plain.is_symmetric
    assert not NeighbourMap(key, (5, 6), key, shape, BATCH, Window(5, 1, 2, 2)).is_symmetric
    assert torch.equal(symmetric.back, plain.back)
    middle = plain.blocks(1000)[1][12]
    assert middle.tap == 12 and torch.equal(middle.source, middle.target) and len(middle.source) == len(key)
    assert [block.tap for block in symmetric.blocks(1000)[1]] == [t for t in range(25) if t != 12]
    for reverse, rows in ((False, 7), (True, 7), (False, 1000)):
        longest, blocks = symmetric.blocks(rows, reverse)
        others = [block for block in plain.blocks(rows, reverse)[1] if block.tap != 12]
        assert longest == max(block.size for block in others) <= rows
        assert [(b.tap, b.size) for b in blocks] == [(b.tap, b.size) for b in others]
        assert all(torch.equal(a.source, b.source) and torch.equal(a.target, b.target) for a, b in zip(blocks, others))


@pytest.mark.parametrize("symmetric", (False, True))
def test_pairs_are_those_of_the_blocks_tap_by_tap(symmetric):
    shape, key, window = (9, 10), keys((9, 10)), Window(3, 1, 1) if symmetric else Window(3, 2, 1)
    out = key if symmetric else parent_sites(key, shape, BATCH, 2)
    table = NeighbourMap(out, window.out_shape(shape), key, shape, BATCH, window)
    (source, target, counts), blocks = table.pairs, {b.tap: b for b in table.blocks(1000)[1]}
    ends = counts.cumsum()
    assert len(source) == len(target) == ends[-1] and len(counts) == (4 if symmetric else 9)
    for tap, (n, end) in enumerate(zip(counts, ends)):
        assert source[end - n : end].tolist() == blocks[tap].source.tolist()
        assert target[end - n : end].tolist() == blocks[tap].target.tolist()


@pytest.mark.parametrize("symmetric", (False, True))
def test_compiled_loops_equal_tensor_operations(monkeypatch, symmetric):
    shape, window = (11, 10), Window(3, 1, 1) if symmetric else Window(3, 2, 1)

    def found() -> list[torch.Tensor]:
        key = keys(shape)
        out = key if symmetric else parent_sites(key, shape, BATCH, 2)
        table = NeighbourMap(out, window.out_shape(shape), key, shape, BATCH, window)
        blocks = table.blocks(1000)[1]
        return [
            out,
            table.index,
            *map(torch.from_numpy, table.pairs),
            *(t for b in blocks for t in (torch.tensor(b.tap), b.source, b.target)),
        ]

    loops = found()
    monkeypatch.setattr("manyeyes.ops.sparse_index._in_loops", lambda key: False)
    tensors = found()
    assert len(loops) == len(tensors) > 10
    assert all(a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(loops, tensors, strict=True))


def test_distinct_is_unique_with_its_inverse(monkeypatch):
    key = torch.randint(0, 50, (200,), generator=torch.Generator().manual_seed(0))
    found, row = distinct(key, 50)
    wanted, inverse = key.unique(return_inverse=True)
    assert torch.equal(found, wanted) and torch.equal(row, inverse)
    monkeypatch.setattr("manyeyes.ops.sparse_index._in_loops", lambda key: False)
    assert all(torch.equal(a, b) for a, b in zip(distinct(key, 50), (wanted, inverse)))


def test_no_sites_give_empty_maps():
    none, window = torch.zeros(0, dtype=torch.int64), Window(3, 2, 1)
    assert dilated_sites(none, (5, 5), BATCH, window).shape == (0,)
    assert parent_sites(none, (5, 5), BATCH, 2).shape == (0,)
    assert neighbours(none, (3, 3), none, (5, 5), BATCH, window).shape == (0, 9)
    assert Window(5, 1, 0).out_shape((3, 3)) == (0, 0)


@pytest.mark.parametrize("ratio", [1, 2, 4])
@pytest.mark.parametrize("in_loops", [True, False])
def test_a_cell_on_a_finer_grid_is_where_its_first_child_is(monkeypatch, ratio, in_loops):
    monkeypatch.setattr("manyeyes.ops.sparse_index._in_loops", lambda key: in_loops)
    shape, finer = (5, 7), (5 * ratio - ratio // 2, 7 * ratio - ratio // 2)
    key = keys(shape)
    found = finer_keys(key, shape, finer, ratio)
    wanted = [(b * finer[0] + y * ratio) * finer[1] + x * ratio for b, y, x in zip(*split(key, shape))]
    assert len(key) > 10 and found.tolist() == [int(k) for k in wanted]
    assert torch.equal(parent_sites(found, finer, BATCH, ratio), key)
