# SPDX-License-Identifier: Apache-2.0
"""What agents say of the map: within what looks cover, sound, and by way of bytes; and a team of them with its service."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.map_features import receive, share_look
from manyeyes.agents.map_perception import SURVEYS, SurveyConfig, Surveyor, rectangle, said, survey_config
from manyeyes.agents.map_replay import MapTeam
from manyeyes.agents.map_server import Cartographer
from manyeyes.agents.strategies import Alone
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Transform
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.datatypes.message import SeenMap
from manyeyes.ops.clip import clip_ring, ring_area

PLACE = Transform.from_xyz_yaw(1000.0, -200.0, 0.0, 0.4)
TILE = (-16.0, -8.0, 16.0, 8.0)
ALL = SurveyConfig(TILE, TILE, together=True, least_score=0.0, least_m=0.1, least_m2=0.1)


def frame(agent, x=0.0, yaw=0.0, points=200, time_ns=0):
    cloud = torch.randn(points, 3, generator=torch.Generator().manual_seed(agent)) * torch.tensor([3.0, 3.0, 0.3])
    return AgentFrame.of(PointCloud.of(cloud), PLACE @ Transform.from_xyz_yaw(x, 0, 1.5, yaw), agent, time_ns)


def test_a_local_map_is_cut_to_what_lies_ahead(mapper):
    local = Surveyor(
        mapper, replace(ALL, vehicle=(0.0, -4.0, 6.0, 4.0), roadside=(0.0, -4.0, 12.0, 4.0), together=False)
    )
    seen = local(frame(1))
    assert seen is not None and len(seen.elements)
    assert ring_area(seen.view) == pytest.approx(48.0)
    assert (seen.elements.points >= [-1e-9, -4 - 1e-9]).all() and (seen.elements.points <= [6 + 1e-9, 4 + 1e-9]).all()
    pole = local(replace(frame(1), is_infrastructure=True))
    assert pole is not None and np.ptp(pole.view[:, 0]) == pytest.approx(8.0), "not farther than its look covers"


def test_looks_of_others_widen_the_view_and_change_what_is_drawn(mapper):
    both, own = frame(1), Surveyor(mapper, ALL)(frame(1))
    heard = receive(share_look(mapper, frame(2, x=8.0, yaw=math.pi)), mapper)
    assert own is not None and heard is not None
    seen = Surveyor(mapper, ALL)(both, [heard])
    assert seen is not None
    assert ring_area(own.view) == pytest.approx(16 * 16) and ring_area(seen.view) == pytest.approx(24 * 16)
    assert not np.allclose(seen.elements.score, own.elements.score[: len(seen.elements)], atol=1e-6)
    alone = Surveyor(mapper, replace(ALL, together=False))(both, [heard])
    assert alone is not None and np.array_equal(alone.elements.points, own.elements.points)
    stranger = replace(heard, fingerprint=b"another!")
    other = Surveyor(mapper, ALL)(both, [stranger])
    assert other is not None and np.array_equal(other.elements.points, own.elements.points)
    # Looks that name these weights and are not of their form ended in an error, or in no map at all.
    tokens = heard.tokens
    assert tokens is not None
    for features in (tokens.features[:, :1], torch.full_like(tokens.features, 3e38), tokens.features * torch.nan):
        wrong = replace(heard, tokens=tokens.with_features(features))
        other = Surveyor(mapper, ALL)(both, [wrong])
        assert other is not None and np.array_equal(other.elements.points, own.elements.points)


def test_who_sees_nothing_says_nothing(mapper):
    assert Surveyor(mapper, ALL)(frame(1, points=0)) is None


def test_the_least_score_keeps_guesses_to_oneself(mapper):
    seen = Surveyor(mapper, replace(ALL, least_score=1.0))(frame(1))
    assert seen is not None and len(seen.elements) == 0


def test_what_is_said_is_cut_sound_and_short():
    view = rectangle((0.0, -5.0, 10.0, 5.0))
    straight = np.stack((np.linspace(-5, 15, 20), np.full(20, 1.0)), 1)
    ring = np.array([[8.0, -2.0], [12.0, -2.0], [12.0, 2.0], [8.0, 2.0]])
    bow = np.array([[1.0, 0.0], [5.0, 4.0], [5.0, 0.0], [1.0, 4.5]])
    lines = [straight, [[9.0, 0.0], [30.0, 0.0]], ring, bow, ring + (1.5, 0)]
    elements = MapElements.of(lines, [DIVIDER, DIVIDER, CROSSING, CROSSING, CROSSING], [0.9, 0.8, 0.7, 0.6, 0.5], 0.2)
    got = said(elements, view, SurveyConfig())
    assert got.score.tolist() == [0.9, 0.7], (
        "1 m of a line, a ring that crosses itself and 2 m² of a crossing are left out"
    )
    assert got.polyline(0).tolist() == [[0.0, 1.0], [10.0, 1.0]], "20 points of a straight line are two"
    assert ring_area(got.polyline(1)) == pytest.approx(8.0) and got.sigma == pytest.approx(np.full(6, 0.2))
    assert len(said(MapElements.empty(), view, SurveyConfig())) == 0


def test_windows_are_those_of_the_paper():
    areas = [
        ring_area(clip_ring(rectangle(w), rectangle((-99, -99, 99, 99))))
        for w in (SURVEYS["local"].vehicle, SURVEYS["local"].roadside)
    ]
    assert areas == [900.0, 1500.0]
    assert (
        survey_config("semi-global").together and ring_area(rectangle(survey_config("semi-global").vehicle)) == 7200.0
    )
    with pytest.raises(ConfigError, match="semi-global"):
        survey_config("global")


def straight_on(own: AgentFrame, heard=()) -> SeenMap:
    """A survey that always sees one line ahead."""
    return SeenMap(MapElements.of([[[0.0, 1.0], [30.0, 1.0]]], DIVIDER), rectangle((0.0, -15.0, 30.0, 15.0)))


def test_a_team_counts_what_it_sends_and_its_service_takes_it():
    service = Cartographer(origin_xy=(1000.0, -200.0))
    team = MapTeam(straight_on, service, "drive")
    said = [one for t in range(3) for one in team.step([frame(k, 5.0 * k, time_ns=t * 10**8) for k in (1, 2)])]
    assert [one.agent_id for one in said] == [1, 2] * 3 and len(service.observations) == 6
    assert all(one.elements == one.map_packets == 1 and 80 < one.map_bytes < 130 and not one.look_bytes for one in said)
    assert {o.agent for o in service.observations} == {"drive/1", "drive/2"}


def test_agents_draw_together_from_tokens_that_were_sent(mapper):
    heard_of = {}

    def survey(own, heard=()):
        heard_of[own.agent_id] = sorted(m.agent_id for m in heard)
        return Surveyor(mapper, ALL)(own, heard)

    service = Cartographer(origin_xy=(1000.0, -200.0))
    team = MapTeam(survey, service, tell=partial(share_look, mapper), fingerprint=mapper.fingerprint)
    said = team.step([frame(1), frame(2, 3.0), frame(3, points=0)])
    assert heard_of == {1: [2], 2: [1], 3: [1, 2]}, "nobody hears itself, who saw nothing hears the others"
    assert [one.look_bytes > 500 for one in said] == [True, True, False] and said[2].elements > 0
    assert len(service.observations) == 3 and service.observations[0].model == mapper.fingerprint.hex()


def test_what_comes_late_is_taken_with_the_next_instant_or_at_the_end():
    service = Cartographer(origin_xy=(1000.0, -200.0))
    team = MapTeam(straight_on, service, channel="cellular", wait_s=0.0)
    first, second = [frame(1)], [frame(1, 5.0, time_ns=5 * 10**8)]
    team.step(first)
    assert len(service.observations) == 0
    team.step(second)
    assert len(service.observations) == 1
    team.finish(second)
    assert len(service.observations) == 2


def test_an_agents_message_carries_its_map_beside_what_it_says_anyway(drive, detector):
    ego, other = drive().frame(0, 0), drive().frame(1, 0)
    plain = Agent(detector, precision="float32", budget_bytes=None).share(other)
    both = Agent(detector, precision="float32", budget_bytes=None, survey=straight_on).share(other)
    inbox, bare = Inbox(), Inbox()
    for packets, into in ((both, inbox), (plain, bare)):
        for packet in packets:
            into.push(packet)
    (heard,), (without,) = inbox.messages(), bare.messages()
    assert heard.seen_map is not None and len(heard.seen_map.elements) == 1
    assert heard.tokens is not None and without.tokens is not None
    assert torch.equal(heard.tokens.features, without.tokens.features)
    listener = Agent(detector)
    assert torch.equal(listener.perceive(ego, both).boxes.center, Agent(detector).perceive(ego, plain).boxes.center)
    service = Cartographer()
    assert len(service.listen(inbox.receptions())) == 1


def test_who_says_nothing_else_may_still_say_its_map(drive, detector):
    assert Agent(detector, Alone()).share(drive().frame(1, 0)) == []
    (packet,) = Agent(detector, Alone(), survey=straight_on).share(drive().frame(1, 0))
    assert len(packet) < 130
    silent = Agent(detector, Alone(), survey=lambda frame, heard: None)
    assert silent.share(drive().frame(1, 0)) == []


def test_a_map_takes_its_bytes_from_the_tokens_of_a_budget(drive, detector):
    for budget in (900, 2000):
        packets = Agent(detector, budget_bytes=budget, survey=straight_on).share(drive().frame(1, 0))
        message = heard_message(packets)
        assert sum(map(len, packets)) <= budget and message.seen_map is not None and message.tokens is not None


def heard_message(packets):
    inbox = Inbox()
    for packet in packets:
        inbox.push(packet)
    return inbox.messages()[0]
