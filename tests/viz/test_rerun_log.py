# SPDX-License-Identifier: Apache-2.0
"""What is logged for the viewer is read back from its file: entities, timelines, places, colours and labels."""

from __future__ import annotations

import socket
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("rerun", reason="the extra rerun is not installed")

import rerun

from manyeyes.datatypes import Boxes, ConfigError, Transform
from manyeyes.viz.rerun_log import RerunLog
from manyeyes.viz.rerun_server import RerunServer
from manyeyes.viz.spatial_entities import LINK_HEIGHT_M, MAX_POINTS, AgentGroup, SpatialDescription, shade_by_intensity
from manyeyes.viz.spatial_frame import (
    BOX_COLORS,
    ShownAgent,
    ShownBoxes,
    ShownLink,
    SpatialFrame,
    mark_errors,
)

START_NS = 1_800_000_000 * 10**9


def box(x: float, score: float = 0.9, number: int = -1) -> Boxes:
    return Boxes.of(
        torch.tensor([[x, 0.0, 0.8]]), torch.tensor([[4.0, 2.0, 1.6]]), torch.tensor([np.pi / 2]), torch.tensor([score]),
        id=torch.tensor([number]),
    )  # fmt: skip


def make_frame(index: int = 0) -> SpatialFrame:
    cloud = np.arange(12, dtype=np.float32).reshape(4, 3)
    here, there = Transform.from_xyz_yaw(1.0, 2.0, 0.0), Transform.from_xyz_yaw(11.0, 2.0, 0.0, np.pi / 2)
    return SpatialFrame(
        index,
        START_NS + index * 10**8,
        (
            ShownAgent(1, here, cloud, np.array([0.0, 0.5, 1.0, 2.0], np.float32)),
            ShownAgent(2, there, corrected=Transform.from_xyz_yaw(12.0, 3.0, 0.0)),
        ),
        ShownBoxes(Boxes.cat([box(5.0), box(30.0, 0.4)]), ("matched", "false")),
        ShownBoxes(Boxes.cat([box(5.0, 1.0, 7), box(60.0, 1.0, 8)]), ("truth", "missed")),
        (ShownLink(2, 1, 1_500, 80.0, START_NS + 5), ShownLink(9, 1, 10, 80.0)),
        {"divider": (np.array([[0.0, 0.0], [5.0, 1.0]]),)},
        {"age_ms/2": 80.0},
        ("agent 2 rejected: skewed",),
    )


def read_back(path: Path) -> dict[str, list]:
    """Chunks by entity."""
    found: dict[str, list] = {}
    for chunk in rerun.chunk.RrdReader(str(path)).stream():
        found.setdefault(chunk.entity_path, []).append(chunk)
    return found


def column(chunks: list, name: str) -> list:
    values = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if name in batch.schema.names:
            values += batch.column(name).to_pylist()
    return values


def test_what_was_logged_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "drive.rrd"
    with RerunLog(str(path)) as log:
        for index in range(3):
            log.add(make_frame(index))
        assert not path.exists()
    assert [p.name for p in path.parent.iterdir()] == ["drive.rrd"]
    found = read_back(path)
    assert {
        "/world/agents/1", "/world/agents/1/cloud", "/world/agents/2", "/world/corrections/2", "/world/ego/boxes", "/world/truth",
        "/world/links/2-1", "/world/map/divider", "/plots/age_ms/2", "/events",
    } <= found.keys()  # fmt: skip
    # No pose of agent 9 is known.
    assert not {"/world/links/9-1", "/world/agents/2/cloud", "/world/corrections/1"} & found.keys()
    assert sorted(column(found["/world/ego/boxes"], "tick")) == [0, 1, 2]
    timelines = {name for chunk in found["/world/links/2-1"] for name in chunk.timeline_names}
    assert {"tick", "capture", "arrival"} <= timelines
    assert "arrival" not in {name for chunk in found["/world/truth"] for name in chunk.timeline_names}
    captured = np.array(column(found["/world/agents/1"], "capture"), "datetime64[ns]").astype(np.int64)
    assert sorted(captured.tolist()) == [START_NS + k * 10**8 for k in range(3)]
    boxes = found["/world/ego/boxes"]
    assert column(boxes, "Boxes3D:labels")[0] == ["0.90 matched", "0.40 false"]
    assert np.allclose(column(boxes, "Boxes3D:centers")[0], [[5.0, 0.0, 0.8], [30.0, 0.0, 0.8]])
    assert np.allclose(column(boxes, "Boxes3D:quaternions")[0], [[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]] * 2, atol=1e-6)
    r, g, b = BOX_COLORS["matched"]
    assert column(boxes, "Boxes3D:colors")[0][0] == (r << 24) + (g << 16) + (b << 8) + 255
    assert column(found["/world/truth"], "Boxes3D:labels")[0] == ["7 1.00 truth", "8 1.00 missed"]
    assert column(found["/world/agents/1/cloud"], "Points3D:positions")[0][3] == [9.0, 10.0, 11.0]
    assert column(found["/world/corrections/2"], "Arrows3D:vectors")[0] == [[1.0, 1.0, 0.0]]
    assert column(found["/world/links/2-1"], "LineStrips3D:labels")[0] == ["1500 B, 80 ms"]
    assert column(found["/plots/age_ms/2"], "Scalars:scalars")[0] == [80.0]
    assert column(found["/events"], "TextLog:text")[0] == ["agent 2 rejected: skewed"]


