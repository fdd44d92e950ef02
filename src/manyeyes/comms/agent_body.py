# SPDX-License-Identifier: Apache-2.0
"""The body of a sending agent on the wire: nine bytes of its first packet (``comms.wire``)."""

from __future__ import annotations

import math
import struct

from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes.body import MAX_OFFSET_M, MAX_SIZE_M, AgentBody

_STRUCT = struct.Struct("<3h3B")
AGENT_BODY_BYTES = _STRUCT.size
_MAX_OFFSET_CM, _MAX_SIZE_DM, _HALF_TURN = round(100 * MAX_OFFSET_M), round(10 * MAX_SIZE_M), 18_000


def pack_agent_body(body: AgentBody) -> bytes:
    """Return the bytes of a body; its height above the ground is not sent."""
    x, y = (round(100 * value) for value in body.center[:2])
    yaw = round(math.degrees(body.yaw_rad) * 100)
    yaw = (yaw + _HALF_TURN) % (2 * _HALF_TURN) - _HALF_TURN
    return _STRUCT.pack(x, y, yaw, *(max(1, round(10 * value)) for value in body.size))


def read_agent_body(content: bytes) -> AgentBody:
    """Return the body of AGENT_BODY_BYTES, standing on the sender's ground plane.

    Raises:
        PacketError: a position or a size that no vehicle has.
    """
    x, y, yaw, *size = _STRUCT.unpack(content)
    is_plausible = max(abs(x), abs(y)) <= _MAX_OFFSET_CM and -_HALF_TURN <= yaw < _HALF_TURN
    if not is_plausible or not 1 <= min(size) <= max(size) <= _MAX_SIZE_DM:
        raise PacketError("implausible", f"The body of the sender is no vehicle's: {x}, {y} cm, {yaw}, sizes {size}.")
    length, width, height = (value / 10 for value in size)
    return AgentBody.standing(x / 100, y / 100, (length, width, height), math.radians(yaw / 100))


def count_agent_body_bytes(body: AgentBody | None) -> int:
    """Return the bytes that a body adds to a message."""
    return 0 if body is None else AGENT_BODY_BYTES
