# SPDX-License-Identifier: Apache-2.0
"""The key of a kept result follows the code that computed it: every statement of every file, and no comment or docstring."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from manyeyes._source import PACKAGE, import_closure, source_digest

ROOTS = {
    "detection": ("manyeyes.evaluation.detection.benchmark",),
    "map fusion": ("manyeyes.studies.maps.fleet_cells",),
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    to = tmp_path_factory.mktemp("copy") / "manyeyes"
    shutil.copytree(PACKAGE, to, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors", "vendor"))
    return to


@pytest.mark.slow
@pytest.mark.parametrize("roots", ROOTS.values(), ids=ROOTS)
def test_a_statement_in_any_file_of_the_closure_changes_the_key_and_a_docstring_does_not(copy: Path, roots) -> None:
    before, closure = source_digest(*roots, package=copy), import_closure(*roots, package=copy)
    assert before == source_digest(*roots)
    assert len(closure) > 40
    texts = {file: file.read_text() for file in closure}
    for file, text in texts.items():
        file.write_text(text.replace('"""', '"""Changed. ', 1) + "\n\n# a comment\n")
    source_digest.cache_clear()
    assert source_digest(*roots, package=copy) == before
    for file, text in texts.items():
        source_digest.cache_clear()
        file.write_text(text + "\nANOTHER_STATEMENT = 1\n")
        assert source_digest(*roots, package=copy) != before, file
        file.write_text(text)
    source_digest.cache_clear()


def test_files_that_a_hand_kept_list_missed_are_in_the_closure() -> None:
    names = {path.relative_to(PACKAGE).as_posix() for path in import_closure("manyeyes.studies.maps.fleet_cells")}
    assert {"ops/keyed_random.py", "datatypes/map_element.py", "maps/formats/opendrive.py"} <= names


def test_the_modules_of_a_registry_are_in_the_closure() -> None:
    names = {path.relative_to(PACKAGE).as_posix() for path in import_closure("manyeyes.pose.registry")}
    assert {"pose/corrector.py", "pose/feakm.py", "pose/baselines/vips.py", "models/pose/matcher.py"} <= names


def test_a_module_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"no module manyeyes\.moon"):
        import_closure("manyeyes.moon")


def test_a_public_name_stands_for_the_module_that_defines_it() -> None:
    names = {path.relative_to(PACKAGE).as_posix() for path in import_closure("manyeyes.datasets.perturbation")}
    assert {"datatypes/__init__.py", "datatypes/transform.py", "_lazy.py"} <= names
    assert "datatypes/map_element.py" not in names
