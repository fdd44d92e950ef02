# SPDX-License-Identifier: Apache-2.0
"""Local maps of live agents reach a map server on the same network, and become one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cryptography", reason="the extra live is not installed")

from tests.runtime.conftest import Federation
from tests.runtime.fault_team import PLACE, START_NS, AgentClock, FaultTeam, OneCar, frame_of

from manyeyes import Agent, AgentFrame, load_detector
from manyeyes.agents.map_perception import rectangle
from manyeyes.agents.map_server import MapServer
from manyeyes.agents.periodic_map import PeriodicMapPredictor
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.runtime.authentication import PacketVerifier
from manyeyes.runtime.clock import TAI_UTC_NS
from manyeyes.runtime.map_subscriber import MapSubscriber
from manyeyes.runtime.transports.local import LocalNetwork

DIVIDER = [KINDS.index("divider")]


def predict_line(frame: AgentFrame, received=()) -> LocalMap:
    """A lane divider along x at y = 110 m in the world: agents have no rotation."""
    y = 110.0 - float(frame.world_from_agent.translation[1])
    return LocalMap(MapElements.of([[[0.0, y], [30.0, y]]], DIVIDER, 0.9), rectangle((0.0, -15.0, 30.0, 15.0)))


def make_agent() -> Agent:
    return Agent(OneCar(), get_strategy("late"), map_predictor=PeriodicMapPredictor(predict_line))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["off", "require"])
def test_a_live_run_leaves_a_fused_map(federation: Federation, tmp_path, mode: str) -> None:
    team = FaultTeam(federation, tmp_path, num=3, mode=mode, make_agent=make_agent)
    clock = AgentClock(team)
    network = LocalNetwork(team.bus, 99, clock.true_ns)
    network.join(PLACE)
    network.poll()
    verifier = None if mode == "off" else PacketVerifier(federation.trust, utc_offset_ns=-TAI_UTC_NS)
    subscriber = MapSubscriber(MapServer(origin_xy=PLACE), network, clock, verifier)
    num = 0
    for _ in range(21):
        team.step()
        num += subscriber.poll()
    assert num == len(subscriber.server.observations) == 9 and subscriber.dropped.total == 0
    lines = subscriber.server.rebuild().select_published().elements
    assert len(lines) == 1 and np.allclose(lines.polyline(0)[:, 1], 10.0, atol=0.1)
    # Boxes of a message and its map come in the same packets.
    ticks = team.step()
    assert all(len(tick.perception.received) == 2 for tick in ticks.values())


@pytest.mark.slow
def test_maps_beside_coded_tokens_are_used_without_the_weights_of_the_tokens(drive, federation, tmp_path) -> None:
    frame = replace(drive(1).frame(0, 0), agent_id=1, timestamp_ns=START_NS)
    line = LocalMap(MapElements.of([[[0.0, 0.0], [30.0, 0.0]]], DIVIDER, 0.9), rectangle((0.0, -15.0, 30.0, 15.0)))
    agent = Agent(load_detector(), get_strategy("intermediate"), map_predictor=lambda frame, received=(): line)
    team = FaultTeam(federation, tmp_path, num=2)
    clock = AgentClock(team)
    sender, network = (LocalNetwork(team.bus, k, clock.true_ns) for k in (1, 99))
    subscriber = MapSubscriber(MapServer(), network, clock)
    packets = agent.share(frame)
    sender.send(packets, (0.0, 0.0))
    assert len(packets) > 1 and subscriber.poll() == 1
    assert subscriber.dropped.wrong_model > 0 and len(subscriber.server.observations[0].elements) == 1
    # A message that lacks another packet is not complete.
    later = agent.share(replace(frame, timestamp_ns=START_NS + 10**8))
    team.ns += 10**8
    sender.send(later[:-1], (0.0, 0.0))
    assert subscriber.poll() == 0


def test_a_map_is_sent_once_a_period() -> None:
    predictor = PeriodicMapPredictor(predict_line, 300_000_000)
    sent = [predictor(frame_of(1, k * 100_000_000)) is not None for k in range(9)]
    assert sent == [True, False, False] * 3
    with pytest.raises(ConfigError, match="above 0"):
        PeriodicMapPredictor(predict_line, 0)
