# SPDX-License-Identifier: Apache-2.0
"""Index work of sparse convolutions: which sites a layer has and which of them meet, as integers only.

Sites are ``key = (batch * rows + row) * columns + column``, int64, ascending; shape is (rows, columns). A map is
(outputs, kernel * kernel) int32; entry [o, t] is the row of the input under tap t of output o, and the number of inputs
where there is none (the row of zeros that the caller appends). Taps run row by row, as in ``conv2d`` (no flip):
output o meets input ``i = o * stride - padding + t * dilation``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes._jit import I32x1, I64x1, U8x1, njit


class Window(NamedTuple):
    """Shape of a two-dimensional kernel, the same on both axes."""

    kernel: int
    stride: int = 1
    padding: int = 0
    dilation: int = 1

    @property
    def is_centred(self) -> bool:
        """The middle tap of an output lies on the input of the same place."""
        return self.stride == 1 and 2 * self.padding == self.dilation * (self.kernel - 1) and self.kernel % 2 == 1

    def out_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return rows and columns of the output of a convolution."""
        rows, columns = (
            (n + 2 * self.padding - self.dilation * (self.kernel - 1) - 1) // self.stride + 1 for n in shape
        )
        return max(rows, 0), max(columns, 0)


class Pairs(NamedTuple):
    """Rows source (P,) that lead to rows target (P,), tap by tap, counts (taps,) of each: int64, in the CPU's memory.

    Within a tap no row stands twice on either side. Of a symmetric map, taps before the middle alone.
    """

    source: NDArray[np.int64]
    target: NDArray[np.int64]
    counts: NDArray[np.int64]


class BorderedImages(NamedTuple):
    """How many index images with a border that no tap leaves, and the rows and columns of each."""

    batch_size: int
    rows: int
    columns: int


class _TapSteps(NamedTuple):
    """Places of an index image from a tap to the one below it and to the one beside it; taps in a row of the kernel."""

    down: int
    right: int
    kernel: int


class PairBlock(NamedTuple):
    """Some consecutive pairs of one tap, and how many."""

    tap: int
    source: Tensor
    target: Tensor
    size: int


