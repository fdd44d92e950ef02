# SPDX-License-Identifier: Apache-2.0
"""The report as headless Chromium shows it: player, tabs, slider, hover, phone width, dark and light."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.viz.chromium import Browser, find_program
from tests.viz.test_scene_player import make_player

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Comparison
from manyeyes.viz.report import HtmlReport, save_report
from manyeyes.viz.table import MethodRow

FOUND, MISSED, FALSE_ALARM = (27, 138, 58), (194, 94, 0), (211, 47, 47)
WIDE, NARROW = (1280, 900), (390, 844)
AHEAD_LEFT, BEHIND, AHEAD_RIGHT = (12.0, 6.0), (-15.0, 0.0), (20.0, -10.0)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser with the report of two methods over three frames."""
    program = find_program()
    if program is None:
        pytest.skip("no Chromium is installed: the report was checked as text only")
    folder = tmp_path_factory.mktemp("report")
    exact = [Interval(value, value, value, 0.95, 1) for value in (0.5, 1.0)]
    rows = (
        MethodRow("no-fusion", exact[0], exact[0], 0.0, None, None, 70.0),
        MethodRow("late", exact[1], exact[1], 2048.0, 100.0, 50.0, 60.0),
    )
    save_report(HtmlReport("A drive", "Two methods.", rows, player=make_player(), shown="late"), folder / "r.html")
    browser = Browser(program, str(folder / "profile"))
    browser.open((folder / "r.html").as_uri())
    yield browser
    browser.close()


@pytest.fixture(autouse=True)
def reset(page: Browser) -> None:
    page.resize(*WIDE)
    page.mouse("mouseMoved", 1, 1)
    page.value("play(false); state.score = null; state.frame = 1; byId('frame').value = 1; state.speed = 1; select(0)")


def choose(page: Browser, tab: str) -> None:
    page.value(f"[...document.querySelectorAll('#tabs button')].find((b) => b.textContent === '{tab}').click()")


def counts(page: Browser) -> tuple[int, int, int]:
    """Found, missed and false."""
    return tuple(int(page.value(f"byId('n-{name}').textContent")) for name in ("found", "missed", "false"))


def place(page: Browser, at: tuple[float, float], narrow: bool = False) -> tuple[float, float]:
    """Return where a place in metres stands in the window: ahead is right, or up on a phone."""
    page.value("byId('view').scrollIntoView({block: 'center'})")
    left, top, width, height = page.value(
        "(({x, y, width, height}) => [x, y, width, height])(byId('view').getBoundingClientRect())"
    )
    scale = (width - 2) / (44.0 if narrow else 84.0)
    right, up = (-at[1], at[0]) if narrow else at
    return left + width / 2 + right * scale, top + height / 2 - up * scale


def has(page: Browser, at: tuple[float, float], colour: tuple[int, int, int], narrow: bool = False) -> bool:
    """Whether about this colour is drawn within the length of a car of a place."""
    column, row = place(page, at, narrow)
    pixels, reach = page.photograph(), 12 if narrow else 34
    part = pixels[max(0, int(row) - reach) : int(row) + reach, max(0, int(column) - reach) : int(column) + reach]
    return int((np.abs(part - colour).max(-1) < 40).sum()) >= 8


def test_the_page_fetches_nothing(page: Browser) -> None:
    fetched = "performance.getEntriesByType('resource').filter((e) => !/^(blob|data):/.test(e.name)).length"
    assert page.value(fetched) == 0 and page.value("document.body.dataset.ready") == "3"


def test_tabs_mark_misses_and_false_alarms_over_the_same_view(page: Browser) -> None:
    assert counts(page) == (1, 1, 1)
    assert has(page, AHEAD_LEFT, MISSED) and has(page, BEHIND, FOUND) and has(page, AHEAD_RIGHT, FALSE_ALARM)
    assert not has(page, (12.0, -6.0), MISSED), "the scene is not mirrored"
    frame = page.value("state.frame")
    choose(page, "late")
    assert counts(page) == (2, 0, 0) and page.value("state.frame") == frame
    assert (
        has(page, AHEAD_LEFT, FOUND) and not has(page, AHEAD_LEFT, MISSED) and not has(page, AHEAD_RIGHT, FALSE_ALARM)
    )
    assert page.value("document.querySelector('#tabs [aria-selected=true]').textContent") == "late"


def test_the_score_slider_hides_boxes_of_lower_score(page: Browser) -> None:
    def slide(percent: int) -> None:
        page.value(f"byId('score').value = {percent}; byId('score').dispatchEvent(new Event('input'))")

    slide(50)
    assert counts(page) == (1, 1, 0) and not has(page, AHEAD_RIGHT, FALSE_ALARM)
    slide(82)
    assert counts(page) == (0, 2, 0) and has(page, BEHIND, MISSED)
    choose(page, "late")
    assert counts(page) == (2, 0, 0)
    slide(87)
    assert counts(page) == (1, 1, 0) and "50 % of vehicles" in page.value("byId('drive').textContent")
    page.value("byId('score-reset').click()")
    assert counts(page) == (2, 0, 0) and page.value("byId('score-out').textContent") == "0.40"


