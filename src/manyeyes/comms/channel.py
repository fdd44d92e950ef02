# SPDX-License-Identifier: Apache-2.0
"""Simulated radio channel between agents: shared airtime, loss that grows with distance and comes in bursts, latency.

Delay follows from the bytes sent. All senders share one medium of ``rate_bps * busy_ratio_limit``; packets that wait are
served one per sender in turn (ascending ids), and what of a sender's message still waits when its next message comes is
withdrawn, because newer information is worth more. A receiver loses packets by a two-state chain (Gilbert 1960, Elliott
1963) along the packets of one message, with the stationary loss of its distance. Every draw is a function of (seed,
sender, receiver, time, packet number) alone, and one draw serves every level of loss: what is lost at a low level is
lost at every higher one, so that curves are paired.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_uniform

NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class ChannelPreset:
    """One kind of radio.

    rate_bps: bits per second of the shared medium (inf: no queue). mtu: largest packet, bytes. per_packet_overhead_bytes:
    headers below ours, preamble and gaps as bytes at that rate. busy_ratio_limit: share of the airtime that may be used.
    loss_at_m: (distance, probability) pairs, ascending, linear between and flat outside. mean_burst_packets: mean length
    of a run of lost packets, 1 or less for independent losses. base_latency_s and jitter_s: every packet comes later by
    base + uniform(0, jitter).
    """

    name: str
    rate_bps: float
    mtu: int = 1398
    per_packet_overhead_bytes: int = 0
    busy_ratio_limit: float = 1.0
    loss_at_m: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    mean_burst_packets: float = 1.0
    base_latency_s: float = 0.0
    jitter_s: float = 0.0

    def __post_init__(self) -> None:
        distances = [d for d, _ in self.loss_at_m]
        if not (self.rate_bps > 0 and 0 < self.busy_ratio_limit <= 1 and self.mtu > 0):
            raise ConfigError(f"ChannelPreset needs rate_bps > 0, mtu > 0 and 0 < busy_ratio_limit <= 1; got {self}.")
        if not distances or distances != sorted(distances) or not all(0 <= p <= 1 for _, p in self.loss_at_m):
            raise ConfigError(
                f"ChannelPreset.loss_at_m is ascending (metres, probability) pairs; got {self.loss_at_m}."
            )
        if min(self.base_latency_s, self.jitter_s, self.per_packet_overhead_bytes) < 0:
            raise ConfigError(f"ChannelPreset needs latency, jitter and overhead of at least 0; got {self}.")

    def loss(self, distance_m: float) -> float:
        """Long-run share of packets lost at a distance."""
        distances, losses = zip(*self.loss_at_m)
        return float(np.interp(distance_m, distances, losses))

    def with_loss(self, probability: float) -> ChannelPreset:
        """Return the same radio with one loss at every distance, for studies."""
        return replace(self, loss_at_m=((0.0, probability),))

    def airtime_ns(self, packet_bytes: int) -> int:
        """Return how long one packet is on the air."""
        bits = 8 * (packet_bytes + self.per_packet_overhead_bytes)
        return 0 if math.isinf(self.rate_bps) else math.ceil(bits * NS_PER_S / self.rate_bps)

    def occupied_ns(self, packet_bytes: int) -> int:
        """After how long the next packet may begin: airtime and the idle time that the busy limit demands."""
        return math.ceil(self.airtime_ns(packet_bytes) / self.busy_ratio_limit)


# Rates and latencies are those of the radio standards; loss against distance and overheads are plausible round figures for an
# urban street, not measurements: change them by dataclasses.replace. Overhead of ITS-G5: GeoNetworking 40, BTP 4,
# LLC 8, MAC 30 bytes, then preamble and mean access time (about 150 us) as bytes at the rate.
CHANNELS: tuple[ChannelPreset, ...] = (
    ChannelPreset("ideal", math.inf),
    ChannelPreset(
        "its-g5-6",
        6e6,
        per_packet_overhead_bytes=195,
        busy_ratio_limit=0.6,
        loss_at_m=((0, 0.01), (100, 0.02), (200, 0.05), (300, 0.15), (400, 0.35), (600, 0.9)),
        mean_burst_packets=3,
        base_latency_s=0.002,
        jitter_s=0.003,
    ),
    ChannelPreset(
        "its-g5-27mbps",
        27e6,
        per_packet_overhead_bytes=590,
        busy_ratio_limit=0.6,
        loss_at_m=((0, 0.01), (50, 0.03), (100, 0.12), (150, 0.4), (250, 0.95)),
        mean_burst_packets=3,
        base_latency_s=0.002,
        jitter_s=0.003,
    ),
    ChannelPreset(
        "lte-v2x",
        10e6,
        per_packet_overhead_bytes=60,
        busy_ratio_limit=0.6,
        loss_at_m=((0, 0.01), (150, 0.02), (300, 0.06), (450, 0.2), (700, 0.9)),
        mean_burst_packets=2,
        base_latency_s=0.02,
        jitter_s=0.08,
    ),
    ChannelPreset(
        "nr-sidelink",
        40e6,
        per_packet_overhead_bytes=60,
        busy_ratio_limit=0.7,
        loss_at_m=((0, 0.005), (150, 0.01), (300, 0.04), (450, 0.15), (700, 0.9)),
        mean_burst_packets=2,
        base_latency_s=0.005,
        jitter_s=0.01,
    ),
    ChannelPreset(
        "cellular",
        50e6,
        per_packet_overhead_bytes=60,
        loss_at_m=((0, 0.002),),
        mean_burst_packets=8,
        base_latency_s=0.02,
        jitter_s=0.04,
    ),
)


FORMER_NAMES = {"its-g5": "its-g5-6"}
"""Names of presets in stored commands and results, with today's."""


