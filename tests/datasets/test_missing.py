# SPDX-License-Identifier: Apache-2.0
"""Files that a recording lacks: every stem that one agent has is expected of all; scenarios are chosen by name."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from manyeyes.datasets.manifest import Digests, compute_total_digest, digest_files, list_scenario_files, read_manifest
from manyeyes.datasets.missing import MAX_LISTED, FileProblem, MissingFiles
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datatypes import AgentFrame, PointCloud, RecordingError, Snapshot, Transform


def snapshot(name: str, index: int) -> Snapshot:
    frames = []
    for agent in (3, 10, -1):
        cloud = PointCloud.of(torch.rand(20, 3, generator=torch.Generator().manual_seed(10 * index + agent)))
        pose = Transform.from_xyz_yaw(float(agent), 0)
        frames.append(
            AgentFrame(agent, index * 100_000_000, cloud, pose, torch.zeros(3, 3), is_infrastructure=agent < 0)
        )
    return Snapshot(name, index, tuple(frames), None)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("a", "b"):
        writer = Opv2vWriter(tmp_path / "root" / name)
        for index in range(3):
            writer.write(snapshot(name, index))
    return tmp_path / "root"


def missing(root: Path, scenarios: tuple[str, ...] | None = None) -> list[str]:
    found = Opv2vRecording(root, use_cache=False).verify(scenarios)
    assert found.count == len(found.files)
    return [f"{file.kind} {file.path.relative_to(root)}" for file in found.files]


def remove(*names: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        for name in names:
            (root / name).unlink()

    return damage


def empty_an_agent(root: Path) -> None:
    for path in (root / "a" / "3").iterdir():
        path.unlink()


ALL_OF_AN_AGENT = [f"a/3/00000{k}.{suffix}" for k in (0, 2, 4) for suffix in ("pcd", "yaml")]


@pytest.mark.parametrize(
    ("damage", "names"),
    [
        (lambda root: None, []),
        (remove("a/3/000002.yaml"), ["a/3/000002.yaml"]),
        (remove("a/10/000002.pcd"), ["a/10/000002.pcd"]),
        (remove("a/10/000002.pcd", "a/10/000002.yaml"), ["a/10/000002.pcd", "a/10/000002.yaml"]),
        (remove("a/-1/000000.pcd", "b/3/000004.yaml"), ["a/-1/000000.pcd", "b/3/000004.yaml"]),
        (empty_an_agent, ALL_OF_AN_AGENT),
    ],
)
def test_each_absent_file_is_named(root: Path, damage: Callable[[Path], None], names: list[str]) -> None:
    damage(root)
    assert missing(root) == [f"missing {name}" for name in names]


def test_chosen_scenarios_alone_are_verified(root: Path) -> None:
    remove("a/3/000002.yaml")(root)
    assert missing(root, ("b",)) == [] and missing(root, ("a",)) == ["missing a/3/000002.yaml"]
    seen: list[tuple[int, int]] = []
    Opv2vRecording(root, use_cache=False).verify(progress=lambda *at: seen.append(at))
    assert seen == [(1, 2), (2, 2)]


def test_a_scenario_without_files_is_missing_and_other_folders_are_not(root: Path) -> None:
    (root / "c" / "3").mkdir(parents=True)
    (root / "notes").mkdir()
    (root / "notes" / "plan.txt").write_text("")
    (root / "d.partial" / "3").mkdir(parents=True)
    recording = Opv2vRecording(root, use_cache=False)
    assert recording.scenarios == ("a", "b") and recording.unreadable_scenarios == {"c", "d"}
    assert missing(root) == ["missing c", "missing d.partial"]


def test_a_path_counts_once_and_the_list_is_capped() -> None:
    problems = [FileProblem(Path(f"{k:03d}.pcd"), "missing", "s", "why") for k in range(MAX_LISTED + 5)]
    found = MissingFiles.of([*problems, *problems])
    assert found.count == MAX_LISTED + 5 and found.files == tuple(problems[:MAX_LISTED])
    assert str(problems[0]) == "000.pcd: missing (why)"


def test_a_verification_is_cached_until_a_file_changes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def check(read: Callable[[int], Snapshot], name: str, clouds: object) -> list[FileProblem]:
        calls.append(name)
        return []

    monkeypatch.setattr("manyeyes.datasets.opv2v.reader.find_mismatched_files", check)
    for _ in range(2):
        Opv2vRecording(root, cache_folder=tmp_path / "cache").verify()
    assert calls == ["a", "b"]
    path = root / "b" / "3" / "000002.pcd"
    path.write_bytes(path.read_bytes())
    Opv2vRecording(root, cache_folder=tmp_path / "cache").verify()
    assert calls == ["a", "b", "b"]


def test_digests_compare_files_that_are_used(root: Path) -> None:
    folder = root / "a"
    (folder / "3" / "000000_camera0.png").write_bytes(b"picture")
    by_path = digest_files(list_scenario_files(folder), folder)
    digests = Digests(compute_total_digest(by_path), len(by_path), 0, by_path)
    (folder / "3" / "000000_camera0.png").write_bytes(b"another")
    (folder / "notes.txt").write_text("")
    (folder / "3" / "000006.pcd").write_bytes(b"")
    files = list_scenario_files(folder)
    found = digests.check(folder, "a", files)
    assert [(p.path.name, p.kind) for p in found] == [
        ("000000_camera0.png", "mismatched"),
        ("000006.pcd", "mismatched"),
    ]
    assert [p.path.name for p in digests.check(folder, "a", files, used=lambda name: name.endswith(".pcd"))] == [
        "000006.pcd"
    ]


@pytest.mark.parametrize("text", ["", "[]", '{"entry": 1}', '{"entry": {"sha256": "0"}}', '{"entry": {}, "files": []}'])
def test_a_file_without_digests_is_ignored(tmp_path: Path, text: str) -> None:
    (tmp_path / "scenario.json").write_text(text)
    assert Digests.read(tmp_path / "scenario.json") is None and Digests.read(tmp_path / "nowhere.json") is None


@pytest.mark.parametrize("text", ["", "[]", '{"format": "OPV2V"}', '{"format": 1, "settings": {}, "scenarios": []}'])
def test_a_manifest_of_another_tool_is_named(tmp_path: Path, text: str) -> None:
    assert read_manifest(tmp_path) is None
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(RecordingError, match=r"manifest.json: expected a manifest of 'manyeyes simulate'"):
        read_manifest(tmp_path)
