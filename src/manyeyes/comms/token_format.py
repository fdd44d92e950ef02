# SPDX-License-Identifier: Apache-2.0
"""Format of the tokens of one model; tokens of another format are rejected on reception.

Weights fix the grid, the channels and the range of what they send, so equal fingerprints imply all three. What a packet holds
is therefore compared for equality, not for plausibility.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.comms import primitives
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.payloads import TokenEncoding, TokenRows
from manyeyes.datatypes import BevGrid, SparseBev

TokenRefusal = Literal["wrong_model", "grid", "width", "value"]

MAX_TOKEN_VALUE = 32.0
"""Largest magnitude of a value that is sent."""
PEAK_FACTOR = 4.0
"""Largest magnitude of a channel, as a multiple of its peak in training."""
MIN_PEAK = 2.0
"""Channels with smaller peaks are bounded as if they had this one."""
_ROUNDING = 1.01
"""int8 rounds a value up by half a step at most, 1/254 of the largest."""


@dataclass(frozen=True, eq=False)
class TokenFormat:
    """The form of one model's tokens.

    fingerprint: 8 bytes that name the weights. grid: the lattice of the tokens. channels: of a row of floats. tables: of the
    codebook, whose rows of codes are read by them; None where the weights have none. peaks: of each channel's magnitude in
    training; None bounds all channels by MAX_TOKEN_VALUE. cluster_form: channels of a row of a cluster and own bytes of a token,
    where the weights make clusters. max_values: (channels,) bounds that follow from the peaks.
    """

    fingerprint: bytes
    grid: BevGrid
    channels: int
    tables: CodeTables | None = None
    peaks: tuple[float, ...] | None = None
    cluster_form: tuple[int, int] | None = None
    max_values: NDArray[np.float32] = field(init=False, repr=False)
    _bounds: dict[TokenEncoding, NDArray[np.int64]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        peaks = [MAX_TOKEN_VALUE] * self.channels if self.peaks is None else self.peaks
        bounds = np.minimum(PEAK_FACTOR * np.maximum(peaks, MIN_PEAK), MAX_TOKEN_VALUE)
        object.__setattr__(self, "max_values", bounds.astype(np.float32))
        object.__setattr__(self, "_bounds", _integer_bounds(bounds * _ROUNDING))

    def check_packet(self, fingerprint: bytes, rows: TokenRows) -> TokenRefusal | None:
        """Why the tokens of one packet are not of this form; None where they are."""
        if fingerprint != self.fingerprint:
            return "wrong_model"
        if rows.grid != self.grid:
            return "grid"
        if rows.encoding == "codebook":
            return None if self.tables is not None and rows.channels == self.tables.width else "width"
        is_clustered = rows.encoding == "clusters"
        if (rows.channels, rows.own_bytes) != (self.cluster_form if is_clustered else (self.channels, 0)):
            return "width"
        return None if self._is_within_range(rows) else "value"

    def _is_within_range(self, rows: TokenRows) -> bool:
        values = np.frombuffer(rows.values, np.uint8)
        if rows.encoding == "int8":
            codes = np.frombuffer(rows.scales, np.uint8)
            return bool(primitives.are_steps_within(values, codes, self._bounds["int8"]))
        if rows.encoding == "clusters":
            table = np.frombuffer(rows.scales, np.uint8)
            return bool(primitives.are_floats_within(table, 2, self._bounds["float16"][: rows.channels]))
        size = 4 if rows.encoding == "float32" else 2
        return bool(primitives.are_floats_within(values, size, self._bounds[rows.encoding]))

    def check_tokens(self, tokens: SparseBev) -> TokenRefusal | None:
        """Return the same of tokens that were read already, rows of floats (N, channels)."""
        if tokens.grid != self.grid:
            return "grid"
        if not tokens.features.is_floating_point() or tokens.features.shape[1] != self.channels:
            return "width"
        within = primitives.are_within(tokens.features.float().contiguous().numpy(), self.max_values * _ROUNDING)
        return None if within else "value"

    def clamp(self, features: Tensor) -> Tensor:
        """Return features (N, channels) as they may be sent."""
        bound = torch.from_numpy(self.max_values)
        return features.clamp(-bound, bound)


def _integer_bounds(bounds: NDArray[np.float64]) -> dict[TokenEncoding, NDArray[np.int64]]:
    """Return bounds (C,) as the bits of floats, and as the largest int8 step by scale code and channel, flat."""
    scales = np.maximum(primitives.SCALES[:, None].astype(np.float64), 1e-9)
    return {
        "float32": bounds.astype(np.float32).view(np.uint32).astype(np.int64),
        "float16": bounds.astype(np.float16).view(np.uint16).astype(np.int64),
        "int8": np.minimum(np.floor(127 * bounds / scales), 128).astype(np.int64).ravel(),
    }
