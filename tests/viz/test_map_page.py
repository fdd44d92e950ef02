# SPDX-License-Identifier: Apache-2.0
"""The map page as text, and as headless Chromium draws it."""

import json
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from tests.viz.chromium import Browser, find_program

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.map_discrepancy import MapDiscrepancy
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.viz.map_page import (
    CHANGE_NAMES,
    Basemap,
    MapPage,
    ObservedElements,
    make_page,
    render,
    save_map_page,
    to_lonlat,
)

CONFIDENT, UNCERTAIN, MISSED, DIVIDERS = (12, 44, 132), (215, 48, 31), (255, 111, 174), (224, 123, 0)
IDS = ("a1" + "0" * 30, "a2" + "0" * 30)


def observe(time_s: int, lines: list[list[tuple[float, float]]]) -> Observation:
    view = np.array([(-120.0, -60.0), (120.0, -60.0), (120.0, 60.0), (-120.0, 60.0)])
    return Observation(
        f"agent-{time_s}",
        "1",
        time_s * 10**9,
        np.zeros(3),
        np.diag([0.1, 0.1, 1e-4]),
        view,
        MapElements.of(lines, DIVIDER),
    )


def made_page() -> MapPage:
    """Two dividers 20 m apart, the upper one with a high score, the lower one with a low one; a crossing that was not fused."""
    lines = [[(0, 10), (100, 10)], [(0, -10), (100, -10)]]
    ring = [(48, -30), (52, -30), (52, 30), (48, 30)]
    truth = MapElements.of([*lines, ring], [DIVIDER, DIVIDER, CROSSING])
    return MapPage(
        title="A <map> & its truth",
        fused=MapElements.of(lines, DIVIDER, [1.0, 0.0]),
        origin=(49.0, 8.4),
        truth=truth,
        observed=ObservedElements(truth.transform(0, 1, 0), np.array([0, 1, 1]), ["monday", "tuesday"]),
        discrepancy=MapDiscrepancy(false_negatives=[np.array([(48.0, -30.0), (48.0, 30.0)])]),
        attributes=[{"id": IDS[0], "note": "</script><b>one</b>"}, {"id": IDS[1], "note": "two"}],
        facts=[("Observations", "3")],
    )


def test_the_page_fetches_nothing() -> None:
    page = render(made_page())
    ours = page.replace(re.search(r"<script>/\*\*.*?</script>", page, re.S).group(0), "")
    assert len(page) - len(ours) > 900_000, "MapLibre is inside"
    assert not re.search(r"(src|href)=\"(?!data:)|@import|sourceMappingURL|url\((?!\"?data:)", ours)
    assert "glyphs" not in ours and "A &lt;map&gt; &amp; its truth" in page


def test_the_data_cannot_end_its_script_and_is_what_was_given() -> None:
    page = render(made_page())
    text = re.search(r'id="data">(.*?)</script>', page, re.S).group(1)
    data = json.loads(text)
    assert [len(data["layers"][n]["features"]) for n in ("truth", "observed", "fused", "disagreement")] == [3, 3, 2, 1]
    fused = data["layers"]["fused"]["features"]
    note = "</script><b>one</b>"
    assert fused[0]["properties"] == {"id": IDS[0], "note": note, "kind": "divider", "score": 1.0}
    assert [one["properties"]["n"] for one in data["layers"]["observed"]["features"]] == [0, 1, 1]
    assert data["times"] == ["monday", "tuesday"] and data["basemap"] is None
    ring = data["layers"]["truth"]["features"][2]["geometry"]["coordinates"]
    assert len(ring) == 5 and ring[0] == ring[-1]


def test_north_is_up_east_is_right_and_a_metre_is_a_metre() -> None:
    got = to_lonlat(np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]]), (49.0, 8.4))
    assert got[0] == pytest.approx([8.4, 49.0], abs=1e-12)
    assert got[1] - got[0] == pytest.approx([100 / (111_319.49 * np.cos(np.radians(49)) * 1.001909), 0], abs=2e-7)
    assert got[2] - got[0] == pytest.approx([0, 100 / 111_207], abs=2e-7)


