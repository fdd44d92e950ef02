# SPDX-License-Identifier: Apache-2.0
"""The files of a study: JSON and Markdown, and a picture where there is one."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import FusionOptions
from manyeyes.viz.study_table import StudyTable

TABLE = StudyTable("numbers", ("method", "AP"), (("late", "0.5"),))


@pytest.mark.parametrize("has_picture", [False, True])
def test_the_picture_is_drawn_and_named_where_there_is_one(tmp_path: Path, has_picture: bool) -> None:
    console = Console(file=io.StringIO(), width=120)
    context = StudyContext("some-study", FusionOptions(out=tmp_path), console)

    def save(path: Path) -> None:
        path.write_bytes(b"picture")

    context.write_report("A title", {"rows": [1, 2]}, [TABLE], save if has_picture else None, ["A note."])
    text = (tmp_path / "some-study.md").read_text()
    assert "A title" in text and "| late" in text and "A note." in text
    assert json.loads((tmp_path / "some-study.json").read_text())["result"]["rows"] == [1, 2]
    assert ("![some-study](some-study.png)" in text) == has_picture
    assert {path.suffix for path in tmp_path.iterdir()} == {".md", ".json"} | ({".png"} if has_picture else set())
    assert (".png" in console.file.getvalue()) == has_picture  # pyright: ignore[reportAttributeAccessIssue]