def test_the_player_plays_steps_and_changes_its_speed(page: Browser) -> None:
    page.value("byId('forward').click()")
    assert page.value("byId('frame-out').textContent") == "3 of 3" and "Frame 12" in page.value(
        "byId('moment').textContent"
    )
    page.value("byId('back').click(); byId('back').click()")
    assert page.value("state.frame") == 0
    page.value("byId('speed').value = '4'; byId('speed').dispatchEvent(new Event('change'))")
    page.value(
        "window.steps = 0; const before = step; step = (by) => { window.steps += 1; before(by); }; byId('play').click()"
    )
    assert page.value("byId('play').textContent") == "Pause"
    end = time.monotonic() + 20
    while page.value("window.steps") < 4:
        assert time.monotonic() < end, "the player stands still"
        time.sleep(0.05)
    page.value("byId('play').click()")
    assert page.value("byId('play').textContent") == "Play"
    count = page.value("window.steps")
    time.sleep(0.3)
    assert page.value("window.steps") == count


def test_hover_shows_score_sender_and_points(page: Browser) -> None:
    def hover(at: tuple[float, float]) -> str:
        page.mouse("mouseMoved", *place(page, at))
        return page.value("byId('tip').hidden ? '' : byId('tip').innerText")

    assert "Missed vehicle" in hover(AHEAD_LEFT) and "pole 7 40 (not fused)" in hover(AHEAD_LEFT)
    assert "Score 0.30, false alarm" in hover(AHEAD_RIGHT)
    assert hover((0.0, -15.0)) == ""
    choose(page, "late")
    words = hover(AHEAD_LEFT)
    assert "Score 0.90, found" in words and "most returns from pole 7" in words and "Points: ego 0, pole 7 40" in words


def test_a_vehicle_missed_alone_is_joined_to_its_sender(page: Browser) -> None:
    def count_between() -> int:
        """Count blue pixels, as of the pole, halfway from the pole, 20 m ahead and 10 m to the left, to the vehicle."""
        column, row = place(page, (16.0, 8.0))
        part = page.photograph()[int(row) - 6 : int(row) + 6, int(column) - 6 : int(column) + 6]
        return int((part[..., 2] - part[..., 0] > 30).sum())

    assert count_between() == 0
    choose(page, "late")
    assert count_between() >= 2


@pytest.mark.parametrize("is_dark", [False, True])
def test_a_phone_shows_everything_upright_and_nothing_is_cut_off(page: Browser, is_dark: bool) -> None:
    page.resize(*NARROW, is_dark)
    assert page.value("document.documentElement.scrollWidth") == 390
    cut = "[...document.querySelectorAll('button, li, label, h1, h2, h3, p, .stage-row span, output')]"
    cut += ".filter((e) => e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline').map((e) => e.outerHTML)"
    assert page.value(cut) == []
    background = page.photograph()[5, 5]
    assert (background < 60).all() if is_dark else (background > 240).all()
    if not is_dark:
        assert has(page, AHEAD_LEFT, MISSED, narrow=True) and has(page, AHEAD_RIGHT, FALSE_ALARM, narrow=True)
        assert not has(page, (12.0, -6.0), MISSED, narrow=True)


def test_plots_have_a_mark_for_each_method(page: Browser) -> None:
    page.value("byId('plot-bytes').scrollIntoView({block: 'center'})")
    count = "(() => { const c = byId('plot-bytes'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;"
    count += "for (let i = 0; i < d.length; i += 4) if (Math.abs(d[i] - R) + Math.abs(d[i + 1] - G) + Math.abs(d[i + 2] - B) < 12"
    count += " && d[i + 3] > 200) n++; return n; })()"
    for colour in ((120, 144, 156), (199, 119, 0)):
        expression = count.replace("R)", f"{colour[0]})").replace("G)", f"{colour[1]})").replace("B)", f"{colour[2]})")
        assert page.value(expression) > 40
    assert page.value("[...document.querySelectorAll('#stages .stage-row')].map((r) => r.lastChild.textContent)") == [
        "70 ms",
        "114 ms",
    ]


def test_columns_are_explained_in_their_headings(page: Browser) -> None:
    heads = page.value(
        "[...document.querySelectorAll('th')].map((h) => [h.firstChild.textContent, !!h.querySelector('small')])"
    )
    assert {"AP@0.5", "bytes/message", "share [ms]"} <= {name for name, _ in heads}
    assert [name for name, is_explained in heads if not is_explained] == ["method"]


