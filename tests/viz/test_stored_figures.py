# SPDX-License-Identifier: Apache-2.0
"""Figures of stored results in documents: drawn from made-up results, the same on every run, light and dark."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from manyeyes.cli.main import main
from manyeyes.datatypes import ConfigError
from manyeyes.viz.documents import END, update_text
from manyeyes.viz.figure_svg import THEMES, Panel, draw_svg, spread_points
from manyeyes.viz.stored_figures import FIGURES, draw_figure
from manyeyes.viz.stored_tables import StoredResult

Figure = pytest.importorskip("matplotlib.figure").Figure

LIGHT, DARK = THEMES


def interval(value: float) -> dict[str, float]:
    return {"value": value, "low": value - 0.05, "high": value + 0.05}


def perturbation(**changes: float) -> dict[str, float]:
    return {"delay_s": 0.0, "heading_sigma_deg": 0.0, "position_sigma_m": 0.0, "packet_loss": 0.0, **changes}


def ap_row(method: str, value: float, num_bytes: float) -> dict[str, Any]:
    return {"method": method, "ap50": interval(value), "ap70": interval(value / 2), "bytes_per_message": num_bytes}


EVALUATION: dict[str, Any] = {
    "rows": [ap_row("no-fusion", 0.5, 0.0), ap_row("late", 0.7, 2048.0), ap_row("early", 0.9, 65536.0)],
    "differences": [
        {"description": "early - late", "metric": m, "interval": interval(0.2)} for m in ("AP@0.5", "AP@0.7")
    ],
}
ROBUSTNESS: dict[str, Any] = {
    "rows": [
        {"method": method, "perturbation": at, "ap": [interval(0.8), interval(0.6)]}
        for method in ("no-fusion", "late")
        for at in (perturbation(), perturbation(delay_s=0.4), perturbation(delay_s=0.4, packet_loss=0.3))
        if method == "late" or at == perturbation()
    ]
}
RESULTS: dict[str, dict[str, Any]] = {
    "ap-bytes": EVALUATION,
    "differences": EVALUATION,
    "robustness": ROBUSTNESS,
    "num-agents": {
        "rows": [
            {"method": "late", "num_agents": n, "ap": [interval(0.5 + n / 10)], "gain_over_one_fewer": interval(n / 10)}
            for n in (2, 3)
        ]
    },
    "reliability": {
        "rows": [{"method": "late", "bins": [{"mean_score": s, "correct": interval(s)} for s in (0.2, 0.8)]}]
    },
    "attacks": {
        "rows": [
            {"attack": attack, "method": method, "defence": "none", "num_malicious": 1, "ap": [interval(0.5)]}
            for attack, method in (("none", "no-fusion"), ("none", "late"), ("copy", "late"))
        ]
    },
    "risk-coverage": {
        "nulls": [{"corrector": "voting", "kind": "other place", "risk_by_coverage": [0.0, 0.1, None, None]}]
    },
    "pose-noise": {
        "rows": [
            {
                "common_range": None,
                "trial": {"corrector": "voting", "noise": {"kind": "gaussian", "sigma_m": s}},
                "score": {"success_rate": [0.9, 0.9, 0.9], "mean_displacement_m": s},
            }
            for s in (0.0, 1.0)
        ]
    },
    "ap-pose-noise": {
        "rows": [
            {
                "corrector": corrector, "method": method, "ap": [interval(0.8), interval(0.6)],
                "level": perturbation(heading_sigma_deg=s, position_sigma_m=s),
            }
            for corrector, method in (("voting", "intermediate"), ("identity", "F-Cooper"))
            for s in (0.0, 2.0)
        ]
    },
    "map-observations": {
        "summaries": [{"group": f"{n} observations", "method": "union", "mean_ap": interval(0.4)} for n in (20, 60)]
    },
    "acceptance-roc": {
        "roc": [
            {
                "boxes": "15 x 17", "num_common": 3, "score": score, "null_rate": [0.001, 0.01, 0.1], "success": [0.1, 0.2, top],
            }
            for score, top in (("voting", 0.5), ("learned", 0.8))
        ]
    },
    "latency-stack": {
        "rows": [
            {"case": "16 beams", "weights": "w", "drive": 0, "agents": 4, "present_stages_ms": {"share: a": 1.0}}
        ]
    },
    "malicious-agents": {
        "rows": [
            {"attack": attack, "fraction": 0.2, "offset_m": offset, "found": {"successes": 3, "total": 4, "low": 0.2, "high": 0.99}}
            for attack in ("independent", "colluding") for offset in (0.5, 2.0)
        ]
    },
    "map-cost": {
        "costs": [{"way": "tiles", "cells": n, "seconds": n / 1e4, "peak_mib": 50.0} for n in (1000, 4000)]
    },
}  # fmt: skip


def stored(result: Any) -> StoredResult:
    return StoredResult(Path("r.json"), result, "command", "0123456789ab", (0,), "val")


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_is_the_same_text_on_every_run_and_differs_by_theme(name: str) -> None:
    results = [stored(RESULTS[name])]
    light = draw_figure(name, results, LIGHT)
    assert light == draw_figure(name, results, LIGHT) and "<dc:date>" not in light
    dark = draw_figure(name, results, DARK)
    assert LIGHT.text in light and LIGHT.text not in dark and DARK.text in dark


def test_ten_series_have_ten_colours() -> None:
    for theme in THEMES:
        assert len({theme.series_colour(place) for place in range(10)}) == 10


def shown_texts(name: str) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]+)</text>", draw_figure(name, [stored(RESULTS[name])], LIGHT))


def test_a_figure_names_axes_methods_and_units() -> None:
    assert {"log2(bytes per message)", "AP@0.5", "AP@0.7", "no-fusion", "late", "early"} <= set(shown_texts("ap-bytes"))
    assert {"delay [s]", "heading error [°]", "position error [m]"} <= set(shown_texts("robustness"))
    assert {"early - late", "AP@0.7"} <= set(shown_texts("differences"))
    assert {"intermediate, voting", "F-Cooper, identity", "AP@0.7"} <= set(shown_texts("ap-pose-noise"))


def test_forms_of_a_method_have_labels_of_their_own() -> None:
    rows = [ap_row("late", 0.7, 2048.0), ap_row("late-temporal", 0.8, 2048.0)]
    text = draw_figure("ap-bytes", [stored({"rows": rows})], LIGHT)
    assert "late + memory" in text and ">late<" in text


def test_points_of_equal_bytes_stand_side_by_side_and_the_axis_states_it() -> None:
    assert spread_points([11.2, 16.0, 11.2, 11.8], 0.16) == pytest.approx([11.12, 16.0, 11.28, 11.8])
    assert spread_points([1.0, 2.0], 0.5) == [1.0, 2.0] and spread_points([], 0.5) == []
    rows = [ap_row("late", 0.7, 2048.0), ap_row("late-weighted", 0.71, 2048.0)]
    assert ">log2(bytes per message), equal bytes side by side<" in draw_figure(
        "ap-bytes", [stored({"rows": rows})], LIGHT
    )


def test_lines_of_equal_values_differ_in_their_dashes() -> None:
    rows = [{"group": f"{n} observations", "method": m, "mean_ap": interval(0.4)} for n in (20, 60) for m in ("a", "b")]
    text = draw_figure("map-observations", [stored({"summaries": rows})], LIGHT)
    assert [bool(re.search(f"stroke-dasharray[^>]*stroke: {LIGHT.series_colour(place)}", text)) for place in (0, 1)] == [
        False, True,
    ]  # fmt: skip


def test_places_of_another_shape_are_not_in_the_lines_over_observations() -> None:
    groups = ("20 observations", "60 observations", "20 observations, other shapes")
    rows = [{"group": group, "method": "union", "mean_ap": interval(0.4)} for group in groups]
    (panel,) = FIGURES["map-observations"].make([stored({"summaries": rows})])
    axes = Figure().add_subplot()
    panel.draw(axes, LIGHT)
    assert axes.lines[0].get_xdata().tolist() == [20.0, 60.0]


def test_short_stages_of_a_step_are_one_bar() -> None:
    stages = {f"share: {name}": float(time) for name, time in zip("abcdef", (6, 5, 4, 3, 2, 1), strict=True)}
    row = {"case": "c", "weights": "w", "drive": 0, "agents": 4, "present_stages_ms": {**stages, "share: other": 9.0}}
    figure = FIGURES["latency-stack"].make([stored({"rows": [row]})])[0]
    axes = Figure().add_subplot()
    figure.draw(axes, LIGHT)
    widths = {bars.get_label(): bars[0].get_width() for bars in axes.containers}
    assert widths == {"share: a": 6.0, "share: b": 5.0, "share: c": 4.0, "share: d": 3.0, "share: other": 12.0}
    assert sum(widths.values()) == sum(row["present_stages_ms"].values())


def test_the_oracle_is_a_level_since_attacks_do_not_change_it() -> None:
    oracle = {"attack": "none", "method": "late", "defence": "oracle", "num_malicious": 1, "ap": [interval(0.4)]}
    text = draw_figure("attacks", [stored({"rows": [*RESULTS["attacks"]["rows"], oracle]})], LIGHT)
    assert ">oracle: malicious agent left out<" in text and "defence: oracle" not in text and ">no attack<" in text


def test_each_method_under_attack_has_axes_of_its_own_and_each_attack_a_line() -> None:
    one = {"defence": "none", "num_malicious": 1, "ap": [interval(0.5)]}
    rows = [
        {**one, "attack": f"attack-{k}", "method": method} for method in ("late", "intermediate") for k in range(30)
    ]
    text = draw_figure("attacks", [stored({"rows": rows})], LIGHT)
    assert text.count(">attack-0<") == text.count(">attack-29<") == 2 and ">late<" in text and ">intermediate<" in text
    few = draw_figure("attacks", [stored({"rows": rows[:4]})], LIGHT)
    heights = [float(re.search(r'height="([0-9.]+)pt"', svg)[1]) for svg in (text, few)]
    assert heights[0] > 2 * heights[1]


def test_a_legend_has_lines_of_equal_length() -> None:
    def draw(axes: Any, theme: Any) -> None:
        for name in ("no-fusion-temporal", "late-temporal", "intermediate-temporal", "early-temporal"):
            axes.plot([0.0], [0.0], label=name)

    text = draw_svg([Panel("", "", "", draw)], LIGHT)
    heights = [
        re.search(rf'y="([\d.]+)"[^>]*>{name}<', text) for name in ("no-fusion-temporal", "intermediate-temporal")
    ]
    assert heights[0] is not None and heights[1] is not None and heights[0][1] == heights[1][1]


def test_combined_disturbances_are_not_on_the_axis_of_one() -> None:
    whole = draw_figure("robustness", [stored(ROBUSTNESS)], LIGHT)
    rows = [row for row in ROBUSTNESS["rows"] if not row["perturbation"]["packet_loss"]]
    assert draw_figure("robustness", [stored({"rows": rows})], LIGHT) == whole


def test_a_result_of_something_else_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"r\.json: no result of the figure map-cost .* benchmarks/map_cost\.py"):
        draw_figure("map-cost", [stored(EVALUATION)], LIGHT)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository with one page that shows a figure, in a folder below docs."""
    (tmp_path / "benchmarks/results").mkdir(parents=True)
    (tmp_path / "docs/more").mkdir(parents=True)
    origin = {
        "command": "manyeyes evaluate",
        "git_commit": "0123456789abcdef",
        "seed": 0,
        "config": {"options": {"split": "val"}},
    }
    text = json.dumps({"provenance": origin, "result": {**EVALUATION, "stats": []}})
    (tmp_path / "benchmarks/results/dev_test.json").write_text(text)
    (tmp_path / "docs" / "more" / "p.md").write_text(
        f"# Page\n\n<!-- report: figure ap-bytes dev_test.json -->\n{END}\n"
    )
    return tmp_path


