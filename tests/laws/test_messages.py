# SPDX-License-Identifier: Apache-2.0
"""A message that was decoded once is encoded and decoded without any further loss, in every encoding."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import assemble, decode_packet, encode
from manyeyes.comms.payloads import TOKEN_ENCODINGS
from manyeyes.datatypes import Message


def pass_through(message: Message, encoding, mtu: int) -> Message:
    return assemble(map(decode_packet, encode(message, token_encoding=encoding, mtu=mtu)))


@pytest.mark.parametrize("encoding", TOKEN_ENCODINGS)
@given(st.from_type(Message), st.sampled_from((400, 1400, 60_000)))
def test_decode_inverts_encode(assert_same, encoding, message, mtu) -> None:
    if encoding in ("codebook", "clusters") and message.tokens is not None:
        codes = (message.tokens.features * 40).to(torch.uint8)
        # Rows of clusters are pairs of bytes of finite float16.
        codes = (codes & 63).repeat_interleave(2, 1) if encoding == "clusters" else codes
        message = replace(message, tokens=message.tokens.with_features(codes))
    once = pass_through(message, encoding, mtu)
    twice = pass_through(once, encoding, mtu)
    # Of equal parts of a quaternion either may be left out. The step of an int8 channel follows its maximum, which the first
    # rounding may have lowered.
    assert_same(twice.world_from_agent, once.world_from_agent, 2e-9)
    assert_same(replace(twice, world_from_agent=once.world_from_agent), once, 0.05 if encoding == "int8" else 0.0)
