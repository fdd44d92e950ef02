# SPDX-License-Identifier: Apache-2.0
"""Range of token values: what a sender clamps to passes at the receiver in every encoding, and what is beyond does not."""

from __future__ import annotations

import pytest
import torch

from manyeyes.comms.token_format import MAX_TOKEN_VALUE, MIN_PEAK, PEAK_FACTOR, TokenFormat
from manyeyes.comms.wire import TokenEncoding, decode_packet, encode
from manyeyes.datatypes import BevGrid, Message, Sites, SparseBev, Transform

GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)
MODEL = b"model-01"
PEAKED = TokenFormat(MODEL, GRID, 3, peaks=(0.0, 3.0, 100.0))
BOUNDS = [PEAK_FACTOR * MIN_PEAK, PEAK_FACTOR * 3.0, MAX_TOKEN_VALUE]


def refusals(values: list[float], token_format: TokenFormat, encoding: TokenEncoding) -> set[str | None]:
    """Of a packet of one token, and of the token after decoding."""
    tokens = SparseBev(torch.tensor([values]), Sites(torch.tensor([5]), GRID))
    message = Message(1, 0, Transform.identity(), torch.zeros(3, 3, dtype=torch.float64), MODEL, tokens=tokens)
    rows = decode_packet(encode(message, token_encoding=encoding)[0]).body
    return {token_format.check_packet(MODEL, rows), token_format.check_tokens(tokens)}  # pyright: ignore[reportArgumentType]


def test_bounds_follow_from_the_peaks_of_training() -> None:
    assert PEAKED.max_values.tolist() == BOUNDS
    assert TokenFormat(MODEL, GRID, 3).max_values.tolist() == [MAX_TOKEN_VALUE] * 3


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("encoding", ["float32", "float16", "int8"])
def test_what_is_clamped_passes_and_each_channel_is_bounded(encoding: TokenEncoding, sign: int) -> None:
    clamped = PEAKED.clamp(torch.full((1, 3), sign * 1e6))
    assert clamped[0].tolist() == [sign * bound for bound in BOUNDS]
    assert refusals(clamped[0].tolist(), PEAKED, encoding) == {None}
    for channel, bound in enumerate(BOUNDS):
        values = [0.5] * 3
        values[channel] = sign * 1.1 * bound
        assert refusals(values, PEAKED, encoding) == {"value"}
        values[channel] = sign * bound
        assert refusals(values, PEAKED, encoding) == {None}
