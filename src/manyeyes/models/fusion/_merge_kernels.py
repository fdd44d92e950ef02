# SPDX-License-Identifier: Apache-2.0
"""Encoding of received tokens and merge of the tokens of each cell, each in one compiled call: for inference on the CPU.

``positional_encoding`` and ``token_merge`` hold the references. Products run at the rate of ``ops._sparse_conv_kernels``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import nn

from manyeyes._jit import F32x1, F32x2, F32x4, I64x1, njit, set_row
from manyeyes.ops._sparse_conv_kernels import LANES, add_products, empty_rows, panels


class LayerPair(NamedTuple):
    """Two linear layers with ReLU between: ``panels`` (1, outputs / width, inputs, width) of each, and the bias of the first."""

    inner: F32x4
    bias: F32x1
    outer: F32x4


class EncodingWeights(NamedTuple):
    """Weights of ``positional_encoding.SpatioTemporalEncoding``.

    scale: (P,) of a proposal; temporal: (C, C) inputs by outputs; frequency: (C / 2,) of an age.
    """

    layers: LayerPair
    scale: F32x1
    temporal: F32x2
    frequency: F32x1


class MergeWeights(NamedTuple):
    """Weights of ``token_merge.TokenMerge``: proposal (3,), feature (C,), scale (P,) of a proposal, and two linear layers."""

    layers: LayerPair
    proposal: F32x1
    feature: F32x1
    scale: F32x1


class MergeColumns(NamedTuple):
    """Columns of a proposal: heat, IoU, log sigma of the position, offset, and the end of those that statistics hold."""

    heat: int
    iou: int
    log_sigma: int
    offset: int
    end: int


def layer_pair(inner: nn.Linear, outer: nn.Linear) -> LayerPair | None:
    """Return copies of two layers; None where the loops do not know such."""
    if any(layer.out_features % LANES or layer.weight.device.type != "cpu" for layer in (inner, outer)):
        return None
    first, second = (panels(layer.weight.detach().float().T[None]) for layer in (inner, outer))
    return LayerPair(first, inner.bias.detach().float().numpy().copy(), second)


@njit(cache=True, nogil=True)
def _add_layers(inputs: F32x2, layers: LayerPair, out: F32x2) -> None:  # pragma: no cover
    """Add the outputs of both layers to out (N, D); inputs: (N, C)."""
    n = inputs.shape[0]
    rows, counts = np.arange(n), np.full(1, n)
    hidden = empty_rows(n, layers.bias.shape[0])
    for i in range(n):
        set_row(hidden[i], layers.bias)
    add_products(inputs, layers.inner, 0, 1, rows, rows, counts, hidden)
    flat = hidden.reshape(-1)
    for i in range(np.uintp(flat.shape[0])):
        flat[i] = max(flat[i], np.float32(0))
    add_products(hidden, layers.outer, 0, 1, rows, rows, counts, out)


@njit(cache=True, nogil=True)
def encode_tokens(
    features: F32x2,
    pose_context: F32x2,
    cell_offset: F32x2,
    proposal: F32x2,
    weights: EncodingWeights,
    num_frame_columns: int,
) -> F32x2:  # pragma: no cover
    """Return features (N, C) plus their encoding; the first columns of pose_context describe the frame, the last is the age."""
    n, channels = features.shape
    num_proposal_columns = proposal.shape[1]
    inputs = empty_rows(n, num_frame_columns + 2 + num_proposal_columns + pose_context.shape[1] - num_frame_columns)
    out, when, timed = empty_rows(n, channels), np.zeros(channels, np.float32), np.float32(0)
    for i in range(n):
        row, context, stated = inputs[i], pose_context[i], proposal[i]
        for k in range(num_frame_columns):
            row[k] = context[k]
        row[num_frame_columns], row[num_frame_columns + 1] = cell_offset[i, 0], cell_offset[i, 1]
        behind = row[num_frame_columns + 2 :]
        for k in range(np.uintp(num_proposal_columns)):
            behind[k] = stated[k] * weights.scale[k]
        for k in range(num_frame_columns, context.shape[0]):
            row[2 + num_proposal_columns + k] = context[k]
        age = pose_context[i, -1]
        # Tokens of one message have one age; that of age 0 has no encoding.
        if age != timed:
            timed = age
            when[:] = np.float32(0)
            for k in range(weights.frequency.shape[0]):
                angle = age * weights.frequency[k]
                sine, bend = np.sin(angle), np.cos(angle) - np.float32(1)
                for c in range(channels):
                    when[c] += sine * weights.temporal[2 * k, c] + bend * weights.temporal[2 * k + 1, c]
        to, given = out[i], features[i]
        for c in range(np.uintp(channels)):
            to[c] = given[c] + when[c]
    _add_layers(inputs, weights.layers, out)
    return out


@njit(cache=True, nogil=True)
def _number_cells(key: I64x1, size: int) -> tuple[I64x1, I64x1]:  # pragma: no cover
    """Return the distinct keys of key (N,) in [0, size), ascending, and the number (N,) of each among them."""
    rank, cells = np.zeros(size, np.int64), 0
    for k in key:
        rank[k] = 1
    for k in range(size):
        here = rank[k]
        rank[k] = cells
        cells += here
    found, row = np.empty(cells, np.int64), np.empty(key.shape[0], np.int64)
    for i in range(key.shape[0]):
        row[i] = rank[key[i]]
        found[row[i]] = key[i]
    return found, row


@njit(cache=True, nogil=True)
def _add_dots(features: F32x2, weight: F32x1, out: F32x1) -> None:  # pragma: no cover
    """out (N,) += features (N, C) @ weight, summed in the order of the columns; sums of eight rows do not wait for each other."""
    n, channels = features.shape
    whole = n // 8 * 8
    for i in range(0, whole, 8):
        a, b, c, d = out[i], out[i + 1], out[i + 2], out[i + 3]
        e, f, g, h = out[i + 4], out[i + 5], out[i + 6], out[i + 7]
        for k in range(channels):
            w = weight[k]
            a += w * features[i, k]
            b += w * features[i + 1, k]
            c += w * features[i + 2, k]
            d += w * features[i + 3, k]
            e += w * features[i + 4, k]
            f += w * features[i + 5, k]
            g += w * features[i + 6, k]
            h += w * features[i + 7, k]
        out[i], out[i + 1], out[i + 2], out[i + 3] = a, b, c, d
        out[i + 4], out[i + 5], out[i + 6], out[i + 7] = e, f, g, h
    for i in range(whole, n):
        for k in range(channels):
            out[i] += weight[k] * features[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(
    features: F32x2,
    boxes: F32x2,
    pose_context: F32x2,
    drift: float,
    row: I64x1,
    num_cells: int,
    weights: MergeWeights,
    columns: MergeColumns,
) -> F32x1:  # pragma: no cover
    """Return the softmax weight (N,) of each token within its cell; drift: growth of sigma in one unit of age."""
    n = features.shape[0]
    logit, peak, total = (
        np.empty(n, np.float32),
        np.full(num_cells, -np.inf, np.float32),
        np.zeros(num_cells, np.float32),
    )
    for i in range(n):
        sigma = np.exp(min(max(boxes[i, columns.log_sigma], np.float32(-5)), np.float32(3)))
        moved = np.float32(drift) * pose_context[i, 4]
        blur = np.log(sigma * sigma + (pose_context[i, 3] * pose_context[i, 3] + moved * moved)) / np.float32(2)
        value = weights.proposal[0] * boxes[i, columns.heat] + weights.proposal[1] * boxes[i, columns.iou]
        logit[i] = value + weights.proposal[2] * blur
    _add_dots(features, weights.feature, logit)
    for i in range(n):
        peak[row[i]] = max(peak[row[i]], logit[i])
    for i in range(n):
        logit[i] = np.exp(logit[i] - peak[row[i]])
        total[row[i]] += logit[i]
    for i in range(n):
        logit[i] /= total[row[i]]
    return logit


@njit(cache=True, nogil=True)
def merge_tokens(
    features: F32x2,
    proposal: F32x2,
    cell_offset: F32x2,
    pose_context: F32x2,
    drift: float,
    key: I64x1,
    size: int,
    weights: MergeWeights,
    columns: MergeColumns,
) -> tuple[I64x1, F32x2, F32x2]:  # pragma: no cover
    """Return keys (M,) of the occupied cells of [0, size), their merged features (M, C) and proposals (M, P)."""
    n, channels = features.shape
    found, row = _number_cells(key, size)
    cells, num_proposal_columns, at = found.shape[0], proposal.shape[1], columns.offset
    boxes = proposal.copy()
    for i in range(n):
        boxes[i, at] += cell_offset[i, 0]
        boxes[i, at + 1] += cell_offset[i, 1]
    share = _weigh(features, boxes, pose_context, drift, row, cells, weights, columns)
    merged, merged_boxes = empty_rows(cells, channels), np.zeros((cells, num_proposal_columns), np.float32)
    merged[:] = np.float32(0)
    statistics = np.zeros((cells, columns.end + 4), np.float32)
    count, score, apart = columns.end, columns.end + 1, columns.end + 2
    for i in range(n):
        r, w = row[i], share[i]
        to, given, box, stated = merged[r], features[i], merged_boxes[r], boxes[i]
        for k in range(np.uintp(num_proposal_columns)):
            box[k] += w * stated[k]
        for c in range(np.uintp(channels)):
            to[c] += w * given[c]
        statistics[r, count] += np.float32(1)
        statistics[r, score] += np.float32(1) / (np.float32(1) + np.exp(-boxes[i, columns.heat]))
    for i in range(n):
        for k in range(2):
            away = boxes[i, at + k] - merged_boxes[row[i], at + k]
            statistics[row[i], apart + k] += share[i] * (away * away)
    for r in range(cells):
        for k in range(columns.end):
            statistics[r, k] = merged_boxes[r, k] * weights.scale[k]
        statistics[r, count] = np.log1p(statistics[r, count])
        statistics[r, score] = np.log1p(statistics[r, score])
        for k in range(2):
            statistics[r, apart + k] = min(statistics[r, apart + k], np.float32(1))
    _add_layers(statistics, weights.layers, merged)
    return found, merged, merged_boxes
