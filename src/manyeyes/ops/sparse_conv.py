# SPDX-License-Identifier: Apache-2.0
"""Convolutions and pooling over occupied cells only, in plain PyTorch: exact, deterministic, on any device.

A layer takes, tap by tap, the rows that a tap meets, multiplies them by its matrix and adds them where they lead: only
pairs that exist are multiplied (six of nine on a street). On the CPU float32 goes through one compiled loop where it can;
all else is gathered in blocks that stay in the cache. A tap leads to a row once at most, so that results do not depend on
threads. Backward does the same with the pairs turned round.
Semantics: cross-correlation as in ``conv2d``; a bias is added to active rows alone; output keys are ascending. Rows of bfloat16
give rows of float32 (``ops.bfloat16_products``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError, ShapeError, Sites, SparseBev
from manyeyes.ops._outer_product_kernels import sum_outer_products
from manyeyes.ops._sparse_conv_kernels import LANES, convolve, panels
from manyeyes.ops.bfloat16_products import bfloat16_linear, round_to_bfloat16
from manyeyes.ops.gathered_conv import gathered_conv
from manyeyes.ops.sparse_index import (
    NeighbourMap,
    Pairs,
    Window,
    dilated_sites,
    distinct,
    finer_keys,
    parent_sites,
)
from manyeyes.ops.voxelize import segment_max, segment_mean, segment_sum

BLOCK_ROWS = 1024


def coalesce(
    features: Tensor, key: Tensor, grid: BevGrid, batch_size: int, reduce: Literal["sum", "mean", "max"] = "sum"
) -> SparseBev:
    """Scatter rows (N, C) at keys (N,) in any order to a sparse map; rows of one cell are reduced (max starts at -inf)."""
    rows, columns = grid.shape
    size = batch_size * rows * columns
    if key.device.type == "cpu" and key.numel() and (int(key.min()) < 0 or int(key.max()) >= size):
        raise ShapeError(f"coalesce needs keys in [0, {size}); got {int(key.min())} … {int(key.max())}.")
    found, row = distinct(key, size)
    how = {"sum": segment_sum, "mean": segment_mean, "max": segment_max}
    if reduce not in how:
        raise ConfigError(f"coalesce reduces by one of {', '.join(how)}; got {reduce!r}.")
    return SparseBev(how[reduce](features, row, found.shape[0]), Sites(found, grid, batch_size))


def submanifold_conv(x: SparseBev, weight: Tensor, bias: Tensor | None = None, dilation: int = 1) -> SparseBev:
    """Return a convolution on the same sites; weight (out, in, k, k), k odd, implied padding (k // 2) * dilation."""
    kernel = _kernel(weight, x.features.shape[1], axis=1)
    if kernel % 2 == 0:
        raise ConfigError(f"submanifold_conv needs an odd kernel; got {kernel}.")
    if kernel == 1:
        return x.with_features(_affine(x.features, weight[:, :, 0, 0], bias))
    return x.with_features(_conv(x.features, weight, bias, same_sites_map(x.sites, kernel, dilation)))


def strided_conv(
    x: SparseBev,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: int = 2,
    padding: int = 1,
    dilating: bool = False,
) -> SparseBev:
    """Return a convolution to a coarser grid; weight (out, in, k, k), k odd, padding k // 2.

    dilating: every output that meets an active cell (spconv's SparseConv2d); otherwise only the parents
    ``floor(i / stride)`` of active cells, a subset with the same values.
    """
    kernel = _kernel(weight, x.features.shape[1], axis=1)
    sites, table = strided_map(x.sites, Window(kernel, stride, padding), dilating)
    return SparseBev(_conv(x.features, weight, bias, table), sites)


def inverse_conv(
    x: SparseBev, weight: Tensor, target: Sites, bias: Tensor | None = None, stride: int = 2, padding: int = 1
) -> SparseBev:
    """Back to the finer sites ``target``: ``conv_transpose2d`` read there; weight (in, out, k, k)."""
    kernel = _kernel(weight, x.features.shape[1], axis=0)
    table = inverse_map(target, x.sites, kernel, stride, padding)
    if target.grid.at(target.grid.stride * stride) != x.grid or target.batch_size != x.sites.batch_size:
        raise ShapeError(
            f"inverse_conv by {stride} needs a target on the grid before it; got {target.grid} from {x.grid}."
        )
    return SparseBev(_conv(x.features, weight.transpose(0, 1), bias, table, reverse=True), target)


def inverse_map(target: Sites, sites: Sites, kernel: int = 3, stride: int = 2, padding: int = 1) -> NeighbourMap:
    """Return what the coarser sites meet among the finer ``target``, as a strided convolution; kept in ``target``."""
    return _pair_map(target, sites, _check_window(target, Window(kernel, stride, padding)))


def max_pool(x: SparseBev, kernel: int = 3) -> SparseBev:
    """Return the maximum over active neighbours (and the site itself), on the same sites; ties share the gradient equally."""
    if kernel % 2 == 0:
        raise ConfigError(f"max_pool needs an odd kernel; got {kernel}.")
    return x.with_features(_pool(x.features, same_sites_map(x.sites, kernel)))


def strided_max_pool(
    x: SparseBev, kernel: int = 3, stride: int = 2, padding: int = 1, dilating: bool = False
) -> SparseBev:
    """Return the maximum over active cells under each output; sites as in :func:`strided_conv`."""
    sites, table = strided_map(x.sites, Window(kernel, stride, padding), dilating)
    return SparseBev(_pool(x.features, table), sites)


def merge(levels: Sequence[SparseBev], reduce: Literal["sum", "mean", "max"] = "sum") -> SparseBev:
    """Sites of coarser levels, indices times the ratio of strides, united with the first level's (CoSTr, Eq. 3)."""
    fine, keys = levels[0], []
    for level in levels:
        if level.grid.at(fine.grid.stride) != fine.grid or level.grid.stride % fine.grid.stride:
            raise ShapeError(f"merge needs levels on one ground, finest first; got {level.grid} after {fine.grid}.")
        if level.sites.batch_size != fine.sites.batch_size or level.features.shape[1] != fine.features.shape[1]:
            raise ShapeError("merge needs one batch size and one number of channels over all levels.")
        ratio = level.grid.stride // fine.grid.stride
        key = level.sites.key
        keys.append(key if ratio == 1 else finer_keys(key, level.grid.shape, fine.grid.shape, ratio))
    features = torch.cat([level.features for level in levels])
    return coalesce(features, torch.cat(keys), fine.grid, fine.sites.batch_size, reduce)


def local_maxima(score: Tensor, sites: Sites, kernel: int = 3) -> Tensor:
    """Return (N,) bool: sites that no active neighbour exceeds, nor equals with a lower key (one survivor a tied pair)."""
    index = same_sites_map(sites, kernel).index.to(score.device)
    around = torch.cat((score, score.new_full((1,), -torch.inf)))[index]
    middle = index.shape[1] // 2
    return (score[:, None] > around[:, :middle]).logical_or(index[:, :middle] == len(sites)).all(1) & (
        score[:, None] >= around[:, middle:]
    ).all(1)


def same_sites_map(sites: Sites, kernel: int, dilation: int = 1) -> NeighbourMap:
    """Return neighbours of every site among the sites themselves; built once and kept in ``sites.cache``."""
    name = ("same", kernel, dilation)
    if name not in sites.cache:
        window, shape = Window(kernel, 1, kernel // 2 * dilation, dilation), sites.grid.shape
        sites.cache[name] = NeighbourMap(sites.key, shape, sites.key, shape, sites.batch_size, window)
    return sites.cache[name]


def strided_map(sites: Sites, window: Window, dilating: bool = False) -> tuple[Sites, NeighbourMap]:
    """Return the coarser sites of a strided layer and what they meet; built once, so that equal layers share one set."""
    name = ("strided", window, dilating)
    if name not in sites.cache:
        _check_window(sites, window)
        if not dilating and window.kernel // 2 < window.stride - 1:
            raise ConfigError(f"A kernel of {window.kernel} does not reach all children at stride {window.stride}.")
        shape, batch_size = sites.grid.shape, sites.batch_size
        key = (
            dilated_sites(sites.key, shape, batch_size, window)
            if dilating
            else parent_sites(sites.key, shape, batch_size, window.stride)
        )
        coarse = Sites(key, sites.grid.at(sites.grid.stride * window.stride), batch_size)
        sites.cache[name] = (coarse, _pair_map(sites, coarse, window))
    return sites.cache[name]


def _pair_map(fine: Sites, coarse: Sites, window: Window) -> NeighbourMap:
    """What the sites ``coarse`` meet among ``fine``; kept in the finer set, with the coarser that it names."""
    name = ("pair", window, id(coarse))
    if name not in fine.cache:
        table = NeighbourMap(coarse.key, coarse.grid.shape, fine.key, fine.grid.shape, fine.batch_size, window)
        # Holding the coarser set keeps its id from being given to another one.
        fine.cache[name] = (table, coarse)
    return fine.cache[name][0]


def _check_window(sites: Sites, window: Window) -> Window:
    if (
        window.kernel % 2 == 0
        or window.padding != window.kernel // 2
        or window.out_shape(sites.grid.shape) != (sites.grid.at(sites.grid.stride * window.stride).shape)
    ):
        raise ConfigError(f"On a BevGrid the kernel is odd, the padding half of it, the stride 1 or 2; got {window}.")
    return window


def _kernel(weight: Tensor, channels: int, axis: int) -> int:
    if weight.dim() != 4 or weight.shape[2] != weight.shape[3] or weight.shape[axis] != channels:
        raise ShapeError(f"The weight needs {channels} at axis {axis} and a square kernel; got {tuple(weight.shape)}.")
    return weight.shape[2]


def _affine(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    if x.dtype == torch.bfloat16:
        return bfloat16_linear(x, weight, bias)
    return torch.nn.functional.linear(x, weight.to(x.dtype), None if bias is None else bias.to(x.dtype))


def _conv(x: Tensor, weight: Tensor, bias: Tensor | None, table: NeighbourMap, reverse: bool = False) -> Tensor:
    """Convolve rows (N_in, in) to (N_out, out); weight (out, in, k, k)."""
    if x.dtype != torch.bfloat16:
        return _multiply(x, weight, bias, table, reverse)
    if x.device.type == "cpu":
        return _multiply(x.float(), round_to_bfloat16(weight), bias, table, reverse)
    out = _multiply(x, weight, None, table, reverse).float()
    return out if bias is None else out + bias


def _multiply(x: Tensor, weight: Tensor, bias: Tensor | None, table: NeighbourMap, reverse: bool) -> Tensor:
    """Convolve rows in their own type."""
    # (taps, in, out): one matrix for each tap.
    taps = weight.to(x.dtype).permute(2, 3, 1, 0).reshape(-1, weight.shape[1], weight.shape[0])
    table = table.on(x.device)
    if x.device.type != "cpu":
        out = gathered_conv(x, taps, *((table.back, table.index) if reverse else (table.index, table.back)))
        return out if bias is None else out + bias.to(x.dtype)
    if not torch.is_grad_enabled():
        return _pair_product(x, taps, table, reverse, bias)
    out = cast(Tensor, _PairProduct.apply(x, taps, table, reverse))
    return out if bias is None else out + bias.to(x.dtype)


class _PairProduct(torch.autograd.Function):
    """Keeps the input alone for its backward pass; no gathered row outlives a block."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, taps: Tensor, table: NeighbourMap, reverse: bool) -> Tensor:
        ctx.save_for_backward(x, taps)
        ctx.table, ctx.reverse = table, reverse
        return _pair_product(x, taps, table, reverse)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        x, taps = ctx.saved_tensors
        dy, table, reverse = grads[0].contiguous(), ctx.table, ctx.reverse
        dx = dw = None
        if ctx.needs_input_grad[0]:
            dx = _pair_product(dy, taps.transpose(1, 2), table, not reverse)
        if ctx.needs_input_grad[1]:
            dw = _pair_outer(x, dy, table, reverse)
        return dx, dw, None, None


def _pair_product(x: Tensor, taps: Tensor, table: NeighbourMap, reverse: bool, bias: Tensor | None = None) -> Tensor:
    """Return (rows, D): for each pair of a tap its row of x (N, C) times the matrix (C, D) of the tap, summed where it leads."""
    bias = x.new_zeros(taps.shape[2]) if bias is None else bias.to(x.dtype)
    if _in_loops(x, taps):
        pairs, out = table.pairs, x.new_empty(table.rows(reverse), taps.shape[2])
        pairs = Pairs(pairs.target, pairs.source, pairs.counts) if reverse else pairs
        rows, start = x.contiguous().numpy(), bias.contiguous().numpy()
        convolve(rows, panels(taps), start, pairs, table.is_symmetric, False, out.numpy())
        return out
    # Every site meets itself by the middle tap: no gathering there.
    out = (
        torch.addmm(bias, x, taps[taps.shape[0] // 2])
        if table.is_symmetric
        else bias.expand(table.rows(reverse), -1).contiguous()
    )
    matrices, (longest, blocks) = taps.unbind(), table.blocks(_block_rows(x), reverse)
    gathered, product = x.new_empty(longest, x.shape[1]), x.new_empty(longest, taps.shape[2])
    for tap, source, target, size in blocks:
        rows = torch.index_select(x, 0, source, out=gathered[:size])
        # A tap leads to a row once at most, so that no sum depends on the order of the pairs.
        out.index_add_(0, target, torch.mm(rows, matrices[tap], out=product[:size]))
    return out


def _in_loops(x: Tensor, taps: Tensor) -> bool:
    """Compute the products in a compiled loop: without copies before and after a product, which cost time at any number of
    channels.
    """
    plain = x.device.type == "cpu" and x.dtype == taps.dtype == torch.float32
    return plain and taps.shape[2] % LANES == 0


def _pair_outer(x: Tensor, dy: Tensor, table: NeighbourMap, reverse: bool) -> Tensor:
    """Return (taps, C, D): for each tap the sum over its pairs of the row of x (N, C), transposed, times the row of dy (M, D)."""
    dw = x.new_zeros(table.window.kernel**2, x.shape[1], dy.shape[1])
    if _in_loops(x, dw):
        pairs = table.pairs
        pairs = Pairs(pairs.target, pairs.source, pairs.counts) if reverse else pairs
        sum_outer_products(x.contiguous().numpy(), dy.numpy(), pairs, table.is_symmetric, dw.numpy())
        return dw
    if table.is_symmetric:
        torch.mm(x.T, dy, out=dw[dw.shape[0] // 2])
    longest, blocks = table.blocks(_block_rows(x), reverse)
    ahead, behind = x.new_empty(longest, x.shape[1]), x.new_empty(longest, dy.shape[1])
    for tap, source, target, size in blocks:
        rows = torch.index_select(x, 0, source, out=ahead[:size])
        others = torch.index_select(dy, 0, target, out=behind[:size])
        dw[tap].addmm_(rows.T, others)
    return dw


def _block_rows(x: Tensor) -> int:
    return BLOCK_ROWS if x.device.type == "cpu" else 1 << 30


def _pad_row(x: Tensor, value: float = 0.0) -> Tensor:
    return torch.cat((x, x.new_full((1, x.shape[1]), value)))


def _pool(x: Tensor, table: NeighbourMap) -> Tensor:
    out: Tensor = _GatherMax.apply(x, table.on(x.device))  # pyright: ignore[reportAssignmentType]
    return out


class _GatherMax(torch.autograd.Function):
    """The maximum over gathered rows; the gradient is shared equally among ties."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, table: NeighbourMap) -> Tensor:
        padded, out = _pad_row(x, -torch.inf), x.new_full((table.n_out, x.shape[1]), -torch.inf)
        for rows, index in _row_blocks(table.index, x):
            for tap in index:
                torch.maximum(out[rows], padded.index_select(0, tap), out=out[rows])
        ctx.save_for_backward(x, out)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        x, out = ctx.saved_tensors
        padded, ties, dx = _pad_row(x, -torch.inf), torch.zeros_like(out), torch.zeros_like(x)
        for rows, index in _row_blocks(ctx.table.index, x):
            for tap in index:
                ties[rows] += padded.index_select(0, tap).eq_(out[rows])
        share, top = _pad_row(grads[0] / ties), _pad_row(out, torch.nan)
        for rows, index in _row_blocks(ctx.table.back, x):
            for tap in index:
                dx[rows].addcmul_(share.index_select(0, tap), top.index_select(0, tap).eq_(x[rows]))
        return dx, None


def _row_blocks(index: Tensor, x: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Slices of rows with their part of the map, tap by tap: (taps, rows)."""
    size = _block_rows(x)
    for start in range(0, index.shape[0], size):
        yield slice(start, start + size), index[start : start + size].T.contiguous()
