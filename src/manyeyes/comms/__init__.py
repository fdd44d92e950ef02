# SPDX-License-Identifier: Apache-2.0
"""Communication of agents: token selection, wire format, channel simulation and inboxes."""

from manyeyes.comms.bandwidth import allocate_equal_share, allocate_max_min_fair
from manyeyes.comms.channel import CHANNELS, Channel, ChannelPreset, Delivery, Transmission, channel_preset
from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.inbox import DropCounts, Inbox, ReceivedMessage
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.request_map import build_request_map, compute_request_weights
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.comms.wire import Fragment, assemble, decode_packet, encode

__all__ = [
    "CHANNELS",
    "Channel",
    "ChannelPreset",
    "CodeTables",
    "Delivery",
    "DropCounts",
    "Fragment",
    "Inbox",
    "LocalBus",
    "PacketError",
    "ReceivedMessage",
    "Transmission",
    "allocate_equal_share",
    "allocate_max_min_fair",
    "assemble",
    "build_request_map",
    "channel_preset",
    "compute_request_weights",
    "decode_packet",
    "encode",
    "select_within_budget",
]