def test_a_published_map_has_attributes_and_its_observations_are_in_the_order_of_their_times() -> None:
    lines = [[(0.0, 10.0), (100.0, 10.0)], [(0.0, -10.0), (100.0, -10.0)]]
    made = VectorMap.of(MapElements.of(lines, DIVIDER), sources=[["00" * 16], ["00" * 16, "11" * 16]], agents=[1, 2])
    late, early = observe(90, lines), observe(30, lines[:1])
    page = make_page("a map", made, observations=[late, early])
    assert page.observed is not None and page.observed.number.tolist() == [0, 1, 1]
    assert page.observed.times == ["1970-01-01 00:00:30 UTC", "1970-01-01 00:01:30 UTC"]
    assert [one["observations"] for one in page.attributes] == ["1", "2"]
    assert page.attributes[1]["id"] == made.id[1].tobytes().hex() and page.attributes[1]["kind"] == "divider"
    assert dict(page.facts)["Observations"] == "2"
    first = make_page("a map", made, observations=[late, early], max_observations=1)
    assert first.observed is not None and len(first.observed.elements) == 1
    assert dict(first.facts)["Observations"] == "1 of 2"


def test_a_basemap_is_fetched_only_where_one_is_given() -> None:
    template = "https://tiles.example.org/{z}/{x}/{y}.png"
    assert template not in render(made_page())
    assert template in render(replace(made_page(), basemap=Basemap(template, "someone's")))
    with pytest.raises(ConfigError, match=r"with \{z\}, \{x\} and \{y\}"):
        Basemap("https://tiles.example.org/{z}/{x}.png")


def test_a_map_without_anything_is_a_page(tmp_path) -> None:
    save_map_page(MapPage("empty", MapElements.empty(), (0.0, 0.0)), tmp_path / "new" / "map.html")
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["map.html"]


