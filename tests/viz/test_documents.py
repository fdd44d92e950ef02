# SPDX-License-Identifier: Apache-2.0
"""Tables of stored results in documents: made-up results, written and checked."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from manyeyes.cli.main import main
from manyeyes.datatypes import ConfigError
from manyeyes.viz.documents import END, PLOTS, find_documents, update_text
from manyeyes.viz.stored_tables import load_result, make_tables

ROOT = Path(__file__).resolve().parents[2]
ORIGIN: dict[str, Any] = {
    "command": "manyeyes evaluate --data D",
    "git_commit": "0123456789abcdef",
    "seed": 0,
    "config": {"options": {"split": "val"}},
}


def interval(value: float | None, scenarios: int = 4) -> dict[str, Any]:
    return {"value": value, "low": (value or 0) - 0.1, "high": (value or 0) + 0.1, "num_scenarios": scenarios}


def sensors_row(recording: str, law: str, sweeps: int, value: float) -> dict[str, Any]:
    pair = [interval(value, 1), interval(value, 1)]
    return {"recording": recording, "law": law, "sweeps": sweeps, "tilt_deg": 0.0, "method": "intermediate", "ap": pair}


def evaluation(classes: tuple[str, ...] = ("vehicle",)) -> dict[str, Any]:
    names = ("precision", "recall", "f_score", "false_alarms_per_frame", "duplicates_per_object")
    point = {
        "threshold": {"score": 0.31, "source": "weights"},
        **{name: interval(0.1 * k) for k, name in enumerate(names)},
    }
    row = {"ap50": interval(0.6), "ap70": interval(0.4), "bytes_per_message": 1234.4}
    return {
        "protocol": {"score_threshold": 0.05},
        "stats": [],
        "rows": [{"method": "late", "class_name": name, **row} for name in classes],
        "operating_rows": [
            {"method": "late", "class_name": name, "point": point, "legacy_ap": [interval(0.5), interval(0.3)]}
            for name in classes
        ],
        "differences": [{"description": "late - none", "metric": "AP@0.5", "interval": interval(0.2)}],
    }


RESULTS: dict[str, Any] = {
    "a-evaluate": {
        "stats": [],
        "rows": [
            {"method": "none", "ap50": interval(0.5), "ap70": interval(None), "bytes_per_message": None},
            {"method": "late", "ap50": interval(0.6), "ap70": interval(0.4), "bytes_per_message": 1234.4},
        ],
    },
    "b-sensors": {
        "study": "sensors",
        "rows": [sensors_row(f"beams-{n}", law, s, 0.1 * s) for n in (16, 32) for law in ("zero", "carla") for s in (2, 1)],
    },
    "c-strata": {
        "study": "strata",
        "rows": [
            {"stratum": "t", "method": "none", "num_scenarios": 3, "ap": [interval(0.5), interval(0.4)], "bytes_per_message": 0}
        ],
    },
    "d-cases": {
        "command": "python unseen_scenes.py",
        "cases": [
            {
                "case": "argoverse2", "frames": 2, "vehicles": 18, "matched": 9, "under_crowns": 8, "matched_under_crowns": 1,
                "false_boxes": 46,
            }
        ],
    },
}  # fmt: skip


def write(path: Path, result: object, **origin: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"provenance": {**ORIGIN, **origin}, "result": result}))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository with one document and results of every kind."""
    for name, result in RESULTS.items():
        write(tmp_path / "benchmarks/results/all" / f"{name}.json", result)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "p.md").write_text(f"# Page\n\nText.\n\n<!-- report: all -->\n{END}\n\nAfter.\n")
    return tmp_path


