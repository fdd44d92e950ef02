# SPDX-License-Identifier: Apache-2.0
"""The map server: accepted and rejected messages, and the resulting map."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents import map_server
from manyeyes.agents.map_perception import encode_map_message
from manyeyes.agents.map_server import FIRST_REBUILD_COUNT, MIN_SIGMA_M, MapServer, make_observation
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, PointCloud, Transform
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements, Polygons
from manyeyes.datatypes.message import LocalMap
from manyeyes.maps.elements.observation import MapFrame, ObservationError
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.incremental import IncrementalMap, compute_map_fscore

WINDOW = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
CROSSING_RING = np.array([[20.0, -5.0], [24.0, -5.0], [24.0, 5.0], [20.0, 5.0]])
WORLD = Transform.from_xyz_yaw(5000.0, -3000.0, 12.0, 0.7)
ORIGIN = (5000.0, -3000.0)


def frame(agent: int, x: float, time_ns: int = 0, error: float = 0.0) -> AgentFrame:
    """An agent on a road along the world's x, with a lateral error of its prior pose."""
    pose = WORLD @ Transform.from_xyz_yaw(x, error, 0.0, 0.0)
    made = AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), pose, agent, time_ns)
    return replace(made, pose_covariance=torch.diag(torch.tensor([0.16, 0.16, 1e-4], dtype=torch.float64)))


def street(x: float, **more) -> LocalMap:
    """Four lines of a road of 120 m and its crossing, observed from x."""
    along = np.arange(max(0.0, x - 30.0), min(120.0, x + 30.0) + 0.1, 2.0) - x
    lines = [np.stack((along, np.full(len(along), y)), 1) for y in (-5.25, -1.75, 1.75, 5.25)]
    kinds = [BOUNDARY, DIVIDER, DIVIDER, BOUNDARY]
    if abs(x - 22.0) < 27.0:
        lines, kinds = [*lines, CROSSING_RING - (x, 0.0)], [*kinds, CROSSING]
    return LocalMap(MapElements.of(lines, kinds, 0.9), WINDOW, **more)


def received_of(packets: list[bytes]):
    inbox = Inbox()
    for packet in packets:
        inbox.push(packet)
    return inbox.received_messages()


def service(**more) -> MapServer:
    return MapServer(MapFrame(49.0, 8.4), ORIGIN, **more)


