# SPDX-License-Identifier: Apache-2.0
"""Tiles: what lies in them, who looked, and how a set of them is judged."""

import math

import numpy as np
import pytest
import torch

from manyeyes.comms import wire
from manyeyes.datatypes import AgentFrame, BevGrid, ConfigError, PointCloud, Snapshot, Transform
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation import map_tiles
from manyeyes.evaluation.map_tiles import (
    assert_split,
    cut_to,
    judge_tiles,
    met_by,
    side_by_side,
    tiles_of,
    town_of,
)
from manyeyes.models.map_bev import BevConfig
from manyeyes.models.map_head import MapHeadConfig
from manyeyes.models.mapper import Mapper, MapperConfig

TILE = BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0)
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
CONFIG = MapperConfig(
    BevConfig(BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5), channels=16, raster_width=8, raster_blocks=(1, 1)),
    TILE,
    token_channels=8,
    neck=(1, 1),
    head=MapHeadConfig(elements=4, points=5, channels=16, feed=32, layers=1, heads=4, threshold=0.0),
)


class Drive:
    """Two agents, three frames, the first of them history; agent 7 stands at (100, 50) and looks north."""

    scenarios = ("town1_0000", "town1_0001")

    def length(self, scenario):
        return 3

    def judged(self, scenario):
        return range(1, 3)

    def agents(self, scenario):
        return (7, 8)

    def snapshot(self, scenario, index):
        poses = (Transform.from_xyz_yaw(100, 50, 2, math.pi / 2), Transform.from_xyz_yaw(104, 55, 2, 0.3))
        clouds = [
            PointCloud.of(torch.randn(80, 3, generator=torch.Generator().manual_seed(index + 5 * k)) * 2)
            for k in range(2)
        ]
        frames = [AgentFrame.of(c, p, 7 + k, index) for k, (c, p) in enumerate(zip(clouds, poses))]
        return Snapshot(scenario, index, tuple(frames))


def test_a_line_is_cut_at_the_border_and_moved_into_the_tile():
    # The tile lies at (100, 50) and looks north: the world's north is its x.
    world = MapElements.of([[[98.0, 0.0], [98.0, 100.0]], [[0.0, 0.0], [1.0, 1.0]]], [DIVIDER, DIVIDER])
    cut = cut_to(world, Transform.from_xyz_yaw(100, 50, 0, math.pi / 2), TILE)
    assert len(cut) == 1
    np.testing.assert_allclose(np.sort(cut.polyline(0), axis=0), [[-10, 2], [10, 2]], atol=1e-9)


def test_a_ring_that_is_cut_stays_a_ring_and_slivers_go():
    at = [SQUARE * 2 + [8.0, 0.0], SQUARE * 2 + [9.5, -4.0]]
    cut = cut_to(MapElements.of(at, [CROSSING, CROSSING]), Transform.identity(), TILE)
    # The first keeps 2 of its 4 m, 8 m²; of the second 0.5 x 4 = 2 m² are left.
    assert len(cut) == 1
    ring = cut.polyline(0)
    assert ring[:, 0].max() == 10 and ring[:, 0].min() == 8 and len(ring) == 4
    # A line that leaves and comes back is two; a piece below two metres is none.
    bent = MapElements.of([[[0, 0], [12, 0], [12, 3], [0, 3]], [[9.0, -4.0], [15.0, -4.0]]], DIVIDER)
    assert len(cut_to(bent, Transform.identity(), TILE)) == 2


