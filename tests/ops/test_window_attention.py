# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.ops.window_attention import (
    BUCKETS,
    attention_cost,
    plan_windows,
    sincos_encoding,
    window_attention,
    window_ids,
    window_offsets,
    window_places,
)

ORIGIN, CELL, SIDE = (-16.0, -9.6), 0.4, 8
WINDOW = SIDE * CELL


def slow_attention(q: Tensor, k: Tensor, v: Tensor, query_window: Tensor, key_window: Tensor) -> Tensor:
    """A loop over queries: softmax(q k^T / sqrt(d)) v over the keys of its window, zeros where there is none."""
    rows = []
    for i in range(len(q)):
        near = key_window == query_window[i]
        weight = (torch.einsum("hd,nhd->nh", q[i], k[near]) / math.sqrt(q.shape[2])).softmax(0)
        rows.append(torch.einsum("nh,nhd->hd", weight, v[near]))
    return torch.stack(rows)


def tokens(
    n: int = 120, seed: int = 0, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Positions in clumps, scenes, and q, k, v of 2 heads of 4."""
    random = torch.Generator().manual_seed(seed)
    middle = torch.rand(6, 2, generator=random) * torch.tensor([30.0, 18.0]) + torch.tensor(ORIGIN)
    xy = middle[torch.randint(0, 6, (n,), generator=random)] + torch.randn(n, 2, generator=random)
    batch = torch.randint(0, 2, (n,), generator=random)
    return xy, batch, torch.randn(3, n, 2, 4, generator=random, dtype=dtype).unbind()


def values_and_gradients(function, *values: Tensor) -> list[Tensor]:
    inputs = [v.detach().clone().requires_grad_() for v in values]
    out = function(*inputs)
    (out * torch.linspace(0.5, 1.5, out.numel(), dtype=out.dtype).view_as(out)).sum().backward()
    return [out.detach(), *(torch.zeros_like(v) if v.grad is None else v.grad for v in inputs)]


def assert_near(got: list[Tensor], wanted: list[Tensor], tolerance: float = 1e-12) -> None:
    for a, b in zip(got, wanted, strict=True):
        assert a.shape == b.shape and torch.allclose(a, b, rtol=0, atol=tolerance * max(1.0, float(b.abs().max())))


@pytest.mark.parametrize("shift", (0.0, WINDOW / 2))
def test_buckets_are_exact_attention_per_window(shift):
    xy, batch, qkv = tokens()
    ids = window_ids(xy, batch, ORIGIN, WINDOW, shift)
    assert len(plan_windows(ids, ids).groups) > 2
    assert_near(
        values_and_gradients(lambda q, k, v: window_attention(q, k, v, ids, ids), *qkv),
        values_and_gradients(lambda q, k, v: slow_attention(q, k, v, ids, ids), *qkv),
    )


def test_float32_is_exact_to_single_precision():
    xy, batch, qkv = tokens(400)
    ids = window_ids(xy, batch, ORIGIN, WINDOW)
    got = window_attention(*(t.float() for t in qkv), ids, ids)
    assert got.dtype == torch.float32
    assert torch.allclose(got.double(), slow_attention(*qkv, ids, ids), rtol=0, atol=1e-5)


@pytest.mark.parametrize("buckets", ((8, 16, 64), (1, 2, 3), (1000,), ()))
def test_choice_of_buckets_changes_nothing(buckets):
    xy, batch, qkv = tokens()
    ids = window_ids(xy, batch, ORIGIN, WINDOW)
    assert_near([window_attention(*qkv, ids, ids, buckets)], [window_attention(*qkv, ids, ids)])


def test_permuted_tokens_give_permuted_results():
    xy, batch, qkv = tokens()
    ids = window_ids(xy, batch, ORIGIN, WINDOW)
    order = torch.randperm(len(ids), generator=torch.Generator().manual_seed(1))
    got = window_attention(*(t[order] for t in qkv), ids[order], ids[order])
    assert_near([got], [window_attention(*qkv, ids, ids)[order]])


def test_moving_by_whole_windows_changes_neither_offsets_nor_grouping():
    xy, batch, qkv = tokens()
    # A fine binary fraction, so that adding windows is exact in float32.
    xy, window = (xy * 64).round() / 64, 3.25
    for shift in (0.0, window / 2):
        moved = xy + torch.tensor([-40 * window, 3 * window])
        before, after = (window_offsets(p, ORIGIN, window, CELL, shift) for p in (xy, moved))
        assert torch.allclose(sincos_encoding(before, 16), sincos_encoding(after, 16), atol=1e-5)
        ids, new = (window_ids(p, batch, ORIGIN, window, shift) for p in (xy, moved))
        assert not torch.equal(ids, new)
        assert_near([window_attention(*qkv, new, new)], [window_attention(*qkv, ids, ids)])


def test_a_single_token_gets_its_own_value():
    q, k, v = tokens(5)[2]
    ids = torch.tensor([7, 3, 9, 3, 1])
    out = window_attention(q, k, v, ids, ids)
    assert torch.equal(out[[0, 2, 4]], v[[0, 2, 4]])
    assert not torch.allclose(out[[1, 3]], v[[1, 3]])


def test_windows_larger_than_the_last_bucket_are_complete():
    _, _, qkv = tokens(700)
    ids = (torch.arange(700) % 100 == 0).long()
    assert int((ids == 0).sum()) > BUCKETS[-1] > SIDE * SIDE
    assert_near([window_attention(*qkv, ids, ids)], [slow_attention(*qkv, ids, ids)])


def test_neighbours_over_a_border_meet_in_shifted_windows_only():
    border = ORIGIN[0] + 2 * WINDOW
    xy = torch.tensor([[border - 0.1, ORIGIN[1] + 2.0], [border + 0.1, ORIGIN[1] + 2.0]])
    batch = torch.zeros(2, dtype=torch.int64)
    plain, shifted = (window_ids(xy, batch, ORIGIN, WINDOW, s) for s in (0.0, WINDOW / 2))
    assert plain[0] != plain[1] and shifted[0] == shifted[1]
    q, k, v = tokens(2)[2]
    assert torch.equal(window_attention(q, k, v, plain, plain), v)
    assert not torch.allclose(window_attention(q, k, v, shifted, shifted), v)


def test_cross_attention_over_partly_empty_windows_is_finite():
    xy, batch, (q, _, _) = tokens(90)
    _, _, (_, k, v) = tokens(40, seed=2)
    other, other_batch = xy[:40] + 1.5 * WINDOW, batch[:40]
    queries = window_ids(xy, batch, ORIGIN, WINDOW)
    keys = window_ids(other, other_batch, ORIGIN, WINDOW)
    lonely = ~torch.isin(queries, keys)
    assert lonely.any() and not lonely.all() and not torch.isin(keys, queries).all()
    got = values_and_gradients(lambda q, k, v: window_attention(q, k, v, queries, keys), q, k, v)
    assert_near(got, values_and_gradients(lambda q, k, v: slow_attention(q, k, v, queries, keys), q, k, v))
    assert not got[0][lonely].any() and got[0][~lonely].all()
    assert all(bool(t.isfinite().all()) for t in got)


def test_empty_history_and_empty_queries():
    q, k, v = tokens(6)[2]
    ids, none = torch.arange(6), torch.zeros(0, dtype=torch.int64)
    out, *grads = values_and_gradients(lambda q, k, v: window_attention(q, k, v, ids, none), q, k[:0], v[:0])
    assert not out.any() and not grads[0].any() and grads[1].shape == (0, 2, 4)
    assert window_attention(q[:0], k, v, none, ids).shape == (0, 2, 4)
    assert window_attention(q[:0], k[:0], v[:0], none, none).shape == (0, 2, 4)


def test_one_window_over_everything_is_global_attention():
    xy, _, qkv = tokens()
    ids = window_ids(xy, torch.zeros(len(xy), dtype=torch.int64), (-1000.0, -1000.0), 2000.0)
    wanted = torch.nn.functional.scaled_dot_product_attention(*(t.transpose(0, 1) for t in qkv)).transpose(0, 1)
    assert_near([window_attention(*qkv, ids, ids)], [wanted])


def test_layers_share_one_plan_and_it_fits_these_tokens_only():
    xy, batch, qkv = tokens()
    ids = window_ids(xy, batch, ORIGIN, WINDOW)
    plan = plan_windows(ids, ids)
    assert torch.equal(window_attention(*qkv, plan), window_attention(*qkv, ids, ids))
    with pytest.raises(ShapeError, match="differ"):
        window_attention(*(t[1:] for t in qkv), plan)
    with pytest.raises(ConfigError, match="key_window"):
        window_attention(*qkv, ids)


def test_gradients_by_finite_differences():
    q, k, v = (t[:9, :1, :2].clone().requires_grad_() for t in tokens()[2])
    queries, keys = torch.tensor([0, 1, 1, 2, 2, 2, 5, 6, 6]), torch.tensor([1, 1, 2, 3, 6, 0, 0, 0, 6])
    assert torch.autograd.gradcheck(lambda q, k, v: window_attention(q, k, v, queries, keys), (q, k, v))


def test_ids_are_those_of_the_floor_formula_and_never_collide():
    random = torch.Generator().manual_seed(0)
    xy = (torch.rand(3000, 2, generator=random) - 0.5) * 400
    batch = torch.randint(0, 5, (3000,), generator=random)
    for shift in (0.0, WINDOW / 2):
        ids = window_ids(xy, batch, ORIGIN, WINDOW, shift)
        wanted = [
            (b, math.floor((x + 16.0 + shift) / WINDOW), math.floor((y + 9.6 + shift) / WINDOW))
            for b, (x, y) in zip(batch.tolist(), xy.tolist(), strict=True)
        ]
        assert min(w[1] for w in wanted) < 0 and bool((ids >= 0).all())
        assert len(set(wanted)) == len(set(ids.tolist())) == len(set(zip(wanted, ids.tolist(), strict=True)))


def test_offsets_are_measured_in_the_window_that_the_id_names():
    xy, batch, _ = tokens(500)
    for shift in (0.0, WINDOW / 2, 0.7):
        u = window_offsets(xy, ORIGIN, WINDOW, CELL, shift)
        assert bool((u >= -SIDE / 2 - 1e-5).all()) and bool((u < SIDE / 2 + 1e-5).all())
        ids = window_ids(xy, batch, ORIGIN, WINDOW, shift)
        one = ids == ids.mode().values
        # Within one window offsets differ by the distance in cells.
        assert torch.allclose(u[one] - u[one][0], (xy[one] - xy[one][0]) / CELL, atol=1e-4)
    middle = torch.tensor([[ORIGIN[0] + WINDOW / 2, ORIGIN[1] + WINDOW / 2]])
    assert torch.allclose(window_offsets(middle, ORIGIN, WINDOW, CELL), torch.zeros(1, 2), atol=1e-5)


def test_encoding_by_its_formula():
    u = torch.tensor([[0.0, 0.0], [1.5, -3.0]], dtype=torch.float64)
    wanted = [
        [
            f(value * 10000 ** (-2 * j / 8))
            for value in row  # x half, then y half
            for j in range(4)
            for f in (math.sin, math.cos)
        ]
        for row in u.tolist()
    ]
    assert torch.allclose(sincos_encoding(u, 16), torch.tensor(wanted, dtype=torch.float64), atol=1e-12)
    with pytest.raises(ConfigError, match="divisible by 4; got 6"):
        sincos_encoding(u, 6)


def test_cost_counters_by_hand():
    # Windows of 1, 2 and 5 tokens: the buckets of 4 and 8 pad them to 2, 2 and 5.
    ids = torch.tensor([0, 1, 1, 2, 2, 2, 2, 2])
    cost = attention_cost(plan_windows(ids, ids), side=8, cells=100)
    assert (cost.exact, cost.padded, cost.bound, cost.dense) == (1 + 4 + 25, 4 + 4 + 25, 64 * 8, 6400)
    # One query each; five keys in one window, one in the other: many keys must not pad the few.
    cost = attention_cost(plan_windows(torch.tensor([0, 1]), torch.tensor([0, 0, 0, 0, 0, 1])), side=8)
    assert (cost.exact, cost.padded) == (6, 6)


def test_plan_is_the_same_for_the_same_tokens():
    xy, batch, _ = tokens()
    ids = window_ids(xy, batch, ORIGIN, WINDOW)
    one, two = plan_windows(ids, ids), plan_windows(ids.clone(), ids.clone())
    assert one.groups == two.groups and torch.equal(one.query_slot, two.query_slot)
    assert torch.equal(one.query_slot, one.key_slot)
    taken = one.query_slot[one.query_slot < len(ids)]
    assert torch.equal(taken.sort().values, torch.arange(len(ids)))


@pytest.mark.parametrize("shift", (0.0, WINDOW / 2))
def test_places_in_one_loop_are_ids_and_offsets(shift: float) -> None:
    random = torch.Generator().manual_seed(3)
    xy, batch = (torch.rand(500, 2, generator=random) - 0.5) * 300, torch.randint(3, (500,), generator=random)
    learning = window_places(xy, batch, ORIGIN, WINDOW, CELL, shift)
    with torch.no_grad():
        ids, offsets = window_places(xy, batch, ORIGIN, WINDOW, CELL, shift)
        with pytest.raises(ConfigError, match="edge above 0 m; got 0"):
            window_places(xy, batch, ORIGIN, 0.0, CELL)
    wanted = window_ids(xy, batch, ORIGIN, WINDOW, shift), window_offsets(xy, ORIGIN, WINDOW, CELL, shift)
    for got in ((ids, offsets), learning):
        assert torch.equal(got[0], wanted[0]) and torch.equal(got[1], wanted[1])
    assert len(ids.unique()) > 50
