# SPDX-License-Identifier: Apache-2.0
"""The map page as text, and as headless Chromium draws it."""

import json
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from tests.viz.chromium import Browser, find_program

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.map_discrepancy import MapDiscrepancy
from manyeyes.viz.map_page import CHANGE_NAMES, MapPage, render, save_map_page, to_lonlat

CONFIDENT, UNCERTAIN, MISSED = (12, 44, 132), (215, 48, 31), (243, 132, 186)


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
        observed=truth.transform(0, 1, 0),
        discrepancy=MapDiscrepancy(false_negatives=[np.array([(48.0, -30.0), (48.0, 30.0)])]),
        descriptions=["</script><b>one</b>", "two"],
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
    assert fused[0]["properties"] == {"kind": "divider", "score": 1.0, "about": "</script><b>one</b>"}
    ring = data["layers"]["truth"]["features"][2]["geometry"]["coordinates"]
    assert len(ring) == 5 and ring[0] == ring[-1]


def test_north_is_up_east_is_right_and_a_metre_is_a_metre() -> None:
    got = to_lonlat(np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]]), (49.0, 8.4))
    assert got[0] == pytest.approx([8.4, 49.0], abs=1e-12)
    assert got[1] - got[0] == pytest.approx([100 / (111_319.49 * np.cos(np.radians(49)) * 1.001909), 0], abs=2e-7)
    assert got[2] - got[0] == pytest.approx([0, 100 / 111_207], abs=2e-7)


@pytest.mark.parametrize(
    ("changes", "headings"),
    [
        ({}, ["Confidence of fused elements", "Truth and observations", "Disagreement"]),
        ({"truth": None, "discrepancy": MapDiscrepancy()}, ["Confidence of fused elements", "Observations"]),
        ({"truth": None, "observed": None, "discrepancy": MapDiscrepancy()}, ["Confidence of fused elements"]),
        (
            {"observed": None, "names": CHANGE_NAMES},
            ["Confidence of fused elements", "Old map", "Changes"],
        ),
    ],
)
def test_the_legend_explains_what_the_page_holds(changes, headings) -> None:
    page = render(replace(made_page(), **changes))
    legend = page[page.index('<div class="legend">') : page.index('<script type="application/json"')]
    assert re.findall("<b>(.*?)</b>", legend) == headings
    names = re.findall("</i>(.*?)</span>", legend)
    kinds = ["divider", "boundary", "crossing", "stop line"] if len(headings) > 1 else []
    disagreements = {"Disagreement": ["false negatives"], "Changes": ["gone"]}.get(headings[-1], [])
    assert names == kinds + disagreements


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


def test_chromium_draws_the_layers_where_they_belong_and_toggles_them(browser, tmp_path) -> None:
    save_map_page(made_page(), tmp_path / "map.html")
    browser.open((tmp_path / "map.html").as_uri())
    assert browser.value("document.body.dataset.error") is None
    assert int(browser.value("document.body.dataset.ready")) >= 2
    pixels = browser.photograph()[:, 300:]
    assert count(pixels, CONFIDENT) > 500 and count(pixels, UNCERTAIN) > 500 and count(pixels, MISSED) == 0
    rows = {colour: np.argwhere(np.abs(pixels - colour).max(-1) < 12)[:, 0].mean() for colour in (CONFIDENT, UNCERTAIN)}
    assert rows[CONFIDENT] < rows[UNCERTAIN], "north is up"
    browser.value("document.querySelector('input[name=fused]').click()")
    browser.value("document.querySelector('input[name=disagreement]').click()")
    time.sleep(1.5)
    pixels = browser.photograph()[:, 300:]
    assert count(pixels, CONFIDENT) == 0 and count(pixels, MISSED) > 200
    assert (
        browser.value("performance.getEntriesByType('resource').filter((e) => !/^(blob|data):/.test(e.name)).length")
        == 0
    )