def test_tables_are_written_once_between_their_markers(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = root / "docs" / "p.md"
    assert main(["report", "docs", "--root", str(root), "--check"]) == 1
    assert "p.md: differs from" in capsys.readouterr().err and END in page.read_text()
    assert main(["report", "docs", "--root", str(root)]) == 0
    text = re.sub(" +", " ", page.read_text())
    assert text.startswith("# Page\n\nText.\n\n<!-- report: all -->\n\n**Methods**") and text.endswith(
        f"{END}\n\nAfter.\n"
    )
    assert "| none | 0.500 [0.400, 0.600] | - | - |" in text and "| 0.400 [0.300, 0.500] | 1,234 |" in text
    assert "| intensity | beams-16, 2 sweeps | beams-16, 1 sweep | beams-32, 2 sweeps | beams-32, 1 sweep |" in text
    assert "| zero | 0.200 | 0.100 | 0.200 | 0.100 |" in text
    assert "| argoverse2 | 2 | 18 | 9 | 46 | 1 of 8 |" in text
    assert "`python unseen_scenes.py`, commit 0123456789ab, seed 0, split argoverse2." in text
    assert "`manyeyes evaluate --data D`, commit 0123456789ab, seed 0, split val." in text
    again = page.read_text()
    assert main(["report", "docs", "--root", str(root)]) == 0 and page.read_text() == again
    assert main(["report", "docs", "--root", str(root), "--check"]) == 0


def test_a_changed_number_of_a_document_is_found(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = root / "docs" / "p.md"
    main(["report", "docs", "--root", str(root)])
    page.write_text(page.read_text().replace("0.600 [0.500, 0.700]", "0.700 [0.500, 0.700]"))
    assert main(["report", "docs", "--root", str(root), "--check"]) == 1
    assert "p.md" in capsys.readouterr().err and "0.700 [0.500, 0.700]" in page.read_text()


@pytest.mark.parametrize(
    ("origin", "missing"),
    [
        ({"command": ""}, "command"),
        ({"git_commit": None}, "git_commit"),
        ({"seed": None}, "seed"),
        ({"config": {"options": {"split": None}}}, "split"),
        ({"config": None, "seed": None}, "seed, split"),
    ],
)
def test_results_that_cannot_be_made_again_are_refused(
    root: Path, origin: dict[str, Any], missing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    page = root / "docs" / "p.md"
    before = page.read_text()
    write(root / "benchmarks/results/all/e.json", RESULTS["a-evaluate"], **origin)
    for more in ([], ["--check"]):
        assert main(["report", "docs", "--root", str(root), *more]) == 1
        assert f"e.json: its provenance lacks {missing}, so" in capsys.readouterr().err
    assert page.read_text() == before


def test_several_seeds_and_uncommitted_changes_are_stated(tmp_path: Path) -> None:
    path = write(tmp_path / "r.json", RESULTS["a-evaluate"], seeds=[1, 2], git_commit="0123456789abcdef+changes")
    assert load_result(path).origin.endswith("commit 0123456789ab with changes, seeds 1, 2, split val.")


def test_what_is_no_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"x\.json: no result of evaluate"):
        make_tables(load_result(write(tmp_path / "x.json", {"cells": 1})))
    (tmp_path / "y.json").write_text("[]")
    for name in ("y.json", "missing.json"):
        with pytest.raises(ConfigError, match=rf"{name}: no stored result"):
            load_result(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("<!-- report: all -->\n", "page: the marker .* has no"),
        (f"<!-- report: all -->\n<!-- report: all -->\n{END}\n", "page: the marker .* has no"),
        (f"<!-- report: picture p.png -->\n{END}\n", "page: a marker of a picture is"),
        (f"<!-- report: all/a-evaluate.json other -->\n{END}\n", "has no table other; it has methods"),
        (f"<!-- report: seeds late -->\n{END}\n", "page: a marker of seeds is"),
        (f"<!-- report: training-seeds 5=a.json -->\n{END}\n", "page: a marker of seeds of main tables is"),
    ],
)
def test_bad_markers_are_refused(root: Path, text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        update_text(text, root / "benchmarks/results", "page")


@pytest.mark.parametrize(
    "marker",
    [
        "none.json",
        "none.json methods",
        "folder",
        "picture none.png A plot",
        "seeds late ours=none.json",
        "training-seeds 5=none.json 6=other.json",
    ],
)
def test_what_is_not_stored_reads_not_run(root: Path, marker: str) -> None:
    path = "folder" if marker == "folder" else "none.png" if "picture" in marker else "none.json"
    text = update_text(f"<!-- report: {marker} -->\nold\n{END}\n", root / "benchmarks/results", "pages/p.md")
    assert text.splitlines()[2:] == [f"*not run: `benchmarks/results/{path}` is not stored.*", END]
    assert update_text(text, root / "benchmarks/results", "pages/p.md") == text


def test_a_picture_is_linked_from_the_folder_of_the_document(root: Path) -> None:
    (root / "benchmarks/results/curves.png").write_bytes(b"")
    text = f"<!-- report: picture curves.png AP against bytes -->\n{END}\n"
    for name, path in (("README.md", "benchmarks"), ("pages/more/p.md", "../../benchmarks")):
        link = f"![AP against bytes]({path}/results/curves.png)"
        assert update_text(text, root / "benchmarks/results", name).splitlines()[2] == link


def perturbation(delay_s: float = 0.0, packet_loss: float = 0.0) -> dict[str, float]:
    return {"delay_s": delay_s, "heading_sigma_deg": 0.0, "position_sigma_m": 0.0, "packet_loss": packet_loss}


def main_row(method: str, channel: str, at: dict[str, float], value: float, corrector: str = "off") -> dict[str, Any]:
    return {
        "method": method, "channel": channel, "perturbation": at, "corrector": corrector, "bytes_per_message": 1234.4,
        "answer_ap": [interval(value), interval(value / 2)], "paper_bytes": None, "age_ms": 4.0, "answer_ms": 115.0,
        "legacy_ap": [interval(0.3), interval(0.2)], "point": evaluation()["operating_rows"][0]["point"], "compute_ms": 15.0,
        "parameters": {"fusion": 127555, "whole": 810000},
    }  # fmt: skip


def test_the_main_table_is_methods_by_disturbances(tmp_path: Path) -> None:
    rows = [main_row("no-fusion", "any channel", perturbation(), 0.5)]
    rows += [
        main_row("late", channel, at, value, corrector)
        for channel in ("its-g5-6", "ideal")
        for at, value in ((perturbation(), 0.9), (perturbation(0.4, 0.3), 0.8))
        for corrector in ("off", "voting")
    ]
    printed = {"title": "Channel: its-g5-6", "headings": ["method"], "lines": [["late"]]}
    result = {"study": "main-table", "rows": rows, "tables": [printed]}
    tables = {table.name: table.lines for table in make_tables(load_result(write(tmp_path / "m.json", result)))}
    assert list(tables)[:4] == [
        "ap50-its-g5-6-off",
        "ap70-its-g5-6-off",
        "ap50-its-g5-6-voting",
        "ap70-its-g5-6-voting",
    ]
    alone = "0.500 [0.400, 0.600]"
    assert tables["ap50-ideal-voting"] == [
        ("method", "clean", "0.4 s, 30 % loss"),
        ("no-fusion", alone, alone),
        ("late", "0.900 [0.800, 1.000]", "0.800 [0.700, 0.900]"),
    ]
    assert tables["cost"][1:] == [
        (name, "1,234", "-", "4", "115", "15", "127,555", "810,000") for name in ("no-fusion", "late")
    ]
    assert tables["operating-point"][1][0] == "no-fusion" and len(tables["operating-point"]) == 3
    assert tables["channel-its-g5-6"] == [("method",), ("late",)]


def test_robustness_is_perturbations_by_methods_of_one_form(tmp_path: Path) -> None:
    rows = [
        {"method": method, "perturbation": at, "ap": [interval(value), interval(None)]}
        for method, value in (("no-fusion", 0.5), ("late", 0.7), ("late-temporal", 0.8))
        for at in (perturbation(), perturbation(0.1))
        if method != "no-fusion" or at == perturbation()
    ]
    result = {"study": "robustness", "rows": rows}
    tables = {table.name: table.lines for table in make_tables(load_result(write(tmp_path / "r.json", result)))}
    assert tables["robustness"] == [
        ("perturbation", "no-fusion", "late"),
        ("clean", "0.500 [0.400, 0.600]", "0.700 [0.600, 0.800]"),
        ("0.1 s", "-", "0.700 [0.600, 0.800]"),
    ]
    assert tables["robustness-temporal-ap70"][1] == ("clean", "-") and len(tables) == 4


@pytest.mark.parametrize(
    "rows",
    [
        {"study": "byte-curves", "rows": []},
        {"study": "fusion", "summaries": []},
        {"study": "malicious-agents", "rows": []},
    ],
)
def test_tables_that_a_study_printed_are_those_of_the_document(tmp_path: Path, rows: dict[str, Any]) -> None:
    printed = {"title": "AP against bytes, with memory", "headings": ["method", "AP"], "lines": [["late", "0.9"]]}
    result = {**rows, "tables": [printed]}
    (table,) = make_tables(load_result(write(tmp_path / "b.json", result)))
    assert (table.name, table.lines) == ("ap-against-bytes-with-memory", [("method", "AP"), ("late", "0.9")])


def test_one_table_of_a_file_is_chosen_by_its_name(root: Path) -> None:
    write(root / "benchmarks/results/e.json", evaluation())
    text = update_text(f"<!-- report: e.json operating-point -->\n{END}\n", root / "benchmarks/results", "page")
    lines = re.sub(" +", " ", text).splitlines()
    assert lines[2].startswith(
        "| method | threshold | precision | recall | F | false alarms/frame | duplicates/object |"
    )
    assert lines[4].startswith("| late | 0.310 (weights) | 0.000 [-0.100, 0.100] | 0.100 [0.000, 0.200] |")
    assert "late - none" not in text and "class" not in text


def test_a_class_column_is_there_with_several_classes_only(tmp_path: Path) -> None:
    for classes in (("vehicle",), ("vehicle", "pedestrian")):
        tables = make_tables(load_result(write(tmp_path / "e.json", evaluation(classes))))
        assert [table.name for table in tables] == ["methods", "operating-point", "differences"]
        for table in tables[:2]:
            assert ("class" in table.lines[0]) == (len(classes) > 1) and len(table.lines) == 1 + len(classes)


def trained(seed: int, value: float) -> dict[str, Any]:
    """An evaluation of one training: AP@0.5 of 41 resamples about the value, AP@0.7 half of it."""
    resamples = [[scale * value + 0.005 * (k - 20) for k in range(41)] for scale in (1, 0.5)]
    summaries = [{"ap": {"value": scale * value}} for scale in (1, 0.5)]
    stats = {"method": "intermediate", "class_name": "vehicle", "ap_summaries": summaries, "resamples": resamples}
    return {"stats": [stats], "rows": [], "training_seed": seed, "scenarios": ["a", "b"]}


def test_seeds_of_methods_become_one_table(root: Path) -> None:
    """AP@0.5: ours .80 .82 .84, theirs .79 .80 .81, pooled spread .0158: +.020 is not claimed; so at 0.7."""
    values = {"ours": (0.80, 0.82, 0.84), "theirs": (0.79, 0.80, 0.81), "weak": (0.5, 0.5, 0.5)}
    for name, column in values.items():
        for seed, value in enumerate(column, 5):
            write(root / f"benchmarks/results/{name}{seed}.json", trained(seed, value))
    words = " ".join(f"{name}={','.join(f'{name}{s}.json' for s in (5, 6, 7))}" for name in values)
    text = update_text(f"<!-- report: seeds intermediate {words} -->\n{END}\n", root / "benchmarks/results", "page")
    text = re.sub(" +", " ", text)
    assert "| ours | 5, 6, 7 | 0.820 [0.725, 0.915] | 0.020 | 0.410 [0.315, 0.505] | 0.010 |" in text
    assert "| ours - theirs | AP@0.5 | +0.020 [+0.020, +0.020] | not claimed |" in text
    assert "| ours - weak | AP@0.5 | +0.320 [+0.320, +0.320] | yes |" in text
    assert "pooled over methods: AP@0.5 0.013, AP@0.7 0.006" in text
    assert text.count("seed 0, split val.") == 9
    write(root / "benchmarks/results/weak7.json", RESULTS["a-evaluate"])
    with pytest.raises(ConfigError, match=r"weak7\.json: needs the method intermediate of class vehicle"):
        update_text(f"<!-- report: seeds intermediate {words} -->\n{END}\n", root / "benchmarks/results", "page")


@pytest.mark.slow
def test_the_documents_of_this_repository_are_those_of_their_results() -> None:
    documents = find_documents(ROOT)
    assert {"README.md", "fine-tune.md", "costr-small.md"} <= {document.path.name for document in documents}
    assert {*(ROOT / PLOTS).iterdir()} == {document.path for document in documents if document.path.suffix == ".svg"}
    assert [str(document.path) for document in documents if document.text != document.updated] == []