def test_long_clouds_are_thinned_and_a_failed_log_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    cloud = np.zeros((2 * MAX_POINTS + 1, 3), np.float32)
    nothing = ShownBoxes(Boxes.empty(), ())
    with RerunLog(str(path)) as log:
        log.add(SpatialFrame(0, START_NS, (ShownAgent(1, Transform.identity(), cloud),), nothing, nothing))
    (points,) = column(read_back(path)["/world/agents/1/cloud"], "Points3D:positions")
    assert MAX_POINTS / 2 < len(points) <= MAX_POINTS
    with pytest.raises(ZeroDivisionError), RerunLog(str(tmp_path / "b.rrd")):
        raise ZeroDivisionError
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
    with pytest.raises(ConfigError, match=r"\.rrd"):
        RerunLog("drive.png")


def test_a_file_that_could_not_be_written_whole_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "drive.rrd"
    path.write_bytes(b"the drive of yesterday")

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no space left")

    problem = r"drive\.rrd: not all frames could be written \(no space left\)"
    with pytest.raises(ConfigError, match=problem), RerunLog(str(path), "drive") as log:
        log.add(make_frame())
        monkeypatch.setattr(rerun.RecordingStream, "flush", fail)
    assert path.read_bytes() == b"the drive of yesterday" and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_an_end_after_a_flush_needs_the_viewer_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("the viewer is gone")

    with RerunLog(str(tmp_path / "drive.rrd"), "drive") as log:
        log.add(make_frame())
        log.flush()
        monkeypatch.setattr(rerun.RecordingStream, "flush", fail)
    assert (tmp_path / "drive.rrd").stat().st_size > 0


def test_an_agent_keeps_its_colour_where_another_is_gone() -> None:
    description = SpatialDescription()
    both = make_frame()
    (first, second), (left,) = (
        next(group for group in description.describe(frame) if isinstance(group, AgentGroup)).items
        for frame in (both, replace(both, agents=both.agents[1:]))
    )
    assert first.color != second.color and left.color == second.color


def test_what_an_instant_no_longer_has_is_cleared(tmp_path: Path) -> None:
    frame = make_frame()
    with RerunLog(str(tmp_path / "a.rrd")) as log:
        log.add(frame)
        log.add(replace(frame, index=1, agents=frame.agents[:1], links=()))
        log.add(replace(frame, index=2, agents=frame.agents[:1], links=()))
    found = read_back(tmp_path / "a.rrd")
    for path in ("/world/agents/2", "/world/corrections/2", "/world/links/2-1"):
        cleared = [chunk for chunk in found[path] if "Clear:is_recursive" in chunk.to_record_batch().schema.names]
        assert column(cleared, "tick") == [1] and column(cleared, "Clear:is_recursive") == [[True]], path
    assert "Clear:is_recursive" not in str([c.to_record_batch().schema.names for c in found["/world/agents/1"]])
    # A map that did not change is logged once, and stays.
    assert column(found["/world/map/divider"], "tick") == [0]


