# SPDX-License-Identifier: Apache-2.0
"""Softmax attention within square windows of the ground, exact: windows of like size share a padded batch.

Tokens have continuous metric positions, so that those of an aligned neighbour need not lie on the grid. Nothing is
dropped: windows beyond the last bucket are padded to the largest among them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad, scaled_dot_product_attention

from manyeyes._jit import F32x2, I64x1, njit
from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.ops.window_plan import WindowGroup, WindowPlan, plan_on_device

BUCKETS = (4, 8, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)
_BITS = 20


def window_ids(xy: Tensor, batch: Tensor, origin: tuple[float, float], window_m: float, shift_m: float = 0.0) -> Tensor:
    """Return (N,) int64: the window of positions (N, 2), metres, of scenes batch (N,).

    Window ``floor((x - x0 + shift) / window)`` on each axis. Ids need no extent: positions out of range, on any
    side, have windows of their own (up to 2**19 of them from the origin).
    """
    at = _window_at(xy, origin, window_m, shift_m).long() + (1 << (_BITS - 1))
    return (((batch.long() << _BITS) + at[:, 1]) << _BITS) + at[:, 0]


def window_offsets(
    xy: Tensor, origin: tuple[float, float], window_m: float, cell_m: float, shift_m: float = 0.0
) -> Tensor:
    """Return (N, 2): position in the (shifted) window, from its middle, in cells: in [-S / 2, S / 2), S = window / cell."""
    at = _window_at(xy, origin, window_m, shift_m)
    start = xy.new_tensor(origin, dtype=torch.float64)
    return ((xy.double() - start + shift_m - (at + 0.5) * window_m) / cell_m).to(xy.dtype)


def window_places(
    xy: Tensor, batch: Tensor, origin: tuple[float, float], window_m: float, cell_m: float, shift_m: float = 0.0
) -> tuple[Tensor, Tensor]:
    """:func:`window_ids` (N,) and :func:`window_offsets` (N, 2) of the same tokens; at inference on the CPU in one loop."""
    if torch.is_grad_enabled() or xy.device.type != "cpu" or xy.dtype != torch.float32:
        return (
            window_ids(xy, batch, origin, window_m, shift_m),
            window_offsets(xy, origin, window_m, cell_m, shift_m),
        )
    _check_window_size(window_m)
    ids, offsets = xy.new_empty(len(xy), dtype=torch.int64), xy.new_empty(len(xy), 2)
    where, whose = xy.contiguous().numpy(), batch.contiguous().numpy()
    windows = _WindowGrid(*map(float, (*origin, window_m, cell_m, shift_m)))
    _place(where, whose, windows, ids.numpy(), offsets.numpy())
    return ids, offsets


class _WindowGrid(NamedTuple):
    """Square windows of edge window_m, moved by -shift_m, from the corner (x_min, y_min); offsets count cells of cell_m."""

    x_min: float
    y_min: float
    window_m: float
    cell_m: float
    shift_m: float


@njit(cache=True, nogil=True)
def _place(xy: F32x2, batch: I64x1, windows: _WindowGrid, ids: I64x1, offsets: F32x2) -> None:  # pragma: no cover
    x_min, y_min, window_m, cell_m, shift_m = windows
    for i in range(xy.shape[0]):
        x, y = np.float64(xy[i, 0]) - x_min + shift_m, np.float64(xy[i, 1]) - y_min + shift_m
        column, row, half = np.floor(x / window_m), np.floor(y / window_m), 1 << (_BITS - 1)
        ids[i] = (((batch[i] << _BITS) + np.int64(row) + half) << _BITS) + np.int64(column) + half
        offsets[i, 0] = (x - (column + 0.5) * window_m) / cell_m
        offsets[i, 1] = (y - (row + 0.5) * window_m) / cell_m


def _window_at(xy: Tensor, origin: tuple[float, float], window_m: float, shift_m: float) -> Tensor:
    _check_window_size(window_m)
    return ((xy.double() - xy.new_tensor(origin, dtype=torch.float64) + shift_m) / window_m).floor()


def _check_window_size(window_m: float) -> None:
    if window_m <= 0:
        raise ConfigError(f"A window needs an edge above 0 m; got {window_m}.")


def sincos_encoding(u: Tensor, channels: int) -> Tensor:
    """Return (N, channels): sin, cos of u (N, 2) at falling frequencies 10000^(-2j / (channels / 2)); x half, then y half."""
    if channels % 4:
        raise ConfigError(f"sincos_encoding needs channels divisible by 4; got {channels}.")
    j = torch.arange(channels // 4, device=u.device, dtype=u.dtype)
    angle = u[:, :, None] * 10000.0 ** (-4.0 * j / channels)
    return torch.stack((angle.sin(), angle.cos()), -1).flatten(1)


def plan_windows(query_window: Tensor, key_window: Tensor, buckets: tuple[int, ...] = BUCKETS) -> WindowPlan:
    """Group windows by the bucket of their larger side; queries (Nq,) and keys (Nk,) by window id, any order."""
    if query_window.device.type != "cpu" and query_window.shape[0] + key_window.shape[0]:
        return plan_on_device(query_window, key_window)
    query_order, query_ids, query_count = _runs(query_window)
    key_order, key_ids, key_count = (
        (query_order, query_ids, query_count) if key_window is query_window else _runs(key_window)
    )
    shared, in_query, in_key = _common(query_ids, key_ids)
    query_start, query_n = (query_count.cumsum(0) - query_count)[in_query], query_count[in_query]
    key_start, key_n = (key_count.cumsum(0) - key_count)[in_key], key_count[in_key]
    edges = torch.tensor(buckets, device=shared.device)
    bucket = torch.bucketize(torch.maximum(query_n, key_n), edges)
    groups, query_slots, key_slots = [], [], []
    for b in torch.unique(bucket).tolist():
        member = (bucket == b).nonzero()[:, 0]
        query_slots.append(_slots(query_order, query_start[member], query_n[member]))
        key_slots.append(_slots(key_order, key_start[member], key_n[member]))
        groups.append(WindowGroup(member.shape[0], query_slots[-1].shape[1], key_slots[-1].shape[1]))
    query_slot, query_place = _flat(query_slots, query_order)
    key_slot, key_place = _flat(key_slots, key_order)
    return WindowPlan(tuple(groups), query_slot, query_place, key_slot, key_place, int((query_n * key_n).sum()))


def _runs(window: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Stable order of tokens by window, the distinct ids, and their counts."""
    ids, order = window.sort(stable=True)
    distinct, count = torch.unique_consecutive(ids, return_counts=True)
    return order, distinct, count


