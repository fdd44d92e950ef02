# SPDX-License-Identifier: Apache-2.0
"""Communication of agents: token selection, wire format, channel simulation and inboxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.comms.bandwidth import (
        allocate_equal_share as allocate_equal_share,
        allocate_max_min_fair as allocate_max_min_fair,
    )
    from manyeyes.comms.channel import (
        CHANNELS as CHANNELS,
        Channel as Channel,
        ChannelPreset as ChannelPreset,
        Delivery as Delivery,
        Transmission as Transmission,
        channel_preset as channel_preset,
    )
    from manyeyes.comms.drop_counts import DropCounts as DropCounts
    from manyeyes.comms.entropy import CodeTables as CodeTables
    from manyeyes.comms.inbox import Inbox as Inbox, ReceivedMessage as ReceivedMessage
    from manyeyes.comms.local_bus import LocalBus as LocalBus
    from manyeyes.comms.primitives import PacketError as PacketError
    from manyeyes.comms.receiver_limits import ReceiverLimits as ReceiverLimits
    from manyeyes.comms.request_map import (
        build_request_map as build_request_map,
        compute_request_weights as compute_request_weights,
    )
    from manyeyes.comms.token_selection import select_within_budget as select_within_budget
    from manyeyes.comms.wire import (
        Fragment as Fragment,
        assemble as assemble,
        decode_packet as decode_packet,
        encode as encode,
    )

__getattr__, __dir__ = attach(__name__)
