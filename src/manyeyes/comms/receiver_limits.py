# SPDX-License-Identifier: Apache-2.0
"""Bounds of what a receiver accepts. All checks of received packets and messages take theirs from here."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class ReceiverLimits:
    """Bounds of received packets, of messages, and of poses. Honest senders stay below all of them.

    A cloud of points (early fusion) is the longest message: lower max_message_bytes where none is expected; max_points of 0 refuses
    clouds.
    """

    # Packets and messages
    max_packet_bytes: int = 65_535
    max_message_packets: int = 2_048
    max_message_bytes: int = 2 << 20
    # Packets and bytes of one sender in instant_ns of arrivals; without arrival times: between two receptions
    instant_ns: int = 100_000_000
    max_instant_packets: int = 4_096
    max_instant_bytes: int = 4 << 20
    # Senders, and memory of all their messages, with what parsing adds
    max_senders: int = 64
    max_total_bytes: int = 48 << 20
    # A sender without packets for max_silence_ns gives way to a new one
    max_silence_ns: int = 1_000_000_000
    # Stamps: at most this much older and newer than the receiver's clock
    max_age_ns: int = 500_000_000
    max_skew_ns: int = 200_000_000
    # Messages of a sender closer than this are one instant: the one with more content is used
    min_stamp_spacing_ns: int = 20_000_000
    # Content of one message
    max_cells: int = 4_096
    max_objects: int = 256
    max_points: int = 200_000
    max_map_elements: int = 512
    # Distance of objects, map elements, free ranges and the edges of a grid from their sender
    max_range_m: float = 300.0
    # Fused: tokens of one message, beyond which all of them are excluded; senders, and tokens of all of them, at one instant
    max_fused_message_tokens: int = 2_048
    max_fused_senders: int = 16
    max_fused_tokens: int = 8_192
    # Pose of a sender relative to the receiver; displacement between its messages by speed and a jump; stated sigma
    max_tilt_rad: float = math.radians(25.0)
    max_distance_m: float = 1_000.0
    max_height_difference_m: float = 50.0
    max_speed_mps: float = 70.0
    max_pose_jump_m: float = 10.0
    max_sigma_xy_m: float = 5.0
    max_sigma_yaw_rad: float = 0.5

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (value > 0 or (f.name == "max_points" and value == 0)):
                raise ConfigError(f"ReceiverLimits.{f.name} is a number above 0; got {value!r}.")