def _common(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ids in both ascending lists, and their places in each."""
    if not a.numel() or not b.numel():
        none = a.new_zeros(0)
        return none, none, none
    at = torch.searchsorted(b, a).clamp_max(b.shape[0] - 1)
    in_a = (b[at] == a).nonzero()[:, 0]
    return a[in_a], in_a, at[in_a]


def _slots(order: Tensor, start: Tensor, count: Tensor) -> Tensor:
    """Return (windows, slots): the tokens of each window, padded by the number of tokens."""
    slot = torch.arange(int(count.max()), device=order.device)
    place = (start[:, None] + slot).clamp_max(order.shape[0] - 1)
    return order[place].masked_fill_(slot >= count[:, None], order.shape[0])


def _flat(slots: list[Tensor], order: Tensor) -> tuple[Tensor, Tensor]:
    """Return all slots in a row, and the slot of each token."""
    n = order.shape[0]
    flat = torch.cat([s.flatten() for s in slots]) if slots else order.new_zeros(0)
    place = order.new_full((n + 1,), flat.shape[0])
    place[flat] = torch.arange(flat.shape[0], device=order.device)
    return flat, place[:n]


def window_attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    query_window: Tensor | WindowPlan,
    key_window: Tensor | None = None,
    buckets: tuple[int, ...] = BUCKETS,
) -> Tensor:
    """softmax(q k^T / sqrt(d)) v of each query (Nq, h, d) over the keys (Nk, h, d) of its window: (Nq, h, d).

    query_window and key_window: (Nq,) and (Nk,) int64, or one :class:`WindowPlan` for both. A query whose window has no
    key gets zeros.
    """
    if isinstance(query_window, WindowPlan):
        plan = query_window
    elif key_window is None:
        raise ConfigError("window_attention needs key_window unless it is given a WindowPlan.")
    else:
        plan = plan_windows(query_window, key_window, buckets)
    if plan.query_place.shape[0] != q.shape[0] or plan.key_place.shape[0] != k.shape[0] or k.shape != v.shape:
        raise ShapeError(f"The plan and q, k, v differ: {tuple(q.shape)}, {tuple(k.shape)}, {tuple(v.shape)}.")
    slots_q = _rows(q, plan.query_slot, plan.query_place)
    slots_k, slots_v = (_rows(t, plan.key_slot, plan.key_place) for t in (k, v))
    filled = plan.key_slot < k.shape[0]
    parts, at_q, at_k = [slots_q[:0]], 0, 0
    for group in plan.groups:
        size_q, size_k = group.windows * group.query_slots, group.windows * group.key_slots
        mask = filled[at_k : at_k + size_k].view(group.windows, 1, 1, group.key_slots)
        batch = (
            t.view(group.windows, -1, *t.shape[1:]).transpose(1, 2)
            for t in (slots_q[at_q : at_q + size_q], slots_k[at_k : at_k + size_k], slots_v[at_k : at_k + size_k])
        )
        parts.append(scaled_dot_product_attention(*batch, attn_mask=mask).transpose(1, 2).flatten(0, 1))
        at_q, at_k = at_q + size_q, at_k + size_k
    return _rows(torch.cat(parts), plan.query_place, plan.query_slot)


def _rows(x: Tensor, index: Tensor, inverse: Tensor) -> Tensor:
    out: Tensor = _GatherRows.apply(x, index, inverse)  # pyright: ignore[reportAssignmentType]
    return out


class _GatherRows(torch.autograd.Function):
    """Rows by index, zeros where it names none; no row is taken twice, so that the inverse index is the gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, index: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(index, inverse)
        return _take(x, index)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return _take(grads[0], ctx.saved_tensors[1]), None, None


def _take(x: Tensor, index: Tensor) -> Tensor:
    return pad(x.flatten(1), (0, 0, 0, 1)).index_select(0, index).view(-1, *x.shape[1:])


@dataclass(frozen=True)
class AttentionCost:
    """Pairs of query and key: exact within windows, as padded, the bound S^2 N, and dense windows over all cells."""

    exact: int
    padded: int
    bound: int
    dense: int


def attention_cost(plan: WindowPlan, side: int, cells: int = 0) -> AttentionCost:
    """What a plan costs for windows of side x side cells on a grid of so many cells."""
    padded = sum(g.windows * g.query_slots * g.key_slots for g in plan.groups)
    return AttentionCost(plan.exact, padded, side * side * plan.query_place.shape[0], side * side * cells)
