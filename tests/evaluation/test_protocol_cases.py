# SPDX-License-Identifier: Apache-2.0
"""The golden cases of protocols, as they are drawn in the documentation."""

from pathlib import Path

import pytest
from tests.evaluation.protocol_cases import ALL_CASES, VOLUME, draw_cases

from manyeyes.evaluation.detection.average_precision import average_precision, compute_frame_iou, match_frame

ROOT = Path(__file__).resolve().parents[2]
PANELS = [(case, panel) for case in ALL_CASES for panel in case.panels]


@pytest.mark.parametrize(("case", "panel"), PANELS, ids=[f"{case.name}: {panel.title}" for case, panel in PANELS])
def test_a_panel_has_the_result_that_was_worked_out_by_hand(case, panel) -> None:
    matches = [match_frame(frame, panel.iou, panel.protocol) for frame in case.frames()]
    assert tuple(len(m.score) for m in matches) == panel.kept
    assert tuple(tuple(m.tp.tolist()) for m in matches) == panel.hits
    assert average_precision(case.frames(), panel.iou, panel.protocol).ap == pytest.approx(panel.ap)


def test_overlaps_of_the_volumes_are_those_of_the_titles() -> None:
    """Along x 3.5 m of 4.5 m; in height 1.2 m of 1.5 m: 3.5 * 1.2 / (2 * 4 * 1.5 - 3.5 * 1.2) = 0.538."""
    for panel, expected in zip(VOLUME.panels, ((1, 1, 3.5 / 4.5), (1, 1 / 3, 4.2 / 7.8)), strict=True):
        (frame,) = VOLUME.frames()
        assert compute_frame_iou(frame, panel.protocol).iou.diag().tolist() == pytest.approx(list(expected))


def test_every_case_is_drawn_in_the_documentation(tmp_path) -> None:
    page = (ROOT / "docs/reference/protocol-cases.md").read_text(encoding="utf-8")
    for case in ALL_CASES:
        assert f"../images/{case.name}.png" in page and (ROOT / f"docs/images/{case.name}.png").is_file()
        assert all(f"{panel.ap:.3f}" in page for panel in case.panels)


@pytest.mark.slow
def test_cases_can_be_drawn(tmp_path) -> None:
    pytest.importorskip("matplotlib")
    draw_cases(VOLUME, tmp_path / "case.png")
    assert (tmp_path / "case.png").stat().st_size > 5000
