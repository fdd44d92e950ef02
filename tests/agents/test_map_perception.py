# SPDX-License-Identifier: Apache-2.0
"""Local maps of agents: clipped to the view, valid, exchanged as packets; and a replay with a map server."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from manyeyes.agents import map_perception
from manyeyes.agents.agent import Agent
from manyeyes.agents.map_features import decode_map_features, encode_map_features, predict_tile
from manyeyes.agents.map_perception import (
    MAP_MODES,
    MapModelPredictor,
    MapShareConfig,
    clip_to_view,
    get_map_share_config,
    rectangle,
)
from manyeyes.agents.map_replay import MapReplay
from manyeyes.agents.map_server import MapServer
from manyeyes.agents.strategies.no_fusion import NoFusion
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Transform
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.ops.clip import clip_ring, ring_area

PLACE = Transform.from_xyz_yaw(1000.0, -200.0, 0.0, 0.4)
TILE = (-16.0, -8.0, 16.0, 8.0)
ALL = MapShareConfig(TILE, TILE, use_neighbours=True, min_score=0.0, min_length_m=0.1, min_area_m2=0.1)


def frame(agent, x=0.0, yaw=0.0, points=200, time_ns=0):
    cloud = torch.randn(points, 3, generator=torch.Generator().manual_seed(agent)) * torch.tensor([3.0, 3.0, 0.3])
    return AgentFrame.of(PointCloud.of(cloud), PLACE @ Transform.from_xyz_yaw(x, 0, 1.5, yaw), agent, time_ns)


def test_a_local_map_is_clipped_to_the_window_ahead(mapper):
    local = MapModelPredictor(
        mapper,
        replace(
            ALL, vehicle_window=(0.0, -4.0, 6.0, 4.0), roadside_window=(0.0, -4.0, 12.0, 4.0), use_neighbours=False
        ),
    )
    local_map = local(frame(1))
    assert local_map is not None and len(local_map.elements)
    assert ring_area(local_map.view) == pytest.approx(48.0)
    assert (local_map.elements.points >= [-1e-9, -4 - 1e-9]).all() and (
        local_map.elements.points <= [6 + 1e-9, 4 + 1e-9]
    ).all()
    pole = local(replace(frame(1), is_infrastructure=True))
    assert pole is not None and np.ptp(pole.view[:, 0]) == pytest.approx(8.0), "not farther than its look covers"


def test_received_features_widen_the_view_and_change_the_prediction(mapper):
    both, own = frame(1), MapModelPredictor(mapper, ALL)(frame(1))
    received = decode_map_features(encode_map_features(mapper, frame(2, x=8.0, yaw=math.pi)), mapper)
    assert own is not None and received is not None
    local_map = MapModelPredictor(mapper, ALL)(both, [received])
    assert local_map is not None
    assert ring_area(own.view) == pytest.approx(16 * 16) and ring_area(local_map.view) == pytest.approx(24 * 16)
    assert not np.allclose(local_map.elements.score, own.elements.score[: len(local_map.elements)], atol=1e-6)
    alone = MapModelPredictor(mapper, replace(ALL, use_neighbours=False))(both, [received])
    assert alone is not None and np.array_equal(alone.elements.points, own.elements.points)
    stranger = replace(received, fingerprint=b"another!")
    other = MapModelPredictor(mapper, ALL)(both, [stranger])
    assert other is not None and np.array_equal(other.elements.points, own.elements.points)
    # Looks that name these weights and are not of their form ended in an error, or in no map at all.
    tokens = received.tokens
    assert tokens is not None
    for features in (tokens.features[:, :1], torch.full_like(tokens.features, 3e38), tokens.features * torch.nan):
        wrong = replace(received, tokens=tokens.with_features(features))
        other = MapModelPredictor(mapper, ALL)(both, [wrong])
        assert other is not None and np.array_equal(other.elements.points, own.elements.points)


def hostile_features(received, what):
    pose, tokens = received.world_from_agent, received.tokens
    zero = torch.zeros((), dtype=torch.float64)
    if what == "upside down":
        turned = Transform.from_rpy(torch.zeros(3).double(), zero + math.pi, zero, zero)
        return replace(received, agent_id=66, world_from_agent=pose @ turned)
    if what == "1e6 m above":
        return replace(received, agent_id=66, world_from_agent=Transform(pose.rotation, pose.translation + 1e6))
    value = {"3e38": 3e38, "not a number": math.nan}[what]
    return replace(received, agent_id=66, tokens=tokens.with_features(torch.full_like(tokens.features, value)))


@pytest.mark.parametrize(
    "what, reason", [("3e38", "value"), ("not a number", "value"), ("upside down", "pose"), ("1e6 m above", "pose")]
)
def test_a_hostile_map_sender_leaves_the_honest_elements_and_is_named(mapper, what, reason):
    received = decode_map_features(encode_map_features(mapper, frame(2, x=8.0, yaw=math.pi)), mapper)
    predictor = MapModelPredictor(mapper, ALL)
    clean = predictor.predict(frame(1), [received])
    struck = predictor.predict(frame(1), [hostile_features(received, what), received])
    assert clean.local_map is not None and struck.local_map is not None and len(clean.local_map.elements)
    assert np.array_equal(clean.local_map.elements.points, struck.local_map.elements.points)
    assert np.array_equal(clean.local_map.view, struck.local_map.view)
    assert not clean.rejected and [(r.agent_id, r.reason) for r in struck.rejected] == [(66, reason)]


def test_a_map_sender_that_makes_the_prediction_fail_is_named(mapper, monkeypatch):
    received = decode_map_features(encode_map_features(mapper, frame(2, x=8.0, yaw=math.pi)), mapper)

    def fail(model, messages, world_from_tile):
        if any(message.agent_id == 66 for message in messages):
            raise RuntimeError("an unexpected shape")
        return predict_tile(model, messages, world_from_tile)

    monkeypatch.setattr(map_perception, "predict_tile", fail)
    predictor = MapModelPredictor(mapper, ALL)
    clean = predictor.predict(frame(1), [received])
    struck = predictor.predict(frame(1), [received, replace(received, agent_id=66)])
    assert clean.local_map is not None and struck.local_map is not None
    assert np.array_equal(clean.local_map.elements.points, struck.local_map.elements.points)
    assert [(r.agent_id, r.reason) for r in struck.rejected] == [(66, "content_error")]


def test_an_empty_cloud_gives_no_map(mapper):
    assert MapModelPredictor(mapper, ALL)(frame(1, points=0)) is None


def test_elements_below_the_minimum_score_are_dropped(mapper):
    local_map = MapModelPredictor(mapper, replace(ALL, min_score=1.0))(frame(1))
    assert local_map is not None and len(local_map.elements) == 0


def test_shared_elements_are_clipped_valid_and_simplified():
    view = rectangle((0.0, -5.0, 10.0, 5.0))
    straight = np.stack((np.linspace(-5, 15, 20), np.full(20, 1.0)), 1)
    ring = np.array([[8.0, -2.0], [12.0, -2.0], [12.0, 2.0], [8.0, 2.0]])
    bow = np.array([[1.0, 0.0], [5.0, 4.0], [5.0, 0.0], [1.0, 4.5]])
    lines = [straight, [[9.0, 0.0], [30.0, 0.0]], ring, bow, ring + (1.5, 0)]
    elements = MapElements.of(lines, [DIVIDER, DIVIDER, CROSSING, CROSSING, CROSSING], [0.9, 0.8, 0.7, 0.6, 0.5], 0.2)
    got = clip_to_view(elements, view, MapShareConfig())
    assert got.score.tolist() == [0.9, 0.7], (
        "1 m of a line, a ring that crosses itself and 2 m² of a crossing are left out"
    )
    assert got.polyline(0).tolist() == [[0.0, 1.0], [10.0, 1.0]], "20 points of a straight line are two"
    assert ring_area(got.polyline(1)) == pytest.approx(8.0) and got.sigma == pytest.approx(np.full(6, 0.2))
    assert len(clip_to_view(MapElements.empty(), view, MapShareConfig())) == 0


def test_windows_are_those_of_the_paper():
    areas = [
        ring_area(clip_ring(rectangle(w), rectangle((-99, -99, 99, 99))))
        for w in (MAP_MODES["local"].vehicle_window, MAP_MODES["local"].roadside_window)
    ]
    assert areas == [900.0, 1500.0]
    assert (
        get_map_share_config("semi-global").use_neighbours
        and ring_area(rectangle(get_map_share_config("semi-global").vehicle_window)) == 7200.0
    )
    with pytest.raises(ConfigError, match="semi-global"):
        get_map_share_config("global")


def predict_one_line(own: AgentFrame, received=()) -> LocalMap:
    """A map predictor that always predicts one line ahead."""
    return LocalMap(MapElements.of([[[0.0, 1.0], [30.0, 1.0]]], DIVIDER), rectangle((0.0, -15.0, 30.0, 15.0)))


@pytest.mark.slow
def test_a_map_replay_counts_sent_bytes_and_the_server_ingests_them():
    service = MapServer(origin_xy=(1000.0, -200.0))
    team = MapReplay(predict_one_line, service, "drive")
    records = [one for t in range(3) for one in team.step([frame(k, 5.0 * k, time_ns=t * 10**8) for k in (1, 2)])]
    assert [one.agent_id for one in records] == [1, 2] * 3 and len(service.observations) == 6
    assert all(
        one.num_elements == one.map_packets == 1 and 80 < one.map_bytes < 130 and not one.feature_bytes
        for one in records
    )
    assert {o.agent for o in service.observations} == {"drive/1", "drive/2"}


@pytest.mark.slow
def test_agents_predict_jointly_from_sent_tokens(mapper):
    senders_of = {}

    def map_predictor(own, received=()):
        senders_of[own.agent_id] = sorted(m.agent_id for m in received)
        return MapModelPredictor(mapper, ALL)(own, received)

    service = MapServer(origin_xy=(1000.0, -200.0))
    team = MapReplay(
        map_predictor, service, encode_features=partial(encode_map_features, mapper), fingerprint=mapper.fingerprint
    )
    records = team.step([frame(1), frame(2, 3.0), frame(3, points=0)])
    assert senders_of == {1: [2], 2: [1], 3: [1, 2]}, (
        "no agent receives itself; an agent without features receives the others"
    )
    assert [one.feature_bytes > 500 for one in records] == [True, True, False] and records[2].num_elements > 0
    assert len(service.observations) == 3 and service.observations[0].model == mapper.fingerprint.hex()


def test_delayed_messages_are_ingested_at_the_next_instant_or_at_the_end():
    service = MapServer(origin_xy=(1000.0, -200.0))
    team = MapReplay(predict_one_line, service, channel="cellular", latency_budget_s=0.0)
    first, second = [frame(1)], [frame(1, 5.0, time_ns=5 * 10**8)]
    team.step(first)
    assert len(service.observations) == 0
    team.step(second)
    assert len(service.observations) == 1
    team.finish(second)
    assert len(service.observations) == 2


def test_a_message_carries_the_map_beside_its_tokens(drive, detector):
    ego, other = drive().frame(0, 0), drive().frame(1, 0)
    plain = Agent(detector, token_encoding="float32", budget_bytes=None).share(other)
    both = Agent(detector, token_encoding="float32", budget_bytes=None, map_predictor=predict_one_line).share(other)
    inbox, bare = Inbox(), Inbox()
    for packets, into in ((both, inbox), (plain, bare)):
        for packet in packets:
            into.push(packet)
    (received,), (without,) = inbox.messages(), bare.messages()
    assert received.local_map is not None and len(received.local_map.elements) == 1
    assert received.tokens is not None and without.tokens is not None
    assert torch.equal(received.tokens.features, without.tokens.features)
    receiver = Agent(detector)
    assert torch.equal(receiver.perceive(ego, both).boxes.center, Agent(detector).perceive(ego, plain).boxes.center)
    service = MapServer()
    assert len(service.ingest(inbox.received_messages())) == 1


def test_an_agent_without_fusion_may_still_send_its_map(drive, detector):
    assert Agent(detector, NoFusion()).share(drive().frame(1, 0)) == []
    (packet,) = Agent(detector, NoFusion(), map_predictor=predict_one_line).share(drive().frame(1, 0))
    assert len(packet) < 130
    silent = Agent(detector, NoFusion(), map_predictor=lambda frame, received: None)
    assert silent.share(drive().frame(1, 0)) == []


def test_a_map_takes_its_bytes_from_the_tokens_of_a_budget(drive, detector):
    for budget in (900, 2000):
        packets = Agent(detector, budget_bytes=budget, map_predictor=predict_one_line).share(drive().frame(1, 0))
        message = decode_message(packets)
        assert sum(map(len, packets)) <= budget and message.local_map is not None and message.tokens is not None


def decode_message(packets):
    inbox = Inbox()
    for packet in packets:
        inbox.push(packet)
    return inbox.messages()[0]