def test_a_page_without_a_player_shows_its_plots(page: Browser, tmp_path: Path) -> None:
    unknown = Interval(math.nan, math.nan, math.nan, 0.95, 5)
    rows = (
        MethodRow("late", Interval(0.8, 0.7, 0.9, 0.95, 5), None, 2048.0, None, None, None),
        MethodRow("early", unknown, unknown, 2048.0, math.nan, math.nan, math.nan),
    )
    save_report(HtmlReport("A split", "One method.", rows), tmp_path / "plain.html")
    first = page.session
    page.open((tmp_path / "plain.html").as_uri())
    assert page.value("document.body.dataset.ready") == "0" and page.value("byId('plot-bytes').width") > 100
    assert page.value("held.methods.map((m) => [m.ap, m.interval])") == [[0.8, [0.7, 0.9]], [None, None]]
    assert page.value("!byId('plot-forest')")
    page.session = first


def test_names_of_neighbouring_points_are_whole_and_cover_neither_points_nor_names(
    page: Browser, tmp_path: Path
) -> None:
    values = {
        "no-fusion-temporal": (0.592, 0.0),
        "late-temporal": (0.975, 1819.0),
        "intermediate-temporal": (0.988, 2509.0),
        "early-temporal": (0.976, 95661.0),
    }
    rows = tuple(
        MethodRow(name, Interval(ap, math.nan, math.nan, 0.95, 1), None, num_bytes, None, None, None)
        for name, (ap, num_bytes) in values.items()
    )
    save_report(HtmlReport("A split", "Neighbours.", rows), tmp_path / "names.html")
    first = page.session
    page.open((tmp_path / "names.html").as_uri())
    drawn = page.value(
        "(() => { const drawn = [], names = held.methods.map((m) => m.label), kind = CanvasRenderingContext2D.prototype;"
        "const { fillText, arc } = kind; kind.fillText = function (text, x, y) { if (names.includes(text)) {"
        "const width = this.measureText(text).width, left = this.textAlign === 'right' ? x - width : x;"
        "drawn.push([left, y - 9, left + width, y + 1]); } };"
        "kind.arc = function (x, y, r) { drawn.push([x - r, y - r, x + r, y + r]); };"
        "drawBytes(); Object.assign(kind, { fillText, arc }); return drawn; })()"
    )
    page.session = first
    assert len(drawn) == 2 * len(values)
    assert min(top for _, top, _, _ in drawn) >= 0
    for number, one in enumerate(drawn):
        for other in drawn[number + 1 :]:
            is_point = [box[2] - box[0] == 10.0 for box in (one, other)]
            apart = one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
            assert apart or all(is_point), (one, other)


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_differences_are_drawn_with_their_intervals_filled_where_resolved(
    page: Browser, tmp_path: Path, size: tuple[int, int]
) -> None:
    rows = tuple(
        MethodRow(method, Interval(ap, ap - 0.05, ap + 0.05, 0.95, 5), None, 2048.0, None, None, None, name)
        for method, ap in (("late", 0.6), ("early", 0.8))
        for name in ("vehicle", "pedestrian")
    )
    differences = (
        Comparison("early - late, vehicle", "AP@0.5", Interval(0.2, 0.1, 0.3, 0.95, 5)),
        Comparison("early - late, pedestrian", "AP@0.5", Interval(0.0, -0.1, 0.1, 0.95, 5)),
        Comparison("early - late, one scenario", "AP@0.5", Interval(0.1, 0.1, 0.1, 0.95, 1)),
    )
    save_report(HtmlReport("A split", "Two classes.", rows, differences), tmp_path / "forest.html")
    first = page.session
    page.open((tmp_path / "forest.html").as_uri())
    page.resize(*size)
    assert page.value("held.methods.map((m) => m.label)") == [
        "late, vehicle",
        "late, pedestrian",
        "early, vehicle",
        "early, pedestrian",
    ]
    assert page.value("held.differences.map((d) => d.value)") == [0.2, 0.0]
    page.value("byId('plot-forest').scrollIntoView({block: 'center'})")
    # Blue in the middle of the point of the resolved difference, paper in that of the other.
    middle = (
        "(() => { const c = byId('plot-forest'), pen = c.getContext('2d'), k = c.width / c.clientWidth; const out = [];"
    )
    middle += (
        "for (const [x, y] of forestPoints) out.push([...pen.getImageData(x * k, y * k, 1, 1).data]); return out; })()"
    )
    resolved, open_ = page.value(middle)
    assert resolved[:3] == [21, 101, 192] and open_[:3] == [255, 255, 255]
    (x0, _), (x1, _) = page.value("forestPoints")
    assert x1 < x0 < page.value("byId('plot-forest').clientWidth")
    page.session = first
