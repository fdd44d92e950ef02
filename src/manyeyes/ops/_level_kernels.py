# SPDX-License-Identifier: Apache-2.0
"""Levels of a sparse encoder, each in one compiled call from keys and features to keys and features: for inference on the CPU.

The loops are those of ``folded_conv`` and ``sparse_index``. A level alone is some twenty objects and tensor operations, which take
longer than its few hundred rows; here nothing but arrays passes from one to the next. ``models.detector.encoder`` holds the twin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, F32x4, F32x5, I64x1, njit, set_row
from manyeyes.ops._sparse_conv_kernels import empty_rows
from manyeyes.ops.folded_conv import apply_layers, convolve_up
from manyeyes.ops.sparse_index import (
    BorderedImages,
    Pairs,
    Window,
    collect_distinct,
    collect_finer,
    collect_pairs,
    collect_parents,
)

_FAST = {"contract", "nsz", "nnan", "reassoc"}
_SAME, _HALF = Window(3, 1, 1, 1), Window(3, 2, 1, 1)


class ConvWeights(NamedTuple):
    """Folded layers of equal shape: the ``panels`` of each (layers, taps, D / width, C, width), and biases (layers, D)."""

    weight: F32x5
    bias: F32x2


class UpWeights(NamedTuple):
    """An inverse convolution (taps, D / width, C, width), its lateral layer (1, D / width, L, width) and the bias (D,)."""

    weight: F32x4
    lateral: F32x4
    bias: F32x1


class BatchLattice(NamedTuple):
    """Rows and columns of each grid of a batch, and their number."""

    rows: int
    columns: int
    batch_size: int


class Level(NamedTuple):
    """Occupied cells of one stride: keys (N,) int64, ascending, and features (N, C) float32."""

    key: I64x1
    features: F32x2


@njit(cache=True, nogil=True)
def _coarser(fine: BatchLattice) -> BatchLattice:  # pragma: no cover
    """Return the lattice at twice the stride."""
    return BatchLattice(-(-fine.rows // 2), -(-fine.columns // 2), fine.batch_size)


@njit(cache=True, nogil=True)
def _meet_same(key: I64x1, lattice: BatchLattice) -> Pairs:  # pragma: no cover
    """Return the pairs of a 3x3 kernel on one set of sites, of the four taps before the middle; those after it are the same pairs
    with source and target exchanged.
    """
    shape = (lattice.rows, lattice.columns)
    bordered = BorderedImages(lattice.batch_size, lattice.rows + 2, lattice.columns + 2)
    return collect_pairs(key, key, shape, shape, bordered, _SAME, 4)


@njit(cache=True, nogil=True)
def _meet_coarser(coarse: I64x1, key: I64x1, fine: BatchLattice) -> Pairs:  # pragma: no cover
    """Return the pairs of coarser sites with the finer ones below a 3x3 kernel of stride 2."""
    half = _coarser(fine)
    bordered = BorderedImages(
        fine.batch_size, 1 + max(fine.rows, 2 * half.rows), 1 + max(fine.columns, 2 * half.columns)
    )
    out_shape, in_shape = (half.rows, half.columns), (fine.rows, fine.columns)
    return collect_pairs(coarse, key, out_shape, in_shape, bordered, _HALF, 9)


@njit(cache=True, nogil=True)
def apply_pointwise(level: Level, weights: ConvWeights) -> Level:  # pragma: no cover
    """Apply layers of kernel 1."""
    none = np.empty(0, np.int64)
    features = apply_layers(
        level.features, weights.weight, weights.bias, Pairs(none, none, none), True, level.key.shape[0]
    )
    return Level(level.key, features)


@njit(cache=True, nogil=True)
def apply_stage(level: Level, lattice: BatchLattice, weights: ConvWeights) -> Level:  # pragma: no cover
    """Apply submanifold layers of kernel 3."""
    pairs = _meet_same(level.key, lattice)
    features = apply_layers(level.features, weights.weight, weights.bias, pairs, True, level.key.shape[0])
    return Level(level.key, features)


@njit(cache=True, nogil=True)
def apply_down(level: Level, lattice: BatchLattice, weights: ConvWeights) -> Level:  # pragma: no cover
    """Apply a convolution of kernel 3 and stride 2, to the parents of the occupied cells of a lattice."""
    half = _coarser(lattice)
    coarse = collect_parents(level.key, lattice.rows, lattice.columns, lattice.batch_size, half.rows, half.columns, 2)
    pairs = _meet_coarser(coarse, level.key, lattice)
    features = apply_layers(level.features, weights.weight, weights.bias, pairs, False, coarse.shape[0])
    return Level(coarse, features)


@njit(cache=True, nogil=True)
def apply_up(coarse: Level, fine: Level, lattice: BatchLattice, weights: UpWeights) -> Level:  # pragma: no cover
    """Apply an inverse convolution to the cells of a finer level, which has the lattice, added to its lateral layer."""
    pairs = _meet_coarser(coarse.key, fine.key, lattice)
    turned = Pairs(pairs.target, pairs.source, pairs.counts)
    return Level(
        fine.key, convolve_up(coarse.features, weights.weight, fine.features, weights.lateral, weights.bias, turned)
    )


@njit(cache=True, nogil=True)
def merge_levels(fine: Level, coarse: Level, coarsest: Level, lattice: BatchLattice) -> Level:  # pragma: no cover
    """Return the sums of three levels, each of twice the stride of the one before, on the cells of the first's lattice."""
    half = _coarser(lattice)
    quarter = _coarser(half)
    n, m, channels = fine.key.shape[0], coarse.key.shape[0], fine.features.shape[1]
    key = np.empty(n + m + coarsest.key.shape[0], np.int64)
    set_row(key[:n], fine.key)
    collect_finer(coarse.key, half.rows, half.columns, lattice.rows, lattice.columns, 2, key[n : n + m])
    collect_finer(coarsest.key, quarter.rows, quarter.columns, lattice.rows, lattice.columns, 4, key[n + m :])
    size = lattice.batch_size * lattice.rows * lattice.columns
    found, row = collect_distinct(key, np.zeros(size // 8 * 8 + 8, np.uint8))
    out = np.zeros((found.shape[0], channels), np.float32)
    at = 0
    for part in (fine.features, coarse.features, coarsest.features):
        for i in range(part.shape[0]):
            to = out[row[at]]
            for c in range(channels):
                to[c] += part[i, c]
            at += 1
    return Level(found, out)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _score_rows(features: F32x2, weight: F32x1, bias: np.float32) -> F32x1:  # pragma: no cover
    """Return the logits (N,) of a linear layer with one output."""
    logit = np.empty(features.shape[0], np.float32)
    for i in range(features.shape[0]):
        row, total = features[i], np.float32(0)
        for c in range(weight.shape[0]):
            total += row[c] * weight[c]
        logit[i] = total + bias
    return logit


@njit(cache=True, nogil=True)
def prune_level(
    level: Level, weight: F32x1, bias: np.float32, threshold: np.float32
) -> tuple[Level, F32x1]:  # pragma: no cover
    """Return the cells whose probability exceeds a threshold (0 keeps all), and the logits (N,) of all cells."""
    logit = _score_rows(level.features, weight, bias)
    if threshold <= 0:
        return level, logit
    n, one = level.key.shape[0], np.float32(1)
    rows, count = np.empty(n, np.int64), 0
    for i in range(n):
        rows[count] = i
        count += one / (one + np.exp(-logit[i])) > threshold
    key, features = np.empty(count, np.int64), empty_rows(count, level.features.shape[1])
    for k in range(count):
        key[k] = level.key[rows[k]]
        set_row(features[k], level.features[rows[k]])
    return Level(key, features), logit
