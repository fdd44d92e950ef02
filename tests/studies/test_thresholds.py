# SPDX-License-Identifier: Apache-2.0
"""Thresholds from the results of a validation split."""

import json
from pathlib import Path

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.studies.thresholds import load_thresholds


def write_results(path: Path, data: Path, split: str) -> Path:
    stats = [
        {"method": "late", "class_name": "vehicle", "best_threshold": 0.31},
        {"method": "late", "class_name": "cyclist", "best_threshold": 0.2},
        {"method": "none", "class_name": "vehicle", "best_threshold": None},
    ]
    options = {"data": str(data), "split": split}
    path.write_text(json.dumps({"provenance": {"config": {"options": options}}, "result": {"stats": stats}}))
    return path


def test_thresholds_are_read_by_method_and_class(tmp_path: Path) -> None:
    path = write_results(tmp_path / "results.json", tmp_path, "val")
    found = load_thresholds(path, tmp_path, "test")
    assert {name: found["late"][name].score for name in found["late"]} == {"vehicle": 0.31, "cyclist": 0.2}
    assert found["late"]["vehicle"].source == "validation" and "none" not in found


def test_thresholds_of_the_same_data_are_refused(tmp_path: Path) -> None:
    path = write_results(tmp_path / "results.json", tmp_path, "val")
    with pytest.raises(ConfigError, match=r"results\.json: its thresholds were chosen on the same data"):
        load_thresholds(path, tmp_path, "val")


@pytest.mark.parametrize("text", ["", "{}", '{"provenance": {"config": {"options": {}}}, "result": {"stats": [{}]}}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(ConfigError, match=r"other\.json: no results\.json of 'manyeyes evaluate'"):
        load_thresholds(tmp_path / "other.json", tmp_path, None)
    with pytest.raises(ConfigError, match="missing"):
        load_thresholds(tmp_path / "missing.json", tmp_path, None)