def test_a_message_becomes_an_observation_in_the_maps_frame():
    made = service()
    shadow = np.array([[5.0, 2.0], [9.0, 3.0], [9.0, 4.0]])
    packets = encode_map_message(frame(7, 30.0, 123), street(30.0, occluders=Polygons.of([shadow])), b"weights!")
    (done,) = made.ingest(received_of(packets), "monday")
    (seen,) = made.observations
    assert (seen.agent, seen.time_ns, seen.model, seen.trusted) == ("monday/7", 123, b"weights!".hex(), False)
    expected = WORLD @ Transform.from_xyz_yaw(30.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(seen.pose[:2], expected.translation[:2].numpy() - ORIGIN, atol=1e-5)
    assert seen.pose[2] == pytest.approx(0.7)
    assert np.sqrt(seen.covariance[0, 0]) == pytest.approx(np.hypot(0.4, MIN_SIGMA_M), rel=0.05)
    np.testing.assert_allclose(seen.view, WINDOW, atol=0.011)
    np.testing.assert_allclose(seen.occluders.ring(0), shadow, atol=0.011)
    assert len(seen.elements) == 5 and done.num_created > 50


def test_poses_without_covariance_get_the_minimum_covariance():
    sure = replace(frame(1, 30.0), pose_covariance=torch.zeros(3, 3))
    made = service()
    assert made.ingest(received_of(encode_map_message(sure, street(30.0))))
    assert made.observations[0].covariance[0, 0] == pytest.approx(MIN_SIGMA_M**2)


@pytest.mark.slow
def test_a_street_from_several_agents_is_one_street_and_the_stream_is_near_the_fold():
    made, rng = service(), np.random.default_rng(4)
    for k in range(12):
        x = 30.0 + 5.0 * (k % 8)
        made.ingest(received_of(encode_map_message(frame(k, x, k * 10**9, rng.normal(0.0, 0.3)), street(x))))
    fold = made.rebuild().select_published()
    assert sorted(fold.elements.kind) == [DIVIDER, DIVIDER, BOUNDARY, BOUNDARY, CROSSING]
    assert fold.frame == MapFrame(49.0, 8.4) and compute_map_fscore(made.map(), made.rebuild()) > 0.95
    assert made.rebuild().quantised_hash() == fuse(made.observations, frame=made.frame).quantised_hash()
    np.testing.assert_allclose(fold.elements.lengths().max(), 95.0, atol=3.0)


def test_the_map_is_fused_again_whenever_its_observations_double(monkeypatch):
    made, folds = service(), []
    fold = made.rebuild
    monkeypatch.setattr(made, "rebuild", lambda: folds.append(len(made.observations)) or fold())
    rng = np.random.default_rng(5)
    for k in range(20):
        made.ingest(
            received_of(encode_map_message(frame(k, 30.0 + k, k * 10**9, rng.normal(0.0, 0.4)), street(30.0 + k)))
        )
    assert folds == [FIRST_REBUILD_COUNT, 2 * FIRST_REBUILD_COUNT]
    assert len(made.map().select_published()) == len(fold().select_published()) == 5, "no line stands twice"


def test_a_message_counts_once_however_often_the_inbox_is_asked():
    made, inbox = service(), Inbox()
    for packet in encode_map_message(frame(1, 30.0), street(30.0)):
        inbox.push(packet)
    assert len(made.ingest(inbox.received_messages())) == 1
    assert made.ingest(inbox.received_messages()) == [] and len(made.observations) == 1


def test_an_incomplete_message_is_not_ingested():
    many = LocalMap(MapElements.cat([street(30.0).elements.transform(0.0, 0.01 * k, 0.0) for k in range(20)]), WINDOW)
    packets, made, inbox = encode_map_message(frame(1, 30.0), many), service(), Inbox()
    assert len(packets) > 1
    inbox.push(packets[0])
    assert made.ingest(inbox.received_messages()) == [] and made.num_incomplete == 1 and not made.observations
    for packet in packets[1:]:
        inbox.push(packet)
    assert len(made.ingest(inbox.received_messages())) == 1 and made.num_incomplete == 0


def test_ids_are_per_drive_and_a_long_gap_starts_another_pass():
    made = service()
    for drive, time_ns in (("a", 0), ("b", 0), ("a", 10**9), ("a", 10**12)):
        made.ingest(received_of(encode_map_message(frame(1, 30.0, time_ns), street(30.0))), drive)
    assert [o.pass_id for o in made.observations] == ["a/1-p0", "b/1-p0", "a/1-p0", "a/1-p1"]


def test_only_configured_roadside_units_are_trusted():
    made = service(trusted=["3"])
    for agent in (3, 4):
        pole = replace(frame(agent, 30.0), is_infrastructure=True)
        made.ingest(received_of(encode_map_message(pole, street(30.0))))
    assert [o.trusted for o in made.observations] == [True, False]


def test_a_view_that_crosses_itself_is_refused_and_a_ring_that_does_is_left_out():
    bow = np.array([[0.0, 0.0], [4.0, 4.0], [4.0, 0.0], [0.0, 4.0]])
    made = service()
    made.ingest(received_of(encode_map_message(frame(1, 30.0), LocalMap(street(30.0).elements, bow * 5))))
    (refused,) = made.rejected
    assert refused.agent == "1" and "view" in refused.reason and not made.observations
    lines = MapElements.cat([MapElements.of([bow], CROSSING), street(60.0).elements])
    made.ingest(received_of(encode_map_message(frame(2, 60.0), LocalMap(lines, WINDOW))))
    assert len(made.observations[0].elements) == 4


def zigzag(count: int) -> np.ndarray:
    """A ring of many points that does not cross itself: there along y = 0 in steps, back along a line above it."""
    along = np.arange(count // 2) * 0.02
    return np.concatenate(
        (np.stack((along, 0.02 * (np.arange(count // 2) % 2)), 1), np.stack((along, along * 0 + 2.0), 1)[::-1])
    )


FAR = Transform.from_xyz_yaw(9.9e7, -9.9e7, 12.0, 0.7)
WIDE = np.array([[-300.0, -300.0], [300.0, -300.0], [300.0, 300.0], [-300.0, 300.0]])


@pytest.mark.parametrize(
    ("hostile", "field"),
    [
        (lambda f: encode_map_message(replace(f, world_from_agent=FAR), street(30.0)), "pose"),
        (lambda f: encode_map_message(replace(f, pose_covariance=f.pose_covariance * 1e8), street(30.0)), "covariance"),
        (lambda f: encode_map_message(f, LocalMap(MapElements.of([WIDE], CROSSING), WINDOW)), "points"),
        (
            lambda f: encode_map_message(f, LocalMap(MapElements.of([zigzag(6000)], CROSSING), WINDOW), mtu=60_000),
            "points",
        ),
        (lambda f: encode_map_message(f, LocalMap(street(30.0).elements, zigzag(6000)), mtu=60_000), "view"),
    ],
    ids=["pose", "covariance", "wide-crossing", "points-of-a-crossing", "points-of-the-view"],
)
def test_a_hostile_map_is_refused_with_its_reason_and_the_others_are_fused(hostile, field):
    made, rest = service(), service()
    for k in range(10):
        packets = encode_map_message(frame(k, 30.0 + 2 * k, k), street(30.0 + 2 * k))
        made.ingest(received_of(packets))
        rest.ingest(received_of(packets))
        if k == 4:
            assert made.ingest(received_of(hostile(frame(66, 30.0, k)))) == []
    (refused,) = made.rejected
    assert refused.agent == "66" and refused.reason.startswith(f"Observation.{field}: expected ")
    assert len(made.observations) == 10
    assert made.rebuild().quantised_hash() == rest.rebuild().quantised_hash()
    assert made.map().quantised_hash() == rest.map().quantised_hash()


def test_an_observation_that_makes_the_update_fail_is_its_senders_rejection(monkeypatch):
    """It raised, and the observation stayed among the accepted ones."""
    update = IncrementalMap.update

    def fail(self, observation):
        if observation.agent == "66":
            update(self, observation)
            raise np.linalg.LinAlgError("singular matrix")
        return update(self, observation)

    clean, struck = service(), service()
    messages = [received_of(encode_map_message(frame(k, x), street(x))) for k, x in ((1, 30.0), (2, 50.0))]
    for message in messages:
        clean.ingest(message)
    monkeypatch.setattr(IncrementalMap, "update", fail)
    struck.ingest(messages[0])
    assert struck.ingest(received_of(encode_map_message(frame(66, 40.0), street(40.0)))) == []
    struck.ingest(messages[1])
    assert [(r.agent, r.reason) for r in struck.rejected] == [("66", "LinAlgError: singular matrix")]
    assert [one.agent for one in struck.observations] == ["1", "2"]
    assert np.array_equal(clean.map().elements.points, struck.map().elements.points)


def test_rejected_and_incomplete_messages_are_bounded_in_number(monkeypatch):
    monkeypatch.setattr(map_server, "MAX_REMEMBERED", 3)
    made, first = service(), received_of(encode_map_message(frame(1, 30.0), street(30.0)))[0]
    for stamp in range(9):
        message = replace(first.message, timestamp_ns=stamp)
        made.ingest_message(replace(first, message=message, expected_packets=first.received_packets + 1))
    assert made.num_incomplete == 3


def test_a_message_without_a_map_is_no_observation():
    (reception,) = received_of(encode_map_message(frame(1, 30.0), street(30.0)))
    bare = replace(reception, message=replace(reception.message, local_map=None))
    assert service().ingest_message(bare) is None
    with pytest.raises(ObservationError, match="without"):
        make_observation(bare.message, "1", "p")


def test_the_server_continues_from_a_map():
    first = service()
    for k in range(4):
        first.ingest(received_of(encode_map_message(frame(k, 30.0 + k, k), street(30.0 + k))))
    then = MapServer(origin_xy=ORIGIN, initial_map=first.rebuild())
    (done,) = then.ingest(received_of(encode_map_message(frame(9, 32.0, 99), street(32.0))))
    assert done.num_confirmed > 50 and then.frame == MapFrame(49.0, 8.4)