def channel_preset(name: str) -> ChannelPreset:
    """Return the preset of that name from CHANNELS, or of a name that it had."""
    for preset in CHANNELS:
        if preset.name == FORMER_NAMES.get(name, name):
            return preset
    raise ConfigError(f"There is no channel {name!r}; known are {', '.join(p.name for p in CHANNELS)}.")


@dataclass(frozen=True)
class Transmission:
    """One agent's packets, handed to its radio at one instant. position_xy: metres, world."""

    agent_id: int
    position_xy: tuple[float, float]
    packets: tuple[bytes, ...]
    sent_ns: int


@dataclass(frozen=True)
class PacketInFlight:
    """One packet that has left its sender's antenna. number: its place among what the agent sent at sent_ns."""

    transmission: Transmission
    number: int
    packet: bytes
    departure_ns: int


@dataclass(frozen=True)
class Delivery:
    """One packet at one receiver. arrival_ns - sent_ns is what the channel cost; ages count from the capture instead."""

    packet: bytes
    sender_id: int
    sent_ns: int
    arrival_ns: int


@dataclass
class _Queue:
    transmission: Transmission
    first_number: int
    at: int = 0


class SharedMedium:
    """The shared airtime: who sends when. What has been settled by :meth:`run` is not changed by later offers."""

    def __init__(self, preset: ChannelPreset) -> None:
        self.preset = preset
        self.dropped_in_queue = 0
        self._waiting: dict[int, _Queue] = {}
        self._offered: list[tuple[Transmission, int]] = []
        self._numbered: dict[int, tuple[int, int]] = {}
        self._free_ns = -(1 << 63)
        self._last_served = -(1 << 63)

    def offer(self, transmission: Transmission) -> None:
        """Hand packets to the medium; they begin no earlier than sent_ns. An agent's offers come in order of time.

        No offer is earlier than the end of the last run.
        """
        stamp, number = self._numbered.get(transmission.agent_id, (transmission.sent_ns, 0))
        number = number if stamp == transmission.sent_ns else 0
        self._numbered[transmission.agent_id] = (transmission.sent_ns, number + len(transmission.packets))
        self._offered.append((transmission, number))

    def run(self, until_ns: float) -> list[PacketInFlight]:
        """Return packets that begin before until_ns, in order of time.

        What begins at until_ns exactly cannot have arrived by then, and is left open because others may still offer at
        that instant; a medium of infinite rate has no queue and settles it too.
        """
        self._offered.sort(key=lambda item: item[0].sent_ns)
        has_queue = not math.isinf(self.preset.rate_bps)
        out: list[PacketInFlight] = []
        while self._waiting or self._offered:
            start = self._free_ns if self._waiting else max(self._free_ns, self._offered[0][0].sent_ns)
            if start > until_ns or (has_queue and start == until_ns):
                break
            while self._offered and self._offered[0][0].sent_ns <= start:
                self._enqueue(*self._offered.pop(0))
            if self._waiting:
                out.append(self._serve(start))
        # Later offers are not earlier than until_ns: agents that left are forgotten.
        self._numbered = {agent: offered for agent, offered in self._numbered.items() if offered[0] >= until_ns}
        return out

    def _enqueue(self, transmission: Transmission, first_number: int) -> None:
        old = self._waiting.get(transmission.agent_id)
        if old is not None and old.transmission.sent_ns == transmission.sent_ns:
            merged = replace(transmission, packets=old.transmission.packets + transmission.packets)
            self._waiting[transmission.agent_id] = _Queue(merged, old.first_number, old.at)
            return
        if old is not None:
            self.dropped_in_queue += len(old.transmission.packets) - old.at
            del self._waiting[transmission.agent_id]
        if transmission.packets:
            self._waiting[transmission.agent_id] = _Queue(transmission, first_number)

    def _serve(self, start: int) -> PacketInFlight:
        """Return the next packet in turn: of the lowest id above the last one served, else of the lowest."""
        agent = min(self._waiting, key=lambda i: (i <= self._last_served, i))
        queue = self._waiting[agent]
        packet = queue.transmission.packets[queue.at]
        out = PacketInFlight(
            queue.transmission, queue.first_number + queue.at, packet, start + self.preset.airtime_ns(len(packet))
        )
        queue.at += 1
        if queue.at == len(queue.transmission.packets):
            del self._waiting[agent]
        self._free_ns, self._last_served = start + self.preset.occupied_ns(len(packet)), agent
        return out


