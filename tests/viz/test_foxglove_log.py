# SPDX-License-Identifier: Apache-2.0
"""What is written for Foxglove is read back from its file: topics, schemas, places, colours, numbers."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("mcap", reason="the extra live is not installed")

from mcap.reader import make_reader

from manyeyes.datatypes import Boxes, Transform
from manyeyes.viz.foxglove_log import FoxgloveLog
from manyeyes.viz.spatial_entities import MAP_COLORS, MAX_POINTS, shade_by_agent, shade_by_intensity
from manyeyes.viz.spatial_frame import BOX_COLORS, ShownAgent, ShownBoxes, ShownLink, SpatialFrame

START_NS = 1_800_000_000 * 10**9


def box(x: float, score: float = 0.9, number: int = -1) -> Boxes:
    size, yaw = torch.tensor([[4.0, 2.0, 1.6]]), torch.tensor([math.pi / 2])
    return Boxes.of(torch.tensor([[x, 0.0, 0.8]]), size, yaw, torch.tensor([score]), id=torch.tensor([number]))


def make_frame(index: int = 0) -> SpatialFrame:
    cloud = np.arange(12, dtype=np.float32).reshape(4, 3)
    here, there = Transform.from_xyz_yaw(1.0, 2.0, 0.0), Transform.from_xyz_yaw(11.0, 2.0, 0.0, math.pi / 2)
    return SpatialFrame(
        index,
        START_NS + index * 10**8,
        (
            ShownAgent(1, here, cloud, np.array([0.0, 0.5, 1.0, 2.0], np.float32)),
            ShownAgent(2, there, corrected=Transform.from_xyz_yaw(12.0, 3.0, 0.0)),
        ),
        ShownBoxes(Boxes.cat([box(5.0), box(30.0, 0.4)]), ("matched", "false")),
        ShownBoxes(box(5.0, 1.0, 7), ("truth",)),
        (ShownLink(2, 1, 1_500, 280.0, START_NS + 5), ShownLink(9, 1, 10, 80.0)),
        {"divider": (np.array([[0.0, 0.0], [5.0, 1.0]]),)},
        {"age_ms/2": 80.0, "level": 0.0, "age_ms/9": math.nan},
        ("agent 2 rejected: skewed",),
    )


def write(path: Path, *frames: SpatialFrame) -> dict[str, list[tuple[str, int, dict]]]:
    """Write frames, and read them back."""
    with FoxgloveLog(path) as log:
        for frame in frames:
            log.add(frame)
    return read(path)


def read(path: Path) -> dict[str, list[tuple[str, int, dict]]]:
    """Messages by topic: schema, time and content."""
    found: dict[str, list[tuple[str, int, dict]]] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
            assert json.loads(schema.data)["type"] == "object"
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, json.loads(message.data)))
    return found


def read_cloud(cloud: dict) -> np.ndarray:
    """Points as rows, by the fields that the message states."""
    kinds = {1: "u1", 7: "<f4"}
    names, offsets, types = zip(*((f["name"], f["offset"], kinds[f["type"]]) for f in cloud["fields"]))
    layout = {"names": names, "formats": types, "offsets": offsets, "itemsize": cloud["point_stride"]}
    return np.frombuffer(base64.b64decode(cloud["data"]), np.dtype(layout))


def test_every_quantity_has_its_topic_and_schema(tmp_path) -> None:
    found = write(tmp_path / "run.mcap", make_frame(), make_frame(1))
    scenes = dict.fromkeys(("/ego/boxes", "/truth", "/links", "/corrections", "/map"), "foxglove.SceneUpdate")
    assert {topic: messages[0][0] for topic, messages in found.items()} == scenes | {
        "/tf": "foxglove.FrameTransform",
        "/agents/1/cloud": "foxglove.PointCloud",
        "/plots": "manyeyes.Plots",
        "/events": "foxglove.Log",
    }
    assert [time for _, time, _ in found["/ego/boxes"]] == [START_NS, START_NS + 10**8]
    stamp = found["/events"][1][2]["timestamp"]
    assert stamp == {"sec": 1_800_000_000, "nsec": 10**8} and found["/events"][1][2]["message"].endswith("skewed")


def test_boxes_have_place_heading_colour_and_score(tmp_path) -> None:
    (_, _, update), *_ = write(tmp_path / "run.mcap", make_frame())["/ego/boxes"]
    first, second = update["entities"]
    (cube,) = first["cubes"]
    assert cube["pose"]["position"] == pytest.approx({"x": 5.0, "y": 0.0, "z": 0.8})
    half = math.sqrt(0.5)
    assert cube["pose"]["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": half, "w": half})
    assert cube["size"] == pytest.approx({"x": 4.0, "y": 2.0, "z": 1.6}) and first["frame_id"] == "world"
    red, green, blue = (value / 255 for value in BOX_COLORS["matched"])
    assert cube["color"] == pytest.approx({"r": red, "g": green, "b": blue, "a": 0.5})
    (text,) = second["texts"]
    assert text["text"] == "0.40 false" and text["pose"]["position"] == pytest.approx({"x": 30.0, "y": 0.0, "z": 1.6})
    assert {"key": "score", "value": "0.40"} in second["metadata"] and update["deletions"][0]["type"] == 1


def test_clouds_are_floats_in_the_frame_of_their_agent(tmp_path) -> None:
    found = write(tmp_path / "run.mcap", make_frame())
    cloud = found["/agents/1/cloud"][0][2]
    rows = read_cloud(cloud)
    assert cloud["frame_id"] == "agent_1" and cloud["point_stride"] == 20
    assert np.array_equal(np.stack([rows[name] for name in "xyz"], 1), np.arange(12).reshape(4, 3))
    assert rows["intensity"].tolist() == [0.0, 0.5, 1.0, 2.0] and rows["alpha"].tolist() == [255] * 4
    transforms = {one["child_frame_id"]: one for _, _, one in found["/tf"]}
    assert transforms["agent_2"]["translation"] == pytest.approx({"x": 11.0, "y": 2.0, "z": 0.0})


@pytest.mark.parametrize("cloud_color", ["agent", "intensity"])
def test_points_have_the_colour_of_their_agent_or_of_their_intensity(tmp_path, cloud_color) -> None:
    with FoxgloveLog(tmp_path / "run.mcap", cloud_color) as log:
        log.add(make_frame())
    rows = read_cloud(read(tmp_path / "run.mcap")["/agents/1/cloud"][0][2])
    intensity = np.array([0.0, 0.5, 1.0, 2.0], np.float32)
    shades = {"agent": shade_by_agent((90, 170, 255), intensity), "intensity": shade_by_intensity(intensity)}
    assert np.array_equal(np.stack([rows[name] for name in ("red", "green", "blue")], 1), shades[cloud_color])


def test_map_elements_are_coloured_by_kind_and_written_again_only_when_they_change(tmp_path) -> None:
    frame = make_frame()
    found = write(tmp_path / "run.mcap", frame, replace(frame, index=1), replace(frame, map_lines={}))
    first, gone = (update["entities"] for _, _, update in found["/map"])
    red, green, blue = (value / 255 for value in MAP_COLORS["divider"])
    assert first[0]["lines"][0]["color"] == pytest.approx({"r": red, "g": green, "b": blue, "a": 1.0}) and gone == []


def test_the_cloud_of_an_agent_that_left_is_emptied(tmp_path) -> None:
    frame = make_frame()
    found = write(tmp_path / "run.mcap", frame, replace(frame, agents=frame.agents[1:]), replace(frame, agents=()))
    assert [len(read_cloud(cloud)) for _, _, cloud in found["/agents/1/cloud"]] == [4, 0]


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.1, -0.2, 3.0), (3.1, 0.1, -0.4), (0.2, 1.5, 0.3), (0.0, 3.1, 3.1)])
def test_a_quaternion_is_the_rotation(tmp_path, rpy) -> None:
    pose = Transform.from_angles((0.0, 0.0, 0.0), rpy)
    frame = replace(make_frame(), agents=(ShownAgent(1, pose),))
    q = write(tmp_path / "run.mcap", frame)["/tf"][0][2]["rotation"]
    x, y, z, w = (q[name] for name in "xyzw")
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    assert np.allclose(rotation, pose.rotation.numpy(), atol=1e-9)


def test_messages_of_unknown_senders_and_numbers_without_value_are_left_out(tmp_path) -> None:
    found = write(tmp_path / "run.mcap", make_frame())
    (link,) = found["/links"][0][2]["entities"]
    assert link["id"] == "2-1" and [p["x"] for p in link["lines"][0]["points"]] == [11.0, 1.0]
    assert link["lines"][0]["color"]["r"] == pytest.approx(120 / 255)
    (label,) = link["texts"]
    assert label["text"] == "1500 B, 280 ms" and label["pose"]["position"]["x"] == 6.0
    assert all(entity["texts"] == [] for entity in found["/truth"][0][2]["entities"])
    assert found["/plots"][0][2] == {"age_ms": {"2": 80.0}, "level": 0.0}


def test_of_a_long_cloud_every_nth_point_is_written(tmp_path) -> None:
    points = np.zeros((2 * MAX_POINTS + 1, 3), np.float32)
    frame = replace(make_frame(), agents=(ShownAgent(1, Transform.identity(), points),))
    cloud = write(tmp_path / "run.mcap", frame)["/agents/1/cloud"][0][2]
    assert len(read_cloud(cloud)) == -(-len(points) // 3)


def test_after_an_error_there_is_no_file(tmp_path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(RuntimeError, match="stop"), FoxgloveLog(path) as log:
        log.add(make_frame())
        raise RuntimeError("stop")
    assert not list(tmp_path.iterdir())
