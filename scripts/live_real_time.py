# SPDX-License-Identifier: Apache-2.0
"""Two agents at 10 Hz in real time: deadlines, ages and levels; and the transport's own share beside raw datagrams, in turn.

python scripts/live_real_time.py --weights costr-small --recording DATA val    # ten minutes
python scripts/live_real_time.py --minutes .2                                  # the runtime alone, with a detector of one car
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from live_team import PLACE, Tick, free_port, quantiles_ms, start_team, summarise, write_result

from manyeyes.comms.network.interface import Network
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork
from manyeyes.runtime.transports.zenoh import ZenohConfig, ZenohNetwork
from manyeyes.viz.study_table import StudyTable


@dataclass(frozen=True)
class Options:
    """Length, and what the agents run."""

    minutes: float = 10.0
    """Length of the run."""
    transport: str = "zenoh"
    """udp or zenoh."""
    weights: str | None = None
    """Weights of a detector, with --recording; by default a detector of one car."""
    recording: tuple[str, str] | None = None
    """Folder and split of a recording."""
    packets: int = 500
    """Number of packets of the comparison with raw datagrams."""
    packet_bytes: int = 1_300
    """Their length."""
    out: Path | None = None
    """Write the result as JSON."""


def open_pair(transport: str) -> tuple[Network, Network]:
    """Return two agents' networks, connected."""
    port = free_port()
    if transport == "udp":
        return UdpNetwork(UdpConfig("pair", port=port), time.monotonic_ns), UdpNetwork(
            UdpConfig("pair", port=port), time.monotonic_ns
        )
    seed = f"tcp/127.0.0.1:{port}"
    first = ZenohNetwork(ZenohConfig("pair", listen=(seed,)), 1, time.monotonic_ns)
    return first, ZenohNetwork(ZenohConfig("pair", connect=(seed,)), 2, time.monotonic_ns)


def measure_transport(transport: str, count: int, size: int) -> tuple[list[int], list[int]]:
    """Return delays (ns) of packets over a transport, and of raw datagrams on the loopback interface, in turn."""
    a, b = open_pair(transport)
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(1.0)
    through, raw = list[int](), list[int]()
    try:
        b.join(PLACE)
        until_s = time.monotonic() + 10.0
        while not b.poll() and time.monotonic() < until_s:
            a.send([b"hello"], PLACE)
            time.sleep(0.02)
        time.sleep(0.2)
        b.poll()
        for number in range(count):
            packet = number.to_bytes(4, "big") + bytes(size - 4)
            sent_ns = time.monotonic_ns()
            a.send([packet], PLACE)
            until_ns = sent_ns + 1_000_000_000
            while not (got := [r for r in b.poll() if r.packet == packet]) and time.monotonic_ns() < until_ns:
                time.sleep(0.0002)
            through += [got[0].arrival_ns - sent_ns] if got else []
            sent_ns = time.monotonic_ns()
            sender.sendto(packet, receiver.getsockname())
            with contextlib.suppress(TimeoutError):
                receiver.recv(65_535)
                raw.append(time.monotonic_ns() - sent_ns)
            time.sleep(0.002)
    finally:
        for one in (a, b, receiver, sender):
            one.close()
    return through, raw


def main(options: Options) -> None:
    """Run both measurements, and print them."""
    load = os.getloadavg()[0]
    through, raw = measure_transport(options.transport, options.packets, options.packet_bytes)
    with start_team(2, options.transport, 1.0, options.weights, options.recording) as team:
        found = team.collect(60 * options.minutes)
    ticks: list[Tick] = [tick for one in found.values() for tick in one]
    result = {
        "transport": options.transport,
        "weights": options.weights,
        "load_before": load,
        **summarise(ticks),
        "transport_ms": quantiles_ms(through),
        "raw_datagrams_ms": quantiles_ms(raw),
        "packets": len(through),
    }
    print(json.dumps(result, indent=2))
    boxes, ages, transport, raw = (result[name] for name in ("boxes_ms", "age_ms", "transport_ms", "raw_datagrams_ms"))
    lines = (
        ("deadlines missed", f"{result['missed_fraction']:.2%} of {result['frames']}", "at most 1 %"),
        ("overload level 0", f"{result['level_0_fraction']:.2%}", "at least 95 %"),
        ("boxes after the sweep, p50 / p95", f"{boxes['p50']:.0f} / {boxes['p95']:.0f} ms", "p95 at most 100 ms"),
        ("age of what is fused, p50 / p95", f"{ages['p50']:.0f} / {ages['p95']:.0f} ms", ""),
        ("transport, p50 / p95", f"{transport['p50']:.2f} / {transport['p95']:.2f} ms", ""),
        ("raw datagrams in turn, p50 / p95", f"{raw['p50']:.2f} / {raw['p95']:.2f} ms", ""),
    )
    title = f"Two agents at 10 Hz, {options.minutes:g} min, {options.transport}, {options.weights or 'a detector of one car'}"
    write_result(result, StudyTable(title, ("quantity", "value", "bar"), lines), options)


if __name__ == "__main__":
    main(tyro.cli(Options))
