# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model draw, by way of bytes, and the files that they go on from; with a model that knows nothing."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.comms import wire
from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.evaluation.maps import tile_cells
from manyeyes.evaluation.maps import tile_prediction as tile_drawing
from manyeyes.evaluation.maps.tile_cells import Drawing, World, run_tiles
from manyeyes.evaluation.maps.tile_prediction import (
    ALONE,
    CLEAN,
    CORRECTED,
    NOISY,
    ROADSIDE,
    UNHURT,
    VEHICLE,
    DrawLocal,
    DrawPose,
    DrawSemiGlobal,
)
from manyeyes.evaluation.maps.tile_sampling import Scenery, stands_of
from manyeyes.maps.store.executors import Inline
from manyeyes.models import checkpoint
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.map_model import Mapper, MapperConfig
from manyeyes.models.maps.presets import FORMAT

CONFIG = MapperConfig(
    BevConfig(BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5), channels=16, raster_width=8, raster_blocks=(1, 1)),
    BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0),
    token_channels=8,
    neck=(1, 1),
    head=MapHeadConfig(elements=9, points=5, least=0.0, channels=16, feed=32, layers=1, heads=4, threshold=0.0),
)
LINE = MapElements.of([[[98.0, 0.0], [98.0, 100.0]]], DIVIDER)


@dataclass(frozen=True)
class Drive:
    """Two cars and a pole, three frames, the first of them history; car 7 stands at (100, 50) and looks north."""

    scenarios: tuple[str, ...] = ("town1_0000", "town1_0001")

    def length(self, scenario: str) -> int:
        return 3

    def judged(self, scenario: str) -> range:
        return range(1, 3)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (7, 8, -1)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        poses = [Transform.from_xyz_yaw(100 + 4 * k, 50 + 5 * k, 2, math.pi / 2 - k) for k in range(3)]
        clouds = [torch.randn(80, 3, generator=torch.Generator().manual_seed(index + 5 * k)) * 2 for k in range(3)]
        frames = [AgentFrame.of(PointCloud.of(c), p, a, index * 10**8) for c, p, a in zip(clouds, poses, (7, 8, -1))]
        return Snapshot(scenario, index, (*frames[:2], replace(frames[2], is_infrastructure=True)))


def truth_of(recording) -> dict[str, MapElements]:
    return {"Town1": LINE}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    checkpoint.save(Mapper(CONFIG), path, {"towns": []}, format=FORMAT)
    return str(path)


@pytest.fixture(scope="module")
def mapper(weights):
    return tile_cells._mapper(weights)


@pytest.fixture
def scenery():
    return Scenery(Drive(), truth_of(Drive()), stands_of(Drive()))


@pytest.fixture
def sent(monkeypatch):
    packets = []
    monkeypatch.setattr(wire, "decode_packet", lambda p, read=wire.decode_packet: packets.append(p) or read(p))
    return packets


def test_more_looks_change_the_drawing_and_every_look_is_bytes(mapper, scenery, sent):
    one, two, many = DrawSemiGlobal((1, 2, 9))(mapper, scenery, "town1_0000", 0)
    assert [len(d.sent) for d in (one, two, many)] == [1, 2, 6], "three agents here, three in the other scenario"
    assert many.sent[:2] == two.sent and two.sent[:1] == one.sent and sum(many.sent) == sum(map(len, sent))
    assert [d.row for d in (one, two, many)] == ["1", "2", "9"] and len(one.drawn) and len(one.truth) == 1
    assert not np.allclose(one.drawn.score, many.drawn.score, atol=1e-5)
    np.testing.assert_array_equal(one.truth.points, many.truth.points)


def test_local_maps_are_cut_to_what_lies_ahead(mapper, scenery):
    drawings = DrawLocal()(mapper, scenery, "town1_0000", 0)
    assert [d.row for d in drawings] == [VEHICLE, VEHICLE, ROADSIDE] and all(len(d.sent) == 1 for d in drawings)
    assert all((d.drawn.points[:, 0] >= 0).all() and len(d.drawn) for d in drawings)
    np.testing.assert_allclose(np.sort(drawings[0].truth.points, 0), [[0, 2], [30, 2]], atol=1e-4)