def count(pixels: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((np.abs(pixels - colour).max(-1) < 12).sum())


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = find_program()
    if program is None:
        pytest.skip("no Chromium is installed: the page was checked as text only")
    made = Browser(program, str(tmp_path_factory.mktemp("profile")))
    yield made
    made.close()


@pytest.fixture
def opened(browser, tmp_path):
    """The page, drawn; everything outside the panel's column is map."""
    save_map_page(made_page(), tmp_path / "map.html")
    browser.open((tmp_path / "map.html").as_uri())
    assert browser.value("document.body.dataset.error") is None
    return browser


def see(browser) -> np.ndarray:
    time.sleep(1.0)
    return browser.photograph()[:, 300:]


def project(browser, x: float, y: float) -> tuple[float, float]:
    """Return where a place of the map's frame lies in the window."""
    lon, lat = to_lonlat(np.array([[x, y]]), made_page().origin)[0]
    point = browser.value(f"(() => {{ const p = map.project([{lon}, {lat}]); return [p.x, p.y]; }})()")
    return point[0], point[1]


def click(browser, x: float, y: float) -> None:
    place = project(browser, x, y)
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        browser.mouse(kind, *place, button="none" if kind == "mouseMoved" else "left", clickCount=1)
    time.sleep(0.4)


POPUP = "[...document.querySelectorAll('.maplibregl-popup-content')].map((one) => one.innerText).join()"


def test_chromium_draws_the_layers_where_they_belong_and_toggles_them(opened) -> None:
    assert int(opened.value("document.body.dataset.ready")) >= 2
    pixels = opened.photograph()[:, 300:]
    assert count(pixels, CONFIDENT) > 500 and count(pixels, UNCERTAIN) > 500 and count(pixels, MISSED) == 0
    rows = {colour: np.argwhere(np.abs(pixels - colour).max(-1) < 12)[:, 0].mean() for colour in (CONFIDENT, UNCERTAIN)}
    assert rows[CONFIDENT] < rows[UNCERTAIN], "north is up"
    opened.value("document.querySelector('input[name=fused]').click()")
    opened.value("document.querySelector('input[name=disagreement]').click()")
    pixels = see(opened)
    assert count(pixels, CONFIDENT) == 0 and count(pixels, MISSED) > 200
    opened.value("document.querySelector('input[name=false_negatives]').click()")
    assert count(see(opened), MISSED) == 0
    assert (
        opened.value("performance.getEntriesByType('resource').filter((e) => !/^(blob|data):/.test(e.name)).length")
        == 0
    )


def test_a_click_on_a_line_opens_its_popup_as_text_and_one_beside_it_opens_none(opened) -> None:
    click(opened, 20.0, 0.0)
    assert opened.value(POPUP) == ""
    click(opened, 20.0, 10.0)
    shown = opened.value(POPUP)
    assert "Fused map: divider" in shown and IDS[0] in shown and "</script><b>one</b>" in shown
    assert opened.value("map.getFeatureState({source: 'fused', id: 0}).hovered") is True
    click(opened, 20.0, -10.0)
    assert IDS[1] in opened.value(POPUP) and IDS[0] not in opened.value(POPUP)


def test_kinds_are_filtered_and_colour_the_map(opened) -> None:
    opened.value("document.querySelector('input[name=truth]').click()")
    choice = "const choice = document.getElementById('colour'); choice.value = 'kind'; choice.dispatchEvent(new Event('change'))"
    opened.value(f"(() => {{ {choice} }})()")
    pixels = see(opened)
    assert count(pixels, DIVIDERS) > 500 and count(pixels, CONFIDENT) == 0
    opened.value("document.querySelector('input[name=divider]').click()")
    assert count(see(opened), DIVIDERS) == 0


def test_an_id_is_searched(opened) -> None:
    ask = "(() => {{ const box = document.getElementById('search'); box.value = '{}'; box.dispatchEvent(new Event('change')); }})()"
    opened.value(ask.format("A2"))
    time.sleep(0.4)
    assert IDS[1] in opened.value(POPUP) and opened.value("document.getElementById('message').innerText") == ""
    opened.value(ask.format("a"))
    assert "first of 2" in opened.value("document.getElementById('message').innerText")
    opened.value(ask.format("ffff"))
    assert "No published element" in opened.value("document.getElementById('message').innerText")


def test_distances_are_measured_and_escape_ends_it(opened) -> None:
    opened.value("document.getElementById('measure').click()")
    for place in ((0.0, 10.0), (60.0, 10.0), (60.0, -10.0)):
        click(opened, *place)
    assert opened.value(POPUP) == ""
    shown = opened.value("document.getElementById('distance').innerText")
    assert float(shown.removesuffix(" m")) == pytest.approx(80.0, abs=1.0)
    opened.value("document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    assert opened.value("document.getElementById('distance').innerText") == ""


def test_the_slider_draws_observations_up_to_a_time(opened) -> None:
    slide = "(() => {{ const box = document.getElementById('until'); box.value = {}; box.dispatchEvent(new Event('input')); }})()"
    drawn = "map.queryRenderedFeatures({layers: ['observed']}).length"
    opened.value(slide.format(0))
    time.sleep(1.0)
    assert opened.value("document.querySelector('#time output').innerText").endswith("1 to 1 of 2, until monday")
    few = opened.value(drawn)
    opened.value(slide.format(1))
    time.sleep(1.0)
    assert 0 < few < opened.value(drawn)


def test_on_a_phone_the_controls_are_folded_and_nothing_is_wider_than_the_window(browser, tmp_path) -> None:
    save_map_page(replace(made_page(), names=CHANGE_NAMES), tmp_path / "map.html")
    try:
        browser.resize(390, 844)
        browser.open((tmp_path / "map.html").as_uri())
        browser.resize(390, 844)
        browser.value("location.reload()")
        time.sleep(1.5)
        assert browser.value("document.getElementById('controls').open") is False
        assert browser.value("document.documentElement.scrollWidth") == 390
        browser.value("document.querySelector('summary').click()")
        assert "New map (2)" in browser.value("document.getElementById('layers').innerText")
        assert "gone (1)" in browser.value("document.getElementById('disagreements').innerText")
    finally:
        browser.resize(1000, 700)
