# SPDX-License-Identifier: Apache-2.0
"""One writer a folder: the second one is refused by name, and a killed one blocks none."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from manyeyes._lock import LOCK, FolderInUseError, hold_folder, share_folder

_HOLD = """
import sys, time
from pathlib import Path
from manyeyes._lock import hold_folder
with hold_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path):
    """A process that holds the lock of tmp_path / "run"."""
    words = [sys.executable, "-c", _HOLD, str(tmp_path / "run")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_writer_is_refused_by_the_name_of_the_first(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    with pytest.raises(FolderInUseError) as error, hold_folder(tmp_path / "run"):
        pass
    name = (
        rf"process {holder.pid} on {os.uname().nodename} \(since \d{{4}}-\S+: -c {re.escape(str(tmp_path / 'run'))}\)"
    )
    assert re.search(
        rf"run: {name} writes to this folder; wait until it has ended, or choose another", str(error.value)
    )


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert (tmp_path / "run" / LOCK).exists()
    with hold_folder(tmp_path / "run"):
        assert f"process {os.getpid()} " in (tmp_path / "run" / LOCK).read_text()
        (tmp_path / "run" / "result").write_text("")
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["result"]


def test_a_new_folder_that_stays_empty_is_removed_and_an_old_one_is_not(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for name in ("old", "new/below"):
        with pytest.raises(ValueError), hold_folder(tmp_path / name):
            raise ValueError
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


def test_folders_are_held_one_after_another_and_beside_each_other(tmp_path: Path) -> None:
    locks = [tmp_path / LOCK, tmp_path / "below" / LOCK]
    with hold_folder(tmp_path), hold_folder(tmp_path / "below"):
        assert [path.read_text().split(" on ")[0] for path in locks] == [f"process {os.getpid()}"] * 2
        with pytest.raises(FolderInUseError), hold_folder(tmp_path / "below"):
            pass
    assert not list(tmp_path.iterdir())
    with hold_folder(tmp_path):
        assert locks[0].exists() and not locks[1].exists()
    assert not list(tmp_path.iterdir())


def test_the_lock_of_a_folder_that_was_removed_leaves_that_of_the_next_holder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with hold_folder(folder):
        (folder / LOCK).unlink()
        folder.rmdir()
        with hold_folder(folder):
            (folder / "result").write_text("")
            (folder / LOCK).rename(folder / "kept")
            (folder / "kept").rename(folder / LOCK)
    assert [path.name for path in folder.iterdir()] == ["result"]


def test_sharers_are_beside_each_other_and_the_first_cleans_up(tmp_path: Path) -> None:
    cleaned: list[str] = []
    (tmp_path / LOCK).write_text("of a killed process")
    with share_folder(tmp_path, lambda: cleaned.append("first")):
        second = share_folder(tmp_path, lambda: cleaned.append("second"))
        with second, pytest.raises(FolderInUseError), hold_folder(tmp_path):
            pass
        assert (tmp_path / LOCK).exists()
    assert cleaned == ["first"] and not list(tmp_path.iterdir())


def test_a_folder_that_is_held_alone_is_not_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("manyeyes._lock._WAIT_S", 0)
    with hold_folder(tmp_path), pytest.raises(FolderInUseError), share_folder(tmp_path, lambda: None):
        pass


def test_a_study_removes_what_killed_ones_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from manyeyes.studies import catalog

    left = [tmp_path / "cells" / ".a.cell.1.unfinished", tmp_path / ".a.json.1.unfinished"]
    kept = [tmp_path / "cells" / "a.cell", tmp_path / "other" / ".b.cell.1.unfinished"]
    for path in (*left, *kept):
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
    seen: list[list[bool]] = []
    study = SimpleNamespace(run=lambda options, context: seen.append([path.exists() for path in (*left, *kept)]))
    monkeypatch.setitem(sys.modules, "manyeyes.studies.fake", study)  # pyright: ignore[reportArgumentType]
    monkeypatch.setitem(catalog.STUDIES, "fake", catalog.Study("", "", "fake", "StudyOptions"))
    catalog.run_study("fake", SimpleNamespace(out=tmp_path))
    assert seen == [[False, False, True, True]]
