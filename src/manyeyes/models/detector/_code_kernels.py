# SPDX-License-Identifier: Apache-2.0
"""Decode codes of tokens in one compiled loop; ``codebook`` and ``proposal_codes`` are the reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, F32x3, I64x1, U8x1, U8x2, njit


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