def test_figures_are_written_beside_the_documents_and_checked(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "docs", "--root", str(root), "--check"]) == 1
    assert main(["report", "docs", "--root", str(root)]) == 0
    page = (root / "docs" / "more" / "p.md").read_text()
    assert 'srcset="../images/plots/ap-bytes-dev-test-dark.svg"' in page
    assert 'src="../images/plots/ap-bytes-dev-test-light.svg"' in page
    assert (
        "<summary>Command, commit, seed and split</summary>\n\n`manyeyes evaluate`, commit 0123456789ab, seed 0, split val."
        in page
    )
    assert main(["report", "docs", "--root", str(root), "--check"]) == 0
    picture = root / "docs/images/plots/ap-bytes-dev-test-dark.svg"
    picture.write_text(picture.read_text().replace("log2", "log3"))
    capsys.readouterr()
    assert main(["report", "docs", "--root", str(root), "--check"]) == 1
    assert "docs/images/plots/ap-bytes-dev-test-dark.svg: differs" in " ".join(capsys.readouterr().err.split())


def test_a_figure_without_results_names_the_command(root: Path) -> None:
    text = update_text(f"<!-- report: figure map-cost none.json -->\nold\n{END}\n", root / "benchmarks/results", "p.md")
    assert text.splitlines()[2] == (
        "*not run: CPU time and memory of map prediction against map size: `benchmarks/results/none.json` is not stored; "
        "`python benchmarks/map_cost.py` makes it.*"
    )


@pytest.mark.parametrize("marker", ["figure", "figure ap-bytes", "figure none dev_test.json"])
def test_bad_markers_of_figures_are_refused(root: Path, marker: str) -> None:
    with pytest.raises(ConfigError, match=r"page: a marker of a figure is .* one of ap-bytes"):
        update_text(f"<!-- report: {marker} -->\n{END}\n", root / "benchmarks/results", "page")
