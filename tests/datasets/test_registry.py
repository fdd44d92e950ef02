# SPDX-License-Identifier: Apache-2.0
"""Recordings are opened by the reader that recognises their folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from manyeyes.datasets.argoverse2 import Argoverse2Recording
from manyeyes.datasets.base import Recording, RecordingReader
from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.opv2v import Opv2vRecording
from manyeyes.datasets.registry import DATASETS, open_recording, register_dataset
from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, RecordingError, Snapshot, Transform


class OneFrame(RecordingReader):
    """A reader with nothing but what each must have."""

    def __init__(self, root: Path, split: str | None = None) -> None:
        self.scenarios = (f"{root.name} {split}",)
        self.missing_files = tuple(
            FileProblem(root / name, "missing", name, "") for name in ("", "gone", self.scenarios[0])
        )

    def length(self, scenario: str) -> int:
        return 1

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        frames = tuple(AgentFrame.of(PointCloud.of([[1, 2, 3]]), Transform.identity(), agent) for agent in (4, 2))
        return Snapshot(scenario, index, frames)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    DATASETS.load_all()
    monkeypatch.setattr(DATASETS, "_items", dict(DATASETS._items))
    register_dataset("one", matches=lambda path: (path / "one").is_file(), layout="a file 'one'")(OneFrame)


@pytest.mark.parametrize(
    ("places", "reader"),
    [
        (["drive/641/000068.yaml"], Opv2vRecording),
        (["test/drive/-1/000068.yaml"], Opv2vRecording),
        (["vehicle-side/data_info.json"], DairRecording),
        (["cooperative-vehicle-infrastructure/infrastructure-side/data_info.json"], DairRecording),
        (["city_SE3_egovehicle.feather"], Argoverse2Recording),
        (["val/log/city_SE3_egovehicle.feather"], Argoverse2Recording),
        (["drive/camera/000068.yaml", "lidar/1000.feather"], None),
        ([], None),
    ],
)
def test_a_layout_is_recognised_by_names_alone(
    tmp_path: Path, places: list[str], reader: type[RecordingReader] | None
) -> None:
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    own = (Opv2vRecording, DairRecording, Argoverse2Recording)
    assert set(own) <= set(DATASETS.load_all().values())
    assert [each for each in own if each.matches(tmp_path)] == ([] if reader is None else [reader])


def test_a_reader_needs_three_methods(registered: None, tmp_path: Path) -> None:
    (tmp_path / "one").touch()
    recording: Recording = open_recording(tmp_path, "val")
    assert isinstance(recording, OneFrame)
    (name,) = recording.scenarios
    assert (
        name == f"{tmp_path.name} val" and recording.eval_indices(name) == range(1) and recording.agents(name) == (4, 2)
    )
    assert recording.unreadable_scenarios == {"", "gone"}
    calls: list[tuple[int, int]] = []
    assert recording.verify(progress=lambda *call: calls.append(call)).count == 3 and calls == [(1, 1)]
    assert [problem.scenario for problem in recording.verify({"gone"}).files] == ["gone"]


def test_a_folder_of_no_layout_lists_what_was_searched(registered: None, tmp_path: Path) -> None:
    with pytest.raises(RecordingError) as caught:
        open_recording(tmp_path)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path}: no recording in a known layout (") and "\n" not in text
    for word in (
        "argoverse2: logs",
        "dair-v2x: folders vehicle-side",
        "opv2v: folders <scenario>",
        "one: a file 'one'",
    ):
        assert word in text
    with pytest.raises(RecordingError, match="nowhere: no such folder"):
        open_recording(tmp_path / "nowhere")


def test_a_folder_of_two_layouts_is_refused(registered: None, tmp_path: Path) -> None:
    (tmp_path / "vehicle-side").mkdir()
    (tmp_path / "one").touch()
    with pytest.raises(RecordingError, match=r"several data sets \(dair-v2x: [^;]*; one: a file 'one'\); keep one"):
        open_recording(tmp_path)


def test_pictures_of_a_reader_without_are_refused(registered: None, tmp_path: Path) -> None:
    (tmp_path / "one").touch()
    with pytest.raises(ConfigError, match="the reader of one reads no pictures"):
        open_recording(tmp_path, images=True)


def test_a_name_is_given_once(registered: None) -> None:
    with pytest.raises(ConfigError, match=r"'opv2v' is registered already, by manyeyes\.datasets\.opv2v\.reader"):
        register_dataset("opv2v", matches=Path.is_dir, layout="any")(OneFrame)
