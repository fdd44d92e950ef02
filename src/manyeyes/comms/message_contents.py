# SPDX-License-Identifier: Apache-2.0
"""What the packets of one message hold, counted from their bytes: cells, objects, points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from manyeyes.comms import payloads
from manyeyes.comms.wire import open_packet, read_content


@dataclass(frozen=True)
class MessageContents:
    """Numbers of cells with tokens, of objects and of points in a message."""

    num_tokens: int = 0
    num_objects: int = 0
    num_points: int = 0


def count_contents(packets: Iterable[bytes]) -> MessageContents:
    """Return what packets of one message hold; several messages add up.

    Raises:
        PacketError: one is no packet, or is damaged.
    """
    counts = {payloads.TOKENS: 0, payloads.OBJECTS: 0, payloads.POINTS: 0}
    for packet in packets:
        envelope = open_packet(packet)
        if envelope.kind in counts:
            content, has_fine_scores = read_content(envelope)
            counts[envelope.kind] += payloads.count_rows(envelope.kind, content, has_fine_scores)
    return MessageContents(counts[payloads.TOKENS], counts[payloads.OBJECTS], counts[payloads.POINTS])
