# SPDX-License-Identifier: Apache-2.0
"""Encode tokens as codes and decode them in compiled loops; ``codebook`` and ``proposal_codes`` are the reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, F32x3, F32x5, I64x1, U8x1, U8x2, njit
from manyeyes.ops._sparse_conv_kernels import add_products, empty_rows


class CodeRules(NamedTuple):
    """Rules of ``proposal_codes``: columns (K,) of a proposal with a byte each, and their steps.

    turn: (256, 2) cosine and sine of twice the yaw of an axis byte; along: (256, 2) of the yaw. axis, direction, kind, sigma_xy,
    sigma_yaw: first columns.
    """

    columns: I64x1
    steps: F32x1
    turn: F32x2
    along: F32x2
    axis: int
    direction: int
    kind: int
    sigma_xy: int
    sigma_yaw: int
    num_kinds: int
    leads: int
    lead_step: float
    facing_step: float
    sigma_low: float
    sigma_step: float


@njit(cache=True, nogil=True)
def decode_rows(codes: U8x2, centres: F32x3, rules: CodeRules, out: F32x2) -> None:  # pragma: no cover
    """Write tokens (N, C + PROPOSAL_DIM) of codes (N, stages + PROPOSAL_CODES); out begins as zeros.

    centres: (stages, size, C); higher indices are the last centre.
    """
    stages, size, channels = centres.shape
    for i in range(len(codes)):
        feature = out[i, :channels]
        for s in range(stages):
            feature += centres[s, min(np.int64(codes[i, s]), size - 1)]
        _decode_proposal(codes[i, stages:], rules, out[i, channels:])


@njit(cache=True, nogil=True)
def _decode_proposal(code: U8x1, rules: CodeRules, row: F32x1) -> None:  # pragma: no cover
    """Write one proposal; rounding is that of the reference, number by number."""
    singles = len(rules.columns)
    for k in range(singles):
        row[rules.columns[k]] = np.float32(np.int64(code[k]) - 128) * rules.steps[k]
    axis, facing, kind, sigma = code[singles], code[singles + 1], np.int64(code[singles + 2]), code[singles + 3]
    logit = np.float32(np.float32(np.int64(facing) - 128) * np.float32(rules.facing_step))
    for k in range(2):
        row[rules.axis + k] = rules.turn[axis, k]
        row[rules.direction + k] = logit * rules.along[axis, k]
    lead = (np.float32(kind % rules.leads) + np.float32(0.5)) * np.float32(rules.lead_step / 2)
    for k in range(rules.num_kinds):
        row[rules.kind + k] = lead if k == kind // rules.leads else -lead
    low, step = np.float32(rules.sigma_low), np.float32(rules.sigma_step)
    row[rules.sigma_xy] = low + step * np.float32(sigma // 16)
    row[rules.sigma_yaw] = low + step * np.float32(sigma % 16)


class CentreTables(NamedTuple):
    """Centres of a codebook (stages, size, C), their squared norms (stages, size), and the ``panels`` of each stage's centres as
    the columns of a matrix, (stages, 1, size / width, C, width).
    """

    centres: F32x3
    squares: F32x2
    panels: F32x5


@njit(cache=True, nogil=True)
def encode_features(features: F32x2, tables: CentreTables, out: U8x2) -> None:  # pragma: no cover
    """Write to out (N, stages) of features (N, C) the nearest centre of each stage to the rest, the first of ties."""
    n, (stages, size, channels) = len(features), tables.centres.shape
    rest, products = features.copy(), empty_rows(n, size)
    rows, counts = np.arange(n), np.full(1, n)
    for s in range(stages):
        products[:] = np.float32(0)
        add_products(rest, tables.panels[s], 0, 1, rows, rows, counts, products)
        for i in range(n):
            code = _find_nearest(products[i], tables.squares[s])
            out[i, s] = code
            for c in range(channels):
                rest[i, c] -= tables.centres[s, code, c]


@njit(cache=True, nogil=True)
def _find_nearest(products: F32x1, squares: F32x1) -> int:  # pragma: no cover
    """Return the first column with the minimum of square - 2 * product; products are overwritten."""
    minimum = np.float32(np.inf)
    for k in range(np.uintp(products.shape[0])):
        products[k] = squares[k] - np.float32(2) * products[k]
        minimum = min(minimum, products[k])
    for k in range(products.shape[0]):
        if products[k] == minimum:
            return k
    return 0


@njit(cache=True, nogil=True)
def encode_proposals(
    proposal: F32x2, yaw: F32x1, rules: CodeRules, axis_step: float, out: U8x2
) -> None:  # pragma: no cover
    """Write to out (N, PROPOSAL_CODES) the codes of proposals (N, P), whose axes have yaws (N,); axis_step: bytes a radian.

    Rounding is that of the reference, number by number.
    """
    singles = len(rules.columns)
    for i in range(len(proposal)):
        row, code = proposal[i], out[i]
        for k in range(singles):
            code[k] = _encode_signed(row[rules.columns[k]], rules.steps[k])
        axis = np.int64(np.rint(yaw[i] * np.float32(axis_step))) % 256
        along = rules.along[axis]
        facing = row[rules.direction] * along[0] + row[rules.direction + 1] * along[1]
        best, second = 0, np.float32(-np.inf)
        for k in range(1, rules.num_kinds):
            value = row[rules.kind + k]
            if value > row[rules.kind + best]:
                best, second = k, row[rules.kind + best]
            else:
                second = max(second, value)
        lead = np.floor((row[rules.kind + best] - second) / np.float32(rules.lead_step))
        lead = min(max(lead, np.float32(0)), np.float32(rules.leads - 1))
        code[singles], code[singles + 1] = axis, _encode_signed(facing, np.float32(rules.facing_step))
        code[singles + 2] = best * rules.leads + np.int64(lead)
        code[singles + 3] = 16 * _encode_sigma(row[rules.sigma_xy], rules) + _encode_sigma(row[rules.sigma_yaw], rules)


@njit(cache=True, nogil=True)
def _encode_signed(value: np.float32, step: np.float32) -> int:  # pragma: no cover
    """Return whole steps as 1 to 255, with 128 for 0."""
    return int(min(max(np.rint(value / step), np.float32(-127)), np.float32(127))) + 128


@njit(cache=True, nogil=True)
def _encode_sigma(value: np.float32, rules: CodeRules) -> int:  # pragma: no cover
    """Return the logarithm of a sigma as 0 to 15."""
    steps = np.rint((value - np.float32(rules.sigma_low)) / np.float32(rules.sigma_step))
    return int(min(max(steps, np.float32(0)), np.float32(15)))