@dataclass(eq=False)
class NeighbourMap:
    """Which of the sites out_key (outputs,) meet which of in_key (inputs,) through a window; found when first asked for."""

    out_key: Tensor
    out_shape: tuple[int, int]
    in_key: Tensor
    in_shape: tuple[int, int]
    batch_size: int
    window: Window
    moved: dict[torch.device, NeighbourMap] = field(default_factory=dict, repr=False)
    cut: dict[tuple[int, bool], tuple[int, tuple[PairBlock, ...]]] = field(default_factory=dict, repr=False)

    @property
    def n_in(self) -> int:
        """How many inputs there are."""
        return self.in_key.shape[0]

    @property
    def n_out(self) -> int:
        """How many outputs there are."""
        return self.out_key.shape[0]

    @property
    def is_symmetric(self) -> bool:
        """Inputs and outputs are one set, so that the middle tap leads from each row to itself."""
        return self.out_key is self.in_key and self.window.is_centred

    def rows(self, reverse: bool) -> int:
        """Return how many rows pairs lead to: outputs, or inputs when they are turned round."""
        return self.n_in if reverse else self.n_out

    @cached_property
    def index(self) -> Tensor:
        """(outputs, taps) int32, see the module."""
        return neighbours(self.out_key, self.out_shape, self.in_key, self.in_shape, self.batch_size, self.window)

    @cached_property
    def back(self) -> Tensor:
        """(inputs, taps) int32: the output that meets an input by a tap; the number of outputs where there is none."""
        if self.is_symmetric:
            return self.index.flip(1)
        n_out, taps = self.index.shape
        # An input and a tap name at most one output, so that nothing is written twice except the spare row.
        back = torch.full((self.n_in + 1, taps), n_out, dtype=torch.int32, device=self.index.device)
        rows = torch.arange(n_out, dtype=torch.int32, device=self.index.device)
        back.scatter_(0, self.index.long(), rows[:, None].expand(n_out, taps))
        return back[: self.n_in].contiguous()

    @property
    def _taps(self) -> int:
        """Of how many taps pairs are kept: where the map is symmetric, those behind the middle have them turned round."""
        return self.window.kernel**2 // 2 if self.is_symmetric else self.window.kernel**2

    @cached_property
    def pairs(self) -> Pairs:
        """Which inputs lead to which outputs, on the CPU."""
        if _in_loops(self.in_key):
            bordered = BorderedImages(
                self.batch_size, *_compute_bordered_shape(self.out_shape, self.in_shape, self.window)
            )
            out_key, in_key = self.out_key.numpy(), self.in_key.numpy()
            return collect_pairs(out_key, in_key, self.out_shape, self.in_shape, bordered, self.window, self._taps)
        return Pairs(*(part.numpy() for part in self._met))

    @cached_property
    def _met(self) -> tuple[Tensor, Tensor, Tensor]:
        """The same as tensors, on the device of the sites."""
        if _in_loops(self.in_key):
            source, target, counts = map(torch.from_numpy, self.pairs)
            return source, target, counts
        by_tap = self.index[:, : self._taps].T.contiguous()
        met = by_tap < self.n_in
        return by_tap[met].long(), met.nonzero()[:, 1], met.sum(1)

    def _cut(self, rows: int) -> list[PairBlock]:
        """Return the pairs of every tap, from inputs to outputs, in blocks of so many rows at most, as views."""
        source, target, counts = self._met
        sizes = [(tap, min(rows, n - at)) for tap, n in enumerate(counts.tolist()) for at in range(0, n, rows)]
        lengths = [size for _, size in sizes]
        parts = zip(sizes, source.split(lengths), target.split(lengths))
        blocks = [PairBlock(tap, some, others, size) for (tap, size), some, others in parts]
        if self.is_symmetric:
            last = self.window.kernel**2 - 1
            turned = (PairBlock(last - b.tap, b.target, b.source, b.size) for b in blocks)
            # Within a tap inputs ascend as outputs do: the blocks of a tap turned round stand in the same order.
            blocks += sorted(turned, key=lambda block: block.tap)
        return blocks

    def blocks(self, rows: int, reverse: bool = False) -> tuple[int, tuple[PairBlock, ...]]:
        """Return the pairs of every tap in blocks of so many rows at most, and the longest block's rows; cut once and kept."""
        if (rows, reverse) not in self.cut:
            found = self._cut(rows)
            if reverse:
                found = [PairBlock(b.tap, b.target, b.source, b.size) for b in found]
            self.cut[rows, reverse] = max((block.size for block in found), default=0), tuple(found)
        return self.cut[rows, reverse]

    def on(self, device: torch.device) -> NeighbourMap:
        """Return the same map on another device; kept."""
        if device == self.in_key.device:
            return self
        if device not in self.moved:
            in_key = self.in_key.to(device)
            out_key = in_key if self.out_key is self.in_key else self.out_key.to(device)
            self.moved[device] = replace(self, out_key=out_key, in_key=in_key, moved={}, cut={})
        return self.moved[device]


