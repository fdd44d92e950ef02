# SPDX-License-Identifier: Apache-2.0
"""Bytes between agents: what to send, how it is written, what the air does to it, what is taken in."""

from manyeyes.comms.bandwidth import equal_share, fair_shares
from manyeyes.comms.channel import CHANNELS, Channel, ChannelPreset, Delivery, Send, channel_preset
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import Dropped, Inbox, Reception
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.request_map import need, request_map
from manyeyes.comms.token_selection import within_budget
from manyeyes.comms.wire import Fragment, assemble, decode_packet, encode

__all__ = [
    "CHANNELS",
    "Channel",
    "ChannelPreset",
    "CodeTables",
    "Delivery",
    "Dropped",
    "Fragment",
    "Inbox",
    "LocalBus",
    "PacketError",
    "Reception",
    "Send",
    "assemble",
    "channel_preset",
    "decode_packet",
    "encode",
    "equal_share",
    "fair_shares",
    "need",
    "request_map",
    "within_budget",
]
