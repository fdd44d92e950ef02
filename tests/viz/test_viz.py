# SPDX-License-Identifier: Apache-2.0
"""A hand-made scene, drawn, and its pixels read back."""

import math
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, ConfigError, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.viz import birds_eye
from manyeyes.viz.animation import save_animation, stack_images
from manyeyes.viz.birds_eye import (
    AGENT_COLOURS,
    FOUND,
    TRUE,
    draw_scene,
    make_scene,
    make_viewport,
    place_legend,
    save_png,
)
from manyeyes.viz.canvas import Viewport, draw_points
from manyeyes.viz.report import HtmlReport, ReportImage, render, save_report
from manyeyes.viz.table import HEADINGS, MethodRow, format_cells, format_markdown, make_terminal_table

GRID = BevGrid(-40.0, -20.0, -3.0, 40.0, 20.0, 1.0)


def box(x: float, y: float, yaw: float = 0.0, score: float = 1.0) -> Boxes:
    return Boxes.of(
        torch.tensor([[x, y, 0.8]], dtype=torch.float64),
        torch.tensor([[4.6, 1.9, 1.6]], dtype=torch.float64),
        torch.tensor([yaw], dtype=torch.float64),
        torch.tensor([score], dtype=torch.float64),
    )


def snapshot(ego_points: torch.Tensor | None = None) -> Snapshot:
    """Two agents: the ego at (100, 50) heading north, a pole 20 m ahead of it and 10 m to its left, looking back at it.

    The only true box stands 12 m ahead of the ego and 6 m to its left, heading as the ego does.
    """
    poses = [Transform.from_xyz_yaw(100, 50, 0, math.pi / 2), Transform.from_xyz_yaw(90, 70, 0, -math.pi / 2)]
    far = torch.tensor([[500.0, 500.0, 1.0]])
    clouds = [
        PointCloud.of(far if ego_points is None else ego_points),
        PointCloud.of(torch.tensor([[3.0, 2.0, 1.0]] * 4)),
    ]
    frames = tuple(
        AgentFrame(i, 0, cloud, pose, torch.zeros(3, 3), is_infrastructure=i == 1)
        for i, (cloud, pose) in enumerate(zip(clouds, poses))
    )
    truth = GroundTruth(box(94, 62, math.pi / 2), torch.tensor([[False], [True]]), Transform.stack(poses))
    return Snapshot("made", 0, frames, truth)


def near(
    image: Image.Image, x: float, y: float, colour: tuple[int, int, int], radius: int = 2, width: int = 1280
) -> bool:
    """Whether a pixel of about this colour lies within radius pixels of the metric place."""
    column, row = make_viewport(GRID, width).to_pixels(np.array([x, y]))
    pixels = np.asarray(image)[
        int(row) - radius : int(row) + radius + 1, int(column) - radius : int(column) + radius + 1
    ]
    return bool((np.abs(pixels.astype(int) - colour).sum(-1) < 60).any())


def test_a_true_box_is_drawn_at_its_position_and_not_mirrored() -> None:
    image = draw_scene(make_scene(snapshot(), Boxes.empty()), GRID)
    for x, y in ((12 + 2.3, 6), (12 - 2.3, 6), (12, 6 + 0.95), (12, 6 - 0.95)):
        assert near(image, x, y, TRUE)
    for x, y in ((12 + 2.3, -6), (-12 - 2.3, 6), (6, 12), (12, 6)):
        assert not near(image, x, y, TRUE)


def test_the_legend_begins_a_new_line_where_the_picture_ends() -> None:
    assert place_legend([100.0, 50.0, 80.0], 240.0) == [(0, 0.0), (0, 119.0), (1, 0.0)]
    assert place_legend([100.0, 50.0], 170.0) == [(0, 0.0), (0, 119.0)] and place_legend([500.0], 100.0) == [(0, 0.0)]


@pytest.mark.parametrize("width", [560, 640, 1280])
def test_neither_legend_nor_names_of_agents_are_cut_off(width: int) -> None:
    one = snapshot().frames[0]
    low = one.world_from_agent @ Transform.from_xyz_yaw(5.0, GRID.y_min - 3.5, 0.0, 0.0)
    frames = (one, *(replace(one, agent_id=700 + i, world_from_agent=low) for i in range(5)))
    image = np.asarray(draw_scene(make_scene(Snapshot("made", 0, frames), box(5, 5)), GRID, width=width)).astype(int)
    footer = image[-birds_eye.FOOTER_HEIGHT :]
    assert (footer[:, -8:] == 255).all() and (footer[:3] == 255).all() and (footer[-3:] == 255).all()
    for colour in AGENT_COLOURS:
        assert (np.abs(footer - colour).sum(-1) < 60).any(), "an agent is missing in the legend"
    column, row = make_viewport(GRID, width).to_pixels(np.array([5.0, GRID.y_min - 3.5]))
    above = image[int(row) - 27 : int(row) - 12, int(column) - 30 : int(column) + 30]
    assert (np.abs(above - AGENT_COLOURS[5]).sum(-1) < 60).any(), "the name of an agent at the bottom is not above it"


