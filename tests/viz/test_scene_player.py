# SPDX-License-Identifier: Apache-2.0
"""What the player of a report holds: cells of points, integers of boxes, and who supplied what the ego alone misses."""

from __future__ import annotations

import base64
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.datatypes import Boxes
from manyeyes.viz import scene_player
from manyeyes.viz.help_chapter import TITLE, make_help_chapter
from manyeyes.viz.scene_player import (
    CELL_M,
    PlayerAgent,
    PlayerDetections,
    PlayerFrame,
    PlayerMethod,
    ScenePlayer,
    decode_cells,
    encode_cells,
    find_cells,
    to_json,
)
from manyeyes.viz.scene_recorder import count_returns

VIEW = (-40.0, -20.0, 40.0, 20.0)
NUM_COLUMNS = 320


def boxes(*rows: tuple[float, float, float], scores: tuple[float, ...] | None = None) -> Boxes:
    """Return cars at x, y, yaw."""
    at = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
    centre = torch.cat((at[:, :2], torch.full((len(at), 1), 0.8, dtype=torch.float64)), 1)
    size = torch.tensor([[4.6, 1.9, 1.6]], dtype=torch.float64).expand(len(at), 3)
    return Boxes.of(centre, size, at[:, 2], None if scores is None else torch.tensor(scores), id=torch.arange(len(at)))


def detections(found: Boxes, truth_row: list[int], received: tuple[int, ...] = ()) -> PlayerDetections:
    counts = np.array([[0, 40] if row == 0 else [9, 0] for row in truth_row], dtype=np.int64).reshape(-1, 2)
    return PlayerDetections(found, np.array(truth_row, dtype=np.int64), counts, received, 1500 if received else 0)


def make_player(num_frames: int = 3) -> ScenePlayer:
    """A car 12 m ahead and 6 m to the left that only the pole has points on, and one 15 m behind that the ego detects alone.

    With messages both are found. The ego alone has a false alarm, score 0.3, 20 m ahead and 10 m to the right.
    """
    truth = boxes((12.0, 6.0, 0.0), (-15.0, 0.0, 0.0))
    cells = find_cells(np.array([[30.0, 15.0]] * 3 + [[30.0, -15.0]]), VIEW)
    agents = (
        PlayerAgent(1, "ego", False, 0.0, 0.0, 0.0, cells),
        PlayerAgent(7, "pole 7", True, 20.0, 10.0, math.pi, cells[:1]),
    )
    counts = np.array([[0, 40], [9, 0]])
    frames = tuple(PlayerFrame(10 + k, 0.1 * k, agents, truth, counts) for k in range(num_frames))
    alone = detections(boxes((-15.0, 0.0, 0.0), (20.0, -10.0, 0.0), scores=(0.8, 0.3)), [1, -1])
    fused = detections(boxes((12.0, 6.0, 0.0), (-15.0, 0.0, 0.0), scores=(0.9, 0.85)), [0, 1], (7,))
    return ScenePlayer(
        VIEW,
        0.1,
        frames,
        (
            PlayerMethod("no-fusion", "No fusion", 0.2, False, (alone,) * num_frames),
            PlayerMethod("late", "Late fusion", 0.4, True, (fused,) * num_frames, 4.0),
        ),
        first_frame=1,
    )


@given(st.sets(st.integers(0, 2_000_000)))
def test_cells_survive_the_page(numbers: set[int]) -> None:
    cells = np.array(sorted(numbers), dtype=np.int64)
    assert decode_cells(encode_cells(cells)).tolist() == cells.tolist()


def test_neighbouring_cells_are_a_byte_each() -> None:
    assert len(base64.b64decode(encode_cells(np.arange(1000)))) == 1000


def test_cells_count_from_the_lower_left_and_points_outside_are_left_out() -> None:
    xy = np.array([[-40.0, -20.0], [-40.0 + CELL_M, -20.0], [-40.0, -20.0 + CELL_M], [40.0, 0.0], [0.0, -20.1]])
    assert find_cells(xy, VIEW).tolist() == [0, 1, NUM_COLUMNS]


def test_returns_are_counted_in_turned_boxes() -> None:
    corner = 0.5 * math.sqrt(0.5)
    cloud = np.array([[10 + 3 * corner, 5 + 3 * corner, 0.8], [10 + 3 * corner, 5 - 3 * corner, 0.8], [10.0, 5.0, 3.0]])
    turned = boxes((10.0, 5.0, math.pi / 4), (10.0, 5.0, -math.pi / 4), (0.0, 0.0, 0.0))
    assert count_returns(turned, [cloud, cloud[:0]]).tolist() == [[1, 0], [1, 0], [0, 0]]
    inside = turned[:1].contains(torch.from_numpy(cloud), 0.1)
    assert count_returns(turned[:1], [cloud]).tolist() == [[int(inside.sum())]]


def test_points_on_the_road_are_no_returns_and_those_of_a_vehicle_downhill_are() -> None:
    cloud = np.array([[10.0, 5.0, 0.2], [10.0, 5.0, 0.5], [10.0, 5.0, -1.8], [10.0, 5.0, -1.5]])
    car = boxes((10.0, 5.0, 0.0))
    downhill = replace(car, center=car.center - torch.tensor([0.0, 0.0, 2.0]))
    assert count_returns(car, [cloud]).tolist() == [[1]]
    assert count_returns(downhill, [cloud]).tolist() == [[1]]


def test_boxes_are_integers_and_points_are_thinned_to_their_limit(monkeypatch) -> None:
    held = to_json(make_player())
    assert held["frames"][0]["truth"][0] == [1200, 600, 460, 190, 0, 0, 40]
    assert held["methods"][0]["frames"][0]["boxes"][1] == [2000, -1000, 460, 190, 0, 300, -1, 9, 0]
    assert held["frames"][0]["agents"][1] == [7, "pole 7", 1, 2000, 1000, 3142]
    assert ([method["alone"] for method in held["methods"]], held["first"]) == ([-1, 0], 1)
    size = sum(len(text) for frame in held["frames"] for text in frame["cells"])
    monkeypatch.setattr(scene_player, "MAX_POINT_BYTES", size - 1)
    thinned = to_json(make_player())
    assert 0 < sum(len(text) for frame in thinned["frames"] for text in frame["cells"]) < size


def test_the_agent_with_points_on_a_vehicle_supplied_it() -> None:
    chapter = make_help_chapter(make_player(), "late")
    assert chapter is not None and chapter.title == TITLE
    assert chapter.table[1:] == (("pole 7", "3", "1", "40", "0"),)
    assert (
        "no-fusion finds 3, late 6" in chapter.text
        and "Of the 3 that the ego misses alone, 3 are found" in chapter.text
    )


def test_a_method_is_compared_with_the_ego_alone_of_its_form() -> None:
    player = make_player()
    alone, late = player.methods
    temporal = replace(alone, name="no-fusion-temporal"), replace(late, name="late-temporal")
    player = replace(player, methods=(alone, *temporal, late))
    assert [player.find_alone(method) for method in player.methods] == [-1, -1, 1, 0]
    assert replace(player, methods=(alone, temporal[1])).find_alone(temporal[1]) == 0
    assert replace(player, methods=(late,)).find_alone(late) == -1


@pytest.mark.parametrize("name", ["no-fusion", "early"])
def test_without_a_method_with_messages_there_is_no_chapter_on_help(name: str) -> None:
    assert make_help_chapter(make_player(), name) is None