def test_errors_of_claims_move_others_looks_and_the_corrector_hears_boxes(mapper, scenery, monkeypatch):
    """The corrector is asked with the noisy looks and their boxes, and what it returns is drawn from."""
    heard, car = [], Boxes.of(torch.tensor([[4.0, 1.0, 0.8]]), torch.tensor([[4.5, 1.9, 1.6]]), torch.tensor([0.3]))

    class Believer:
        """Puts everybody back to the true pose, as a perfect corrector would."""

        def align(self, frame, eyes, messages, states):
            heard.append(messages)
            true = {f.agent_id: f.world_from_agent for f in scenery.recording.snapshot("town1_0000", 1).frames}
            back = tuple(replace(m, world_from_agent=true[m.agent_id]) for m in messages)
            return type("Aligned", (), {"messages": back})

    class Saying:
        def say(self, eyes, frame):
            return type("Said", (), {"objects": car})

    monkeypatch.setattr(tile_drawing, "_eyes_of", lambda *_: object())
    monkeypatch.setattr(tile_drawing, "Late", Saying)
    drawn = {d.row: d for d in DrawPose(sigma_m=2.0, aligner=Believer())(mapper, scenery, "town1_0000", 0)}
    assert list(drawn) == [ALONE, CLEAN, NOISY, CORRECTED, UNHURT]
    assert [len(drawn[row].sent) for row in drawn] == [1, 3, 3, 3, 3] and len(heard) == 2
    assert [m.agent_id for m in heard[0]] == [8, -1] and all(len(m.objects) == 1 for m in heard[0])
    assert float(heard[0][0].pose_covariance[0, 0]) == pytest.approx(4.0, rel=0.05)
    assert not np.allclose(drawn[CLEAN].drawn.score, drawn[NOISY].drawn.score, atol=1e-5)
    for row in (CORRECTED, UNHURT):
        np.testing.assert_allclose(drawn[CLEAN].drawn.score, drawn[row].drawn.score, atol=1e-4)


@dataclass
class Counting:
    """Draws the truth at both rows, and counts how often it was asked."""

    asked: int = 0
    key: str = "counting"

    def __call__(self, mapper, scenery, scenario, seed):
        self.asked += 1
        truth = scenery.truth(scenario, Transform.from_xyz_yaw(100, 50, 0, seed), CONFIG.tile)
        return [Drawing("one", truth, truth, (100 + seed,)), Drawing("none", MapElements.empty(), truth, ())]


def test_a_study_that_was_stopped_goes_on(weights, tmp_path):
    world, draw, seen = World(Drive, truth_of), Counting(), []
    first = run_tiles(world, weights, draw, (0, 1), tmp_path, Inline(), lambda done, total: seen.append((done, total)))
    assert draw.asked == 4 and seen[-1] == (4, 4)
    assert [(c.scenario, c.seed) for c in first] == [(s, k) for s in Drive().scenarios for k in (0, 1)]
    sorted(tmp_path.glob("town1_0001-1-*.npz"))[0].write_bytes(b"spoilt")
    again = run_tiles(world, weights, draw, (0, 1), tmp_path, Inline())
    assert draw.asked == 5, "kept ones are read, a spoilt one is made anew"
    for one, other in zip(first, again):
        for a, b in zip(one.drawings, other.drawings, strict=True):
            assert (a.row, a.sent) == (b.row, b.sent) and len(a.drawn) == len(b.drawn)
            np.testing.assert_array_equal(a.truth.points, b.truth.points)
    run_tiles(world, weights, draw, (0, 2), tmp_path, Inline(), every=2)
    assert draw.asked == 6, "another seed of the first scenario alone"


def test_other_weights_are_other_cells(weights, tmp_path):
    torch.manual_seed(1)
    other = tmp_path / "other.safetensors"
    checkpoint.save(Mapper(CONFIG), other, {"towns": []}, format=FORMAT)
    world, draw = World(Drive, truth_of), Counting()
    for name in (weights, str(other)):
        run_tiles(world, name, draw, (0,), tmp_path / "cells", Inline(), every=2)
    assert draw.asked == 2