def test_links_lie_above_the_road_and_are_wider_by_bytes(tmp_path: Path) -> None:
    sizes = {0: 100, 1: 10_000, 2: 1_000_000}
    with RerunLog(str(tmp_path / "a.rrd")) as log:
        for index, num_bytes in sizes.items():
            log.add(replace(make_frame(index), links=(ShownLink(2, 1, num_bytes, 80.0),)))
    links = read_back(tmp_path / "a.rrd")["/world/links/2-1"]
    assert [radii[0] for radii in column(links, "LineStrips3D:radii")] == pytest.approx([0.02, 0.1, 0.3])
    assert column(links, "LineStrips3D:show_labels") == [[True]] * 3
    assert column(links, "LineStrips3D:strips")[0] == [[[11.0, 2.0, LINK_HEIGHT_M], [1.0, 2.0, LINK_HEIGHT_M]]]


def test_points_are_coloured_by_intensity_on_request_and_true_poses_are_arrows(tmp_path: Path) -> None:
    frame = make_frame()
    agent = replace(frame.agents[0], true_pose=Transform.from_xyz_yaw(1.0, 5.0, 0.0, 0.1))
    with RerunLog(str(tmp_path / "a.rrd"), cloud_color="intensity") as log:
        log.add(replace(frame, agents=(agent,)))
    found = read_back(tmp_path / "a.rrd")
    (colors,) = column(found["/world/agents/1/cloud"], "Points3D:colors")
    shades = shade_by_intensity(np.array([0.0, 0.5, 1.0, 2.0], np.float32)).astype(np.int64)
    assert colors == [(r << 24) + (g << 16) + (b << 8) + 255 for r, g, b in shades.tolist()]
    assert shades[0].sum() < shades[1].sum() < shades[2].sum() and shades[2].tolist() == shades[3].tolist()
    arrows = found["/world/pose_errors/1"]
    assert column(arrows, "Arrows3D:vectors") == [[[0.0, 3.0, 0.0]]]
    assert column(arrows, "Arrows3D:labels") == [["agent 1: 3.00 m, 5.73 deg"]]


def test_plots_have_the_colours_of_agents_and_of_kinds_of_boxes(tmp_path: Path) -> None:
    with RerunLog(str(tmp_path / "a.rrd")) as log:
        log.add(replace(make_frame(), numbers={"counts/missed": 3.0, "bytes/2": 5.0, "level": 0.0}))
    found = read_back(tmp_path / "a.rrd")
    for path, (r, g, b) in {"/plots/counts/missed": BOX_COLORS["missed"], "/plots/bytes/2": (255, 170, 60)}.items():
        assert column(found[path], "SeriesLines:colors") == [[(r << 24) + (g << 16) + (b << 8) + 255]]
    assert column(found["/plots/level"], "SeriesLines:colors") == []


@pytest.mark.parametrize(
    "target",
    ["web:", "web:0", "web:65536", "web:no", "rerun+http://127.0.0.1:1/proxy", "rerun+http:no", "rerun+http://:x"],
)
def test_a_target_that_cannot_be_is_an_error(target: str) -> None:
    with pytest.raises(ConfigError, match=r"from 1 to 65535|no viewer answers"):
        RerunLog(target)


@pytest.mark.slow
def test_the_web_viewer_serves_this_machine_alone_and_ends_with_its_log() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with RerunLog(f"web:{port}") as log:
        log.add(make_frame())
        assert isinstance(log.server, RerunServer) and log.server.page.startswith(f"http://127.0.0.1:{port}/?url=")
        with urllib.request.urlopen(log.server.page) as page:
            assert page.status == 200 and b"wasm" in page.read()
        with pytest.raises(ConfigError, match=f"Port {port} of 127.0.0.1 is taken"):
            RerunLog(f"web:{port}")
        # Another address of this machine, loopback too: nothing listens there.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), timeout=5.0)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=5.0)


def test_each_true_box_is_matched_once_and_the_others_are_errors() -> None:
    """Boxes at 5 m (twice), 20 m and truth at 5 m and 40 m: one match, two false, one missed."""
    boxes = Boxes.cat([box(5.1, 0.5), box(5.0, 0.9), box(20.0, 0.8)])
    assert mark_errors(boxes, Boxes.cat([box(5.0), box(40.0)])) == (("false", "matched", "false"), ("truth", "missed"))
    assert mark_errors(Boxes.empty(), box(5.0)) == ((), ("missed",))
    assert mark_errors(box(5.0), Boxes.empty()) == (("false",), ())