class Channel:
    """A radio preset and the seed of its losses and jitter; it keeps no state."""

    def __init__(self, preset: ChannelPreset, seed: int = 0) -> None:
        self.preset = preset
        self.seed = seed

    def transmit(
        self, transmissions: Sequence[Transmission], receiver_id: int, receiver_xy: tuple[float, float]
    ) -> tuple[Delivery, ...]:
        """What one receiver gets of everybody's sends, its own not included, in order of arrival."""
        medium = SharedMedium(self.preset)
        for send in sorted(transmissions, key=lambda s: s.sent_ns):
            medium.offer(send)
        return self.receive(medium.run(math.inf), receiver_id, receiver_xy)

    def receive(
        self, on_air: Sequence[PacketInFlight], receiver_id: int, receiver_xy: tuple[float, float]
    ) -> tuple[Delivery, ...]:
        """What one receiver gets of packets on the air, its own not included, in order of arrival."""
        messages: dict[tuple[int, int], list[PacketInFlight]] = {}
        for item in on_air:
            if item.transmission.agent_id != receiver_id:
                messages.setdefault((item.transmission.agent_id, item.transmission.sent_ns), []).append(item)
        got: list[tuple[int, int, int, Delivery]] = []
        for (sender, sent_ns), items in messages.items():
            count = 1 + max(item.number for item in items)
            distance = math.dist(items[0].transmission.position_xy, receiver_xy)
            lost = self._draw_losses(sender, receiver_id, sent_ns, count, self.preset.loss(distance))
            latency_ns = self._latency_ns(sender, receiver_id, sent_ns, count)
            for item in items:
                if not lost[item.number]:
                    arrival = item.departure_ns + int(latency_ns[item.number])
                    delivery = Delivery(item.packet, sender, sent_ns, arrival)
                    got.append((arrival, sender, item.number, delivery))
        return tuple(delivery for *_, delivery in sorted(got, key=lambda row: row[:3]))

    def _draw_losses(self, sender: int, receiver: int, sent_ns: int, count: int, loss: float) -> NDArray[np.bool_]:
        """Return (count,) which packets of a message are lost: a chain of good and bad spells with that stationary loss.

        P(bad after bad) = 1 - 1/B and P(bad after good) = loss / (B (1 - loss)), B the mean burst, at least
        1 / (1 - loss), where both equal the loss. Both grow with the loss and the first is never the smaller one:
        compared with one draw a packet, the losses of a lower level are among those of a higher one.
        """
        if loss <= 0 or loss >= 1:
            return np.full(count, loss >= 1)
        burst = max(self.preset.mean_burst_packets, 1 / (1 - loss))
        after_bad, after_good = 1 - 1 / burst, loss / (burst * (1 - loss))
        draws = keyed_uniform((count,), self.seed, "loss", sender, receiver, sent_ns).tolist()
        lost = np.zeros(count, np.bool_)
        bad = draws[0] < loss
        for k, draw in enumerate(draws):
            bad = bad if k == 0 else draw < (after_bad if bad else after_good)
            lost[k] = bad
        return lost

    def _latency_ns(self, sender: int, receiver: int, sent_ns: int, count: int) -> NDArray[np.int64]:
        """Return (count,) nanoseconds from antenna to application."""
        spread = np.zeros(count)
        if self.preset.jitter_s:
            spread = keyed_uniform((count,), self.seed, "jitter", sender, receiver, sent_ns).numpy()
        return np.rint((self.preset.base_latency_s + self.preset.jitter_s * spread) * NS_PER_S).astype(np.int64)
