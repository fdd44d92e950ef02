# SPDX-License-Identifier: Apache-2.0
"""Run a map server on the network of live agents: their local maps ('live run --map-weights') are fused to one map.

It receives until it is stopped by Ctrl-C or SIGTERM, or for --seconds, and then writes the folder of the map.
"""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from manyeyes._bounds import DurationS, OffsetM, OutputFolder
from manyeyes.cli.live.options import NetworkOptions, SecurityOptions

if TYPE_CHECKING:
    from manyeyes.runtime.map_subscriber import MapSubscriber

POLL_S = 0.02
OBSERVER_ID = 2**31 - 1
"""Its id on a network that asks for one; it sends nothing."""


@dataclass(frozen=True)
class Options:
    """Where the map is, and where it goes."""

    position_m: tuple[OffsetM, OffsetM] = (0.0, 0.0)
    """Origin of the map in the world of the agents, metres; agents within 500 m around it are received."""
    seconds: DurationS | None = None
    """End after this time; by default when it is stopped."""
    await_start: bool = False
    """Print "ready", then read the time of the start (TAI, ns since 1970) and the rate from the input."""
    out: OutputFolder = Path("out/live-map")
    """Folder for the observations, the map, and its page."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
    """The network."""
    security: SecurityOptions = field(default_factory=SecurityOptions)
    """Which messages are accepted."""


def main(options: Options) -> None:
    """Collect local maps, and write the fused one."""
    from rich.console import Console

    from manyeyes.agents.map_server import MapServer
    from manyeyes.cli.live.start import announce_ready
    from manyeyes.runtime.map_subscriber import MapSubscriber

    verifier = options.security.load(0).make_verifier()
    _compile_fusion()
    clock = announce_ready(options.await_start)
    network = options.network.open(OBSERVER_ID, clock.now_ns)
    try:
        network.join(options.position_m)
        subscriber = MapSubscriber(MapServer(origin_xy=options.position_m), network, clock, verifier)
        _receive(subscriber, options.seconds)
    finally:
        network.close()
    Console().print(_write(subscriber, options.out), highlight=False, markup=False, soft_wrap=True)


def _compile_fusion() -> None:
    """Fuse two local maps of each kind of element: compiled later, it would take longer than packets wait."""
    import torch

    from manyeyes.agents.map_perception import rectangle
    from manyeyes.agents.map_server import MapServer
    from manyeyes.comms.inbox import ReceivedMessage
    from manyeyes.datatypes import Message, Transform
    from manyeyes.datatypes.map_element import KINDS, MapElements
    from manyeyes.datatypes.message import LocalMap

    server, view = MapServer(), rectangle((0.0, -15.0, 30.0, 15.0))
    for agent_id in (1, 2):
        y = 0.1 * agent_id
        ring = [[5.0, y], [8.0, y], [8.0, y + 6.0], [5.0, y + 6.0]]
        shapes = [ring if kind == "crossing" else [[0.0, y], [15.0, y], [30.0, 0.0]] for kind in KINDS]
        lines = MapElements.of(shapes, list(range(len(KINDS))), 0.9)
        header = Message(agent_id, 0, Transform.identity(), torch.zeros(3, 3).double(), local_map=LocalMap(lines, view))
        server.ingest_message(ReceivedMessage(header, 1, 1, None))
    server.rebuild()


def _receive(subscriber: MapSubscriber, seconds: float | None) -> None:
    """Receive until a signal, or for a time."""
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    polls = None if seconds is None else round(seconds / POLL_S)
    while not stopped.wait(POLL_S) and polls != 0:
        subscriber.poll()
        polls = None if polls is None else polls - 1
    # What arrived while it fused.
    subscriber.poll()


def _write(subscriber: MapSubscriber, out: Path) -> str:
    """Write the folder of the map, and describe it in one line."""
    from manyeyes.studies.map_folder import MapFolder, write_vector_map
    from manyeyes.viz.map_page import make_page, save_map_page

    server = subscriber.server
    observations = server.observations
    fused = server.rebuild() if observations else server.map()
    MapFolder(out).write_observations(observations, server.frame)
    write_vector_map(fused, out / "map")
    save_map_page(make_page("A map of live agents", fused, observations=observations), out / "map.html")
    agents, dropped = len({one.agent for one in observations}), subscriber.dropped
    # Packets of tokens are of no use to a map.
    counts = {name: count for name, count in vars(dropped).items() if count and name != "wrong_model"}
    refused = "".join(f", {count} packets refused as {name}" for name, count in counts.items())
    return (
        f"{len(observations)} local maps of {agents} agents, {server.num_incomplete} incomplete, {len(server.rejected)} rejected"
        f"{refused}: {len(fused.select_published())} published elements of {len(fused)}; open {out / 'map.html'}"
    )
