# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("matplotlib", reason="the 'view' extra is not installed")

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.viz.map_figures import ARROW_COLOUR, MapPanel, compute_misalignment, save_figure
from manyeyes.viz.report import Chapter, HtmlReport, ReportImage, render

LINE = MapElements.of([[(0, 0), (10, 0)]], DIVIDER)


def test_arrows_lead_from_a_line_to_the_other_observation() -> None:
    arrows = compute_misalignment(LINE, LINE.transform(0, 1.0, 0))
    assert arrows[:, 0].tolist() == [0, 2, 4, 6, 8, 10]
    np.testing.assert_allclose(arrows[:, 1:], np.tile([0, 0, 1.0], (6, 1)), atol=0.026)
    assert len(compute_misalignment(LINE, LINE.transform(0, 4.0, 0))) == 0, "4 m is another line"
    assert len(compute_misalignment(LINE, MapElements.of([[(0, 1), (10, 1)]], BOUNDARY))) == 0, (
        "another kind is another line"
    )


def test_a_figure_is_one_file_with_arrows_in_it_and_the_same_each_time(tmp_path) -> None:
    moved = LINE.transform(0, 2.0, 0)
    panels = [MapPanel("before", LINE, moved, compute_misalignment(LINE, moved)), MapPanel("after", LINE, LINE)]
    save_figure(panels, tmp_path / "new" / "a.png")
    save_figure(panels, tmp_path / "new" / "b.png")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["a.png", "b.png"]
    assert (tmp_path / "new" / "a.png").read_bytes() == (tmp_path / "new" / "b.png").read_bytes()
    pixels = np.asarray(Image.open(tmp_path / "new" / "a.png").convert("RGB")).astype(int)
    red = tuple(int(ARROW_COLOUR[k : k + 2], 16) for k in (1, 3, 5))
    places = np.argwhere(np.abs(pixels - red).max(-1) < 20)
    assert len(places) > 50 and places[:, 1].max() < pixels.shape[1] / 2, "arrows stand in the left panel only"


def test_an_empty_map_is_an_empty_panel(tmp_path) -> None:
    save_figure([MapPanel("nothing", MapElements.empty())], tmp_path / "x.png", columns=1)
    assert (tmp_path / "x.png").stat().st_size > 1000


def test_a_chapter_stands_in_the_report_with_its_pictures(tmp_path) -> None:
    save_figure([MapPanel("one", LINE)], tmp_path / "x.png", columns=1)
    chapter = Chapter("One map & more", "Sixty drives.", (ReportImage(tmp_path / "x.png", "It"),))
    page = render(HtmlReport("t", "l", chapters=(chapter,)))
    assert "<h2>One map &amp; more</h2><p>Sixty drives.</p>" in page.replace("\n", "")
    assert page.count("data:image/png") == 1