def test_what_no_look_covers_is_not_asked_for():
    lines = MapElements.of([[[-10, 0], [10, 0]], [[5, 4], [10, 4]], [[-10, -3.9], [-4, -3.9]]], DIVIDER)
    view = BevGrid(-4.0, -4.5, -1.0, 4.0, 4.5, 1.0, pillar=0.5)
    # One look covers x from -4 to 4: 40 % of the first line, nothing of the second and the third.
    assert len(met_by(lines, [Transform.identity()], view)) == 1
    both = [Transform.identity(), Transform.from_xyz_yaw(8, 0, 0, math.pi)]
    np.testing.assert_allclose(met_by(lines, both, view).polyline(1), lines.polyline(1))
    assert len(met_by(lines, both, view)) == 2
    # At x = -8.4 the view ends at -4.4, 28 % along the first line; turned by ninety degrees, it reaches 4.5 m along x.
    assert len(met_by(lines, [Transform.from_xyz_yaw(-8.4, 0, 0, 0)], view)) == 1
    assert len(met_by(lines, [Transform.from_xyz_yaw(-8.4, 0, 0, math.pi / 2)], view)) == 2


def test_tiles_lie_about_the_first_agent_and_take_fewer_looks_as_a_prefix():
    maps = {"Town1": MapElements.of([[[98.0, 0.0], [98.0, 100.0]]], DIVIDER)}
    ten = tiles_of(Drive(), maps, TILE, looks=10)
    assert [t.scenario for t in ten] == list(Drive.scenarios) and len(ten[0].truth) == 1
    assert float(ten[0].world_from_tile.translation[0]) == 100 and float(ten[0].world_from_tile.translation[2]) == 0
    assert float(ten[0].world_from_tile.yaw) == pytest.approx(math.pi / 2)
    assert [(f.agent_id, f.timestamp_ns) for f in ten[0].looks] == [(7, 1), (8, 1), (7, 2), (8, 2)]
    three = tiles_of(Drive(), maps, TILE, looks=3, every=2)
    assert [(f.agent_id, f.timestamp_ns) for f in three[0].looks] == [(7, 1), (8, 1), (7, 2)] and len(three) == 1


def test_a_scenario_is_named_after_its_town_and_a_town_is_on_one_side():
    assert town_of("town10hd_0004", ("Town1", "Town10HD")) == "Town10HD"
    with pytest.raises(ConfigError, match="named after none"):
        town_of("city_3", ("Town01",))
    assert_split(("Town01",), ("Town05",))
    with pytest.raises(ConfigError, match="town05"):
        assert_split(("Town01", "town05"), ("Town05",))


def test_tiles_do_not_answer_for_each_other():
    line = MapElements.of([[[-10.0, 0.0], [10.0, 0.0]]], DIVIDER)
    both = side_by_side([line, line.with_points(line.points + [0.0, 0.2])])
    assert len(both) == 2 and np.ptp(both.points[:, 0]) > 900


def test_judging_goes_through_bytes(monkeypatch):
    torch.manual_seed(0)
    mapper = Mapper(CONFIG).eval().requires_grad_(False)
    maps = {"Town1": MapElements.of([[[98.0, 0.0], [98.0, 100.0]]], DIVIDER)}
    tiles = tiles_of(Drive(), maps, TILE)
    sent = []
    monkeypatch.setattr(
        wire, "decode_packet", lambda packet, read=wire.decode_packet: sent.append(packet) or read(packet)
    )
    score = judge_tiles(mapper, tiles, looks=3, ways=("maptr",))
    assert score.messages == 6 and score.bytes_per_look == sum(map(len, sent)) / 6 > 100
    assert score.quality.of("divider").n_truth == 2 and score.quality.of("divider").n_predicted > 0
    assert 0 <= score.mean_ap() <= 1
    few = judge_tiles(mapper, tiles, looks=1, budget_bytes=1500, ways=("maptr",))
    assert few.messages == 2 and few.bytes_per_look <= 1500


def test_a_map_drawn_as_it_is_scores_one(monkeypatch):
    truth = MapElements.of([[[98.0, 0.0], [98.0, 100.0]], SQUARE + [100.0, 50.0]], [DIVIDER, CROSSING])
    tiles = tiles_of(Drive(), {"Town1": truth}, TILE, looks=1)
    drawn = iter([tile.truth for tile in tiles])
    monkeypatch.setattr(map_tiles, "draw_tile", lambda *_: next(drawn))
    torch.manual_seed(0)
    assert judge_tiles(Mapper(CONFIG).eval(), tiles, looks=1).mean_ap() == 1.0