def split(key: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Batch, row and column of keys, each (N,) int64."""
    line = key.div(shape[1], rounding_mode="floor")
    batch = line.div(shape[0], rounding_mode="floor")
    return batch, line - batch * shape[0], key - line * shape[1]


def distinct(key: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return ascending distinct keys (M,) of keys (N,) in [0, size), and the place (N,) int64 of each key among them."""
    if _in_loops(key):
        found, row = collect_distinct(key.numpy(), np.zeros(size // 8 * 8 + 8, np.uint8))
        return torch.from_numpy(found), torch.from_numpy(row)
    image = torch.zeros(size, dtype=torch.int32, device=key.device)
    image[key] = 1
    found = image.nonzero()[:, 0]
    image[found] = torch.arange(found.shape[0], dtype=torch.int32, device=key.device)
    return found, image.index_select(0, key).long()


def dilated_sites(key: Tensor, shape: tuple[int, int], batch_size: int, window: Window) -> Tensor:
    """Return keys of every output that meets an active input: the active set of spconv's SparseConv2d."""
    kernel, stride, padding, dilation = window
    out = window.out_shape(shape)
    reach = [(n - 1) * stride + 1 for n in out]
    size = [max(p, padding + n) for p, n in zip((r + dilation * (kernel - 1) for r in reach), shape, strict=True)]
    active = torch.zeros(batch_size, *size, dtype=torch.bool, device=key.device)
    batch, y, x = split(key, shape)
    active.view(-1)[(batch * size[0] + y + padding) * size[1] + x + padding] = True
    met = torch.zeros(batch_size, *out, dtype=torch.bool, device=key.device)
    steps = range(0, kernel * dilation, dilation)
    for ty, tx in product(steps, steps):
        met |= active[:, ty : ty + reach[0] : stride, tx : tx + reach[1] : stride]
    return met.flatten().nonzero()[:, 0]


def parent_sites(key: Tensor, shape: tuple[int, int], batch_size: int, stride: int) -> Tensor:
    """Return keys of the cells ``floor(i / stride)`` of active cells i, on a grid of ceil(shape / stride)."""
    rows, columns = -(-shape[0] // stride), -(-shape[1] // stride)
    if _in_loops(key):
        return torch.from_numpy(collect_parents(key.numpy(), *shape, batch_size, rows, columns, stride))
    batch, y, x = split(key, shape)
    y, x = y.div(stride, rounding_mode="floor"), x.div(stride, rounding_mode="floor")
    return distinct((batch * rows + y) * columns + x, batch_size * rows * columns)[0]


def finer_keys(key: Tensor, shape: tuple[int, int], finer: tuple[int, int], ratio: int) -> Tensor:
    """Return ascending keys (N,) of the cells ``i * ratio`` on a finer grid, of cells i with ascending keys (N,)."""
    if _in_loops(key):
        out = torch.empty_like(key)
        collect_finer(key.numpy(), *shape, *finer, ratio, out.numpy())
        return out
    batch, y, x = split(key, shape)
    return (batch * finer[0] + y * ratio) * finer[1] + x * ratio


def neighbours(
    out_key: Tensor,
    out_shape: tuple[int, int],
    in_key: Tensor,
    in_shape: tuple[int, int],
    batch_size: int,
    window: Window,
) -> Tensor:
    """Return the map (outputs, kernel * kernel) int32 between two sets of sites.

    An index image with a border that no tap leaves spares all bounds tests, and with them the ghost neighbours that
    wrap from the last column to the next row.
    """
    kernel, stride, padding, dilation = window
    rows, columns = _compute_bordered_shape(out_shape, in_shape, window)
    device, n_in = in_key.device, in_key.shape[0]
    image = torch.full((batch_size * rows * columns,), n_in, dtype=torch.int32, device=device)
    unpadded, border = _places(in_key, in_shape, (rows, columns)), padding * (columns + 1)
    image[unpadded + border] = torch.arange(n_in, dtype=torch.int32, device=device)
    is_same = out_key is in_key and stride == 1
    first = unpadded if is_same else _places(out_key, out_shape, (rows, columns), stride)
    steps = range(0, kernel * dilation, dilation)
    taps = torch.tensor([down * columns + right for down in steps for right in steps], device=device)
    return image.index_select(0, (first[:, None] + taps).flatten()).view(first.shape[0], kernel * kernel)


def _places(key: Tensor, shape: tuple[int, int], image: tuple[int, int], stride: int = 1) -> Tensor:
    """Return the place (N,) of cells, rows and columns times stride, in images of more rows and columns than shape."""
    line = key.div(shape[1], rounding_mode="floor")
    batch = line.div(shape[0], rounding_mode="floor")
    # (batch * rows + y * stride) * columns + x * stride, with y and x written by line and key.
    place = (key if stride == 1 else key * stride) + line * (stride * (image[1] - shape[1]))
    return place + batch * (image[1] * (image[0] - stride * shape[0]))


def _compute_bordered_shape(out_shape: tuple[int, int], in_shape: tuple[int, int], window: Window) -> tuple[int, int]:
    """Return rows and columns of an index image with a border that no tap leaves."""
    kernel, stride, padding, dilation = window
    reach = dilation * (kernel - 1)
    rows, columns = (
        padding + max(n, (o - 1) * stride - padding + reach + 1) for o, n in zip(out_shape, in_shape, strict=True)
    )
    return rows, columns


def _in_loops(key: Tensor) -> bool:
    """On the CPU the integers are walked in compiled loops, elsewhere by whole tensors; a test holds one against the other."""
    return key.device.type == "cpu"


@njit(cache=True, nogil=True)
def mark_ranks(marks: U8x1) -> tuple[I64x1, I32x1]:  # pragma: no cover
    """Return ascending places (M,) int64 of the ones among marks (S,) uint8, S divisible by 8, and (S,) int32: each one's
    number.
    """
    n, words = 0, marks.view(np.uint64)
    for w in words:
        # The product's highest byte is the sum of the word's eight.
        n += np.int64(w * np.uint64(0x0101010101010101) >> np.uint64(56))
    # One place to spare: writing always and moving on only past a one costs no branch that is guessed wrong.
    found, rank, n = np.empty(n + 1, np.int64), np.empty(marks.shape[0], np.int32), 0
    for w in range(words.shape[0]):
        if words[w]:
            for k in range(8 * w, 8 * w + 8):
                found[n], rank[k] = k, n
                n += marks[k]
    return found[:n], rank


@njit(cache=True, nogil=True)
def collect_distinct(key: I64x1, marks: U8x1) -> tuple[I64x1, I64x1]:  # pragma: no cover
    """Return ascending distinct keys and the place of each key among them; marks: zeros for every key there may be."""
    for k in key:
        marks[k] = 1
    found, rank = mark_ranks(marks)
    row = np.empty(key.shape[0], np.int64)
    for i in range(key.shape[0]):
        row[i] = rank[key[i]]
    return found, row


@njit(cache=True, nogil=True)
def collect_parents(
    key: I64x1, in_rows: int, in_columns: int, batch_size: int, rows: int, columns: int, stride: int
) -> I64x1:  # pragma: no cover
    """As parent_sites, of ascending keys."""
    marks = np.zeros(batch_size * rows * columns // 8 * 8 + 8, np.uint8)
    start, end, first = 0, 0, 0
    for k in key:
        if k >= end:
            line = k // in_columns
            start, end, batch = line * in_columns, (line + 1) * in_columns, line // in_rows
            first = (batch * rows + (line - batch * in_rows) // stride) * columns
        marks[first + (k - start) // stride] = 1
    return mark_ranks(marks)[0]


@njit(cache=True, nogil=True)
def collect_finer(
    key: I64x1, in_rows: int, in_columns: int, rows: int, columns: int, ratio: int, out: I64x1
) -> None:  # pragma: no cover
    """As finer_keys, of ascending keys."""
    start, end, first = 0, 0, 0
    for i in range(key.shape[0]):
        if key[i] >= end:
            line = key[i] // in_columns
            start, end, batch = line * in_columns, (line + 1) * in_columns, line // in_rows
            first = (batch * rows + (line - batch * in_rows) * ratio) * columns
        out[i] = first + (key[i] - start) * ratio


@njit(cache=True, nogil=True)
def collect_pairs(
    out_key: I64x1,
    in_key: I64x1,
    out_shape: tuple[int, int],
    in_shape: tuple[int, int],
    bordered: BorderedImages,
    window: Window,
    taps: int,
) -> Pairs:  # pragma: no cover
    """Return pairs of so many taps; bordered: the images that hold the inputs."""
    kernel, stride, padding, dilation = window
    batch_size, rows, columns = bordered
    image = np.full(batch_size * rows * columns, in_key.shape[0], np.int32)
    _place(in_key, in_shape[0], in_shape[1], rows, columns, padding, image)
    first, counts = np.empty(out_key.shape[0], np.int32), np.empty(taps, np.int64)
    _place_first(out_key, out_shape[0], out_shape[1], rows, columns, stride, first)
    max_pairs = taps * out_key.shape[0] + 1
    source, target = np.empty(max_pairs, np.int64), np.empty(max_pairs, np.int64)
    steps = _TapSteps(columns * dilation, dilation, kernel)
    met = _meet(image, first, steps, in_key.shape[0], source, target, counts)
    return Pairs(source[:met], target[:met], counts)


@njit(cache=True, nogil=True)
def _place(
    key: I64x1, in_rows: int, in_columns: int, rows: int, columns: int, padding: int, image: I32x1
) -> None:  # pragma: no cover
    """The number of each of ascending keys, at its place in an image of rows and columns with a border."""
    end, shift = 0, 0
    for i in range(key.shape[0]):
        if key[i] >= end:
            line = key[i] // in_columns
            end, batch = (line + 1) * in_columns, line // in_rows
            shift = (batch * rows + line - batch * in_rows + padding) * columns + padding - line * in_columns
        image[key[i] + shift] = i


@njit(cache=True, nogil=True)
def _place_first(
    key: I64x1, out_rows: int, out_columns: int, rows: int, columns: int, stride: int, first: I32x1
) -> None:  # pragma: no cover
    """Where in such an image the first tap of each of ascending keys lies."""
    end, shift = 0, 0
    for o in range(key.shape[0]):
        if key[o] >= end:
            line = key[o] // out_columns
            end, batch = (line + 1) * out_columns, line // out_rows
            shift = (batch * rows + (line - batch * out_rows) * stride) * columns - line * out_columns * stride
        first[o] = key[o] * stride + shift


@njit(cache=True, nogil=True)
def _meet(
    image: I32x1, first: I32x1, steps: _TapSteps, n_in: int, source: I64x1, target: I64x1, counts: I64x1
) -> int:  # pragma: no cover
    """Fills rows source and target of pairs, tap by tap, and counts (taps,); how many pairs there are."""
    down, across, kernel = steps
    at = 0
    for t in range(counts.shape[0]):
        step, before = t // kernel * down + t % kernel * across, at
        # Writing always and moving on only past a pair costs no branch that is guessed wrong.
        for o in range(first.shape[0]):
            found = image[first[o] + step]
            source[at], target[at] = found, o
            at += found < n_in
        counts[t] = at - before
    return int(at)
