# SPDX-License-Identifier: Apache-2.0
"""Format of the tokens of one model; tokens of another format are rejected on reception.

Weights fix the grid, the channels and the range of what they send, so equal fingerprints imply all three. What a packet holds
is therefore compared for equality, not for plausibility.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from torch import Tensor

from manyeyes.comms import primitives
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.payloads import TokenRows
from manyeyes.datatypes import BevGrid, SparseBev

TokenRefusal = Literal["wrong_model", "grid", "width", "value"]

MAX_TOKEN_VALUE = 32.0
"""Largest magnitude of a value that is sent; senders clamp theirs to it."""
_ROUNDING = 1.01
"""int8 rounds a value up by half a step at most, 1/254 of the largest."""


@dataclass(frozen=True, eq=False)
class TokenFormat:
    """The form of one model's tokens.

    fingerprint: 8 bytes that name the weights. grid: the lattice of the tokens. channels: of a row of floats. tables: of the
    codebook, whose rows of codes are read by them; None where the weights have none.
    """

    fingerprint: bytes
    grid: BevGrid
    channels: int
    tables: CodeTables | None = None

    def check_packet(self, fingerprint: bytes, rows: TokenRows) -> TokenRefusal | None:
        """Why the tokens of one packet are not of this form; None where they are."""
        if fingerprint != self.fingerprint:
            return "wrong_model"
        if rows.grid != self.grid:
            return "grid"
        if rows.encoding == "codebook":
            return None if self.tables is not None and rows.channels == self.tables.width else "width"
        if rows.channels != self.channels:
            return "width"
        return None if max_magnitude(rows) <= MAX_TOKEN_VALUE * _ROUNDING else "value"

    def check_tokens(self, tokens: SparseBev) -> TokenRefusal | None:
        """Return the same of tokens that were read already, rows of floats (N, channels)."""
        if tokens.grid != self.grid:
            return "grid"
        if not tokens.features.is_floating_point() or tokens.features.shape[1] != self.channels:
            return "width"
        # NaN is within no bound.
        within = tokens.features.abs() <= MAX_TOKEN_VALUE * _ROUNDING
        return None if bool(within.all()) else "value"


def clamp_features(features: Tensor) -> Tensor:
    """Return features (N, C) as they may be sent: clamped to MAX_TOKEN_VALUE."""
    return features.clamp(-MAX_TOKEN_VALUE, MAX_TOKEN_VALUE)


def max_magnitude(rows: TokenRows) -> float:
    """Return the largest magnitude among the float values of a packet; 0 of none."""
    if not len(rows.key):
        return 0.0
    if rows.encoding == "int8":
        scale = primitives.dequantise_int8(
            np.frombuffer(rows.scales, np.uint8), np.full((1, rows.channels), 127, np.int8)
        )
        steps = np.frombuffer(rows.values, np.int8).reshape(-1, rows.channels)
        return float((np.abs(steps.astype(np.int16)).max(0) / 127 * scale[0]).max())
    return primitives.max_magnitude(rows.values, 4 if rows.encoding == "float32" else 2)