def test_left_of_the_ego_is_up_and_ahead_is_right() -> None:
    view = Viewport(-10, -5, 10, 5, width=200, top_margin=30, bottom_margin=10)
    assert view.size == (200, 140)
    assert view.to_pixels(np.array([[-10.0, 5.0], [10.0, -5.0], [0.0, 0.0]])).tolist() == [
        [0, 30],
        [200, 130],
        [100, 80],
    ]


def test_a_detection_is_red_and_its_tick_points_ahead() -> None:
    scene = make_scene(snapshot(), box(-15, -8, math.pi / 2, 0.7))
    image = draw_scene(scene, GRID)
    assert near(image, -15, -8 + 2.3, FOUND) and near(image, -15, -8 + 2.9, FOUND)
    assert not near(image, -15, -8 - 2.9, FOUND)


def test_detections_below_the_score_are_left_out() -> None:
    scene = make_scene(snapshot(), box(-15, -8, 0.0, 0.3))
    assert near(draw_scene(scene, GRID), -15 + 2.3, -8, FOUND)
    assert not near(draw_scene(scene, GRID, min_score=0.5), -15 + 2.3, -8, FOUND)


def test_points_of_another_agent_are_moved_by_its_pose_and_have_its_colour() -> None:
    # The pole looks back: 3 m ahead of it is 17 m ahead of the ego, 2 m to its left is 8 m to the ego's left.
    image = draw_scene(make_scene(snapshot(), Boxes.empty()), GRID)
    assert near(image, 17, 8, AGENT_COLOURS[1])
    assert not near(image, 23, 8, AGENT_COLOURS[1]) and not near(image, 17, 12, AGENT_COLOURS[1])


def test_points_of_agents_without_message_are_pale() -> None:
    image = draw_scene(make_scene(snapshot(), Boxes.empty(), missing_ids=[0, 1]), GRID)
    assert not near(image, 17, 8, AGENT_COLOURS[1])
    column, row = make_viewport(GRID, 1280).to_pixels(np.array([17.0, 8.0]))
    assert 255 > np.asarray(image)[int(row), int(column)].min() > AGENT_COLOURS[1][0], "pale, but there"


def test_a_box_without_returns_is_not_drawn_as_visible() -> None:
    one = snapshot()
    assert one.truth is not None
    hidden = GroundTruth(one.truth.boxes, torch.zeros(2, 1, dtype=torch.bool), one.truth.world_from_agent)
    image = draw_scene(make_scene(Snapshot("made", 0, one.frames, hidden), Boxes.empty()), GRID)
    assert not near(image, 12 + 2.3, 6, TRUE)


def test_a_recording_without_truth_is_drawn_too() -> None:
    one = snapshot()
    assert draw_scene(make_scene(Snapshot("made", 0, one.frames), box(5, 5)), GRID).size == make_viewport(GRID).size


def test_ink_of_two_agents_mixes_in_one_pixel_and_margins_stay_clean() -> None:
    view = Viewport(0, 0, 10, 10, width=10, top_margin=2, bottom_margin=2)
    at, heavy = np.array([[4.5, 4.5]]), np.array([9.0])
    image = draw_points(view, [(at, heavy, (200, 0, 0)), (at, heavy, (0, 0, 100))], (255, 255, 255))
    assert image[2 + 5, 4].tolist() == [100, 0, 50]
    above = draw_points(view, [(np.array([[4.5, 11.0], [4.5, -1.0]]), np.ones(2), (0, 0, 0))], (255, 255, 255))
    assert (above == 255).all()


def test_a_png_is_written_whole_and_leaves_no_temporary_file(tmp_path) -> None:
    path = tmp_path / "new" / "frame.png"
    save_png(draw_scene(make_scene(snapshot(), Boxes.empty()), GRID, "Title", "caption", width=640), path)
    with Image.open(path) as image:
        assert image.size == make_viewport(GRID, 640).size
    assert [p.name for p in path.parent.iterdir()] == ["frame.png"]


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_an_animation_has_every_frame_and_repeats(tmp_path, suffix) -> None:
    images = [draw_scene(make_scene(snapshot(), box(x, 0)), GRID, width=320) for x in (-10, 0, 10)]
    path = tmp_path / f"drive{suffix}"
    assert save_animation((stack_images([i, i]) for i in images), path, 150) == 3
    with Image.open(path) as film:
        assert film.n_frames == 3 and film.info["loop"] == 0
        assert film.size == (320, 2 * images[0].height)
        seconds = []
        for k in range(3):
            film.seek(k)
            film.load()
            seconds.append(film.info["duration"])
        assert seconds == [150] * 3
        assert near(film.convert("RGB"), 10 + 2.3, 0, FOUND, width=320)


def test_an_animation_of_nothing_or_of_another_format_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"one of \.gif, \.webp; got drive.mp4"):
        save_animation([], tmp_path / "drive.mp4")
    with pytest.raises(ConfigError, match="at least one picture"):
        save_animation([], tmp_path / "drive.gif")
    assert list(tmp_path.iterdir()) == []


def interval(value: float, low: float = math.nan, high: float = math.nan) -> Interval:
    return Interval(value, low, high, 0.95, 1 if math.isnan(low) else 8)


ROWS = (
    MethodRow("none", interval(0.612, 0.55, 0.66), interval(0.4), 0.0, None, None, 41.0),
    MethodRow("intermediate", interval(0.812, 0.75, 0.86), interval(0.66), 2.0**15, 104.2, 45.0, 53.0),
    MethodRow("early"),
)


def test_a_row_is_formatted_and_unmeasured_values_read_not_run() -> None:
    assert format_cells(ROWS[0]) == ("none", "0.612 [0.550, 0.660]", "0.400", "0", "-", "-", "-", "41.0")
    assert format_cells(ROWS[1])[3:6] == ("32,768", "15.00", "104")
    assert format_cells(ROWS[2]) == ("early", *["not run"] * 7)
    assert format_cells(MethodRow("x", interval(math.nan)))[1] == "no object"


def test_the_markdown_table_is_aligned_and_complete() -> None:
    lines = format_markdown(ROWS).splitlines()
    assert len({len(line) for line in lines}) == 1 and len(lines) == 5
    assert all(line.count("|") == len(HEADINGS) + 1 for line in lines)


def test_the_terminal_table_fits_80_columns() -> None:
    from rich.console import Console

    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    console.print(make_terminal_table(ROWS, "title"))
    text = console.export_text()
    assert (
        "…" not in text
        and "0.750-0.860" in text
        and "(bytes)" in text
        and "[ms]" in text
        and "32,768" in text
        and "perceive" in text
    )


def make_report(tmp_path) -> HtmlReport:
    picture = tmp_path / "one.png"
    save_png(draw_scene(make_scene(snapshot(), box(5, 5)), GRID, width=640), picture)
    return HtmlReport(
        "A <drive>",
        "Two agents & a box.",
        ROWS,
        (),
        (
            ReportImage(picture, "all of it", wide=True),
            ReportImage(picture, "intermediate"),
            ReportImage(picture, "late"),
        ),
        (("Frames", "3"),),
        ("make demo",),
        provenance={"seed": 7},
    )


def test_the_report_is_one_file_that_fetches_nothing(tmp_path) -> None:
    page = render(make_report(tmp_path))
    page_without_pictures = re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)
    assert not re.search(
        r"https?://|src=\"(?!data:)|href=\"(?!data:)|@import|url\(|fetch\(|import\(", page_without_pictures
    )
    assert page.count("data:image/png;base64,") == 3 and "<img" in page
    assert "A &lt;drive&gt;" in page and "<drive>" not in page and "Two agents &amp; a box." in page
    assert "32,768" in page and page.count("not run") >= 7 and "&quot;seed&quot;: 7" in page


def test_a_picture_that_a_browser_cannot_show_is_refused(tmp_path) -> None:
    (tmp_path / "cloud.pcd").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"cloud.pcd: a report embeds \.png"):
        render(HtmlReport("t", "l", pictures=(ReportImage(tmp_path / "cloud.pcd", "c"),)))


def test_the_report_renders_in_a_browser(tmp_path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed: the page was checked as text only")
    path, shot = tmp_path / "report.html", tmp_path / "shot.png"
    save_report(make_report(tmp_path), path)
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1280,2400"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}", path.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    assert pixels.shape[:2] == (2400, 1280)
    assert (np.abs(pixels - birds_eye.FOUND).sum(-1) < 60).sum() > 20, "the picture is not on the page"
    assert (pixels[:200].sum(-1) < 300).sum() > 500, "the heading is not on the page"


def test_drawing_without_pillow_names_the_extra(monkeypatch) -> None:
    import sys

    from manyeyes.datatypes import MissingExtraError
    from manyeyes.viz.canvas import import_pillow

    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'manyeyes\[view\]'"):
        import_pillow()


def test_a_wide_table_folds_headings_and_never_numbers() -> None:
    from rich.console import Console

    from manyeyes.viz.table import make_table

    headings = ("method", "AP crossing", "AP divider", "fragmentation", "endpoint error [m]", *["duplication"] * 5)
    lines = [("global-map-builder", *(f"0.{n}23" for n in range(1, 10)))]
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    console.print(make_table("", headings, lines))
    text = console.export_text()
    assert "…" not in text and list(lines[0]) == text.splitlines()[-1].split()


def test_a_table_wider_than_the_terminal_continues_below() -> None:
    from rich.console import Console

    from manyeyes.viz.table import make_table

    headings, numbers = ("method", *["duplication"] * 14), [f"0.{n:02}345" for n in range(14)]
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    console.print(make_table("", headings, [("global-map-builder", *numbers)]))
    rows = [line.split() for line in console.export_text().splitlines() if "global-map-builder" in line]
    assert len(rows) > 1 and [number for row in rows for number in row[1:]] == numbers
