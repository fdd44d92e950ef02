# SPDX-License-Identifier: Apache-2.0
"""What a root in DAIR-V2X's layout holds: both sides' frames, the pairs of them, the splits, and what is missing."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from manyeyes.datasets.dair_v2x.json_files import get_offset
from manyeyes.datasets.formats.json_file import REMEDY, get_number, get_text, load_json, load_list
from manyeyes.datasets.missing import FileProblem
from manyeyes.datatypes import ConfigError, RecordingError

ARCHIVE = "cooperative-vehicle-infrastructure"
SPLIT_FILE = "cooperative-split-data.json"
_SEQUENCE_SPLIT_FILE = "cooperative-split-data-spd.json"
# Number of pairs of the official cooperative split.
OFFICIAL_PAIRS = {"train": 4813, "val": 1783, "test": 2688, "test_A": 851}
SIDES = ("vehicle-side", "infrastructure-side")
_LABEL_FOLDER = {"vehicle-side": "lidar", "infrastructure-side": "virtuallidar"}
_LABEL_KEYS = ("label_lidar_std_path", "label_lidar_path", "label_virtuallidar_path")
_MOTIONS = {"vehicle-side": ("novatel_to_world", "lidar_to_novatel"), "infrastructure-side": ("virtuallidar_to_world",)}


@dataclass(frozen=True)
class DairOptions:
    """Which of the data set's variants is read."""

    split_file: Path | str | None = None
    """The list of frames of splits; None: the official file in the root."""
    labels: Literal["cooperative", "sides"] = "cooperative"
    """The truth: the cooperative label, or the union of what the two sides list."""
    label_folder: str = "label_world"
    """Where the cooperative labels lie, such as ``label_world_backup`` of the complemented release."""
    delay_frames: int = 0
    """The infrastructure's sweep is so many sweeps older than the paired one (vic-async)."""
    native_pose_error: bool = False
    """The infrastructure's prior pose is that of its calibration, without the correction by hand that the truth keeps."""

    def __post_init__(self) -> None:
        if self.delay_frames < 0 or self.labels not in ("cooperative", "sides"):
            raise ConfigError(
                f"DairOptions needs labels 'cooperative' or 'sides' and delay_frames >= 0; got {self.labels!r}, "
                f"{self.delay_frames}."
            )


DEFAULT_OPTIONS = DairOptions()


@dataclass(frozen=True)
class SideFrame:
    """One sweep of one side. motions: files of world_from_lidar's factors, outermost first.

    batch: the drive it belongs to. height_m: of the LiDAR above the road, if the index has it (as in ours).
    """

    id: str
    batch: str
    timestamp_ns: int
    cloud: Path
    label: Path
    motions: tuple[Path, ...]
    height_m: float | None


@dataclass(frozen=True)
class DairPair:
    """A vehicle's sweep and an infrastructure's. label: the cooperative one, None where the file is not there.

    offset: the correction of the infrastructure's place in metres, None without one; offset_in_world: along the
    world's axes (DAIR-V2X), else along those of the vehicle's LiDAR (V2X-Seq). i2v: vehicle_from_infrastructure's file.
    """

    vehicle: SideFrame
    infrastructure: SideFrame
    label: Path | None
    offset: tuple[float, float] | None
    offset_in_world: bool
    i2v: Path


@dataclass(frozen=True)
class DairIndex:
    """Usable pairs by drive, in order of time; one line for each kind of thing that is missing, and a record for each file."""

    pairs: dict[str, tuple[DairPair, ...]]
    missing_summary: tuple[str, ...]
    missing_files: tuple[FileProblem, ...]


def find_dair_root(path: Path) -> Path | None:
    """Return the folder that holds the two sides: path itself, the official archive's folder in it, or None."""
    return next((p for p in (path, path / ARCHIVE) if any((p / side).is_dir() for side in SIDES)), None)


@dataclass
class _Side:
    """One side's index; frames are parsed when they are asked for."""

    root: Path
    name: str
    path: Path
    entries: dict[str, Mapping[str, Any]]
    _frames: dict[str, SideFrame] = field(default_factory=dict)
    _batches: dict[str, list[SideFrame]] = field(default_factory=dict)

    @classmethod
    def read(cls, root: Path, name: str) -> _Side:
        path = root / name / "data_info.json"
        rows = enumerate(load_list(path))
        return cls(root, name, path, {Path(get_text(path, e, "pointcloud_path", f"[{i}]")).stem: e for i, e in rows})

    def frame(self, id: str) -> SideFrame:
        if id not in self._frames:
            self._frames[id] = self._parse(id, self.entries[id])
        return self._frames[id]

    def _parse(self, id: str, entry: Mapping[str, Any]) -> SideFrame:
        folder = self.root / self.name
        label = next((entry[k] for k in _LABEL_KEYS if entry.get(k)), f"label/{_LABEL_FOLDER[self.name]}/{id}.json")
        motions = [entry.get(f"calib_{m}_path") or f"calib/{m}/{id}.json" for m in _MOTIONS[self.name]]
        batch = entry.get("batch_id", entry.get("sequence_id"))
        stamp = get_number(self.path, entry, "pointcloud_timestamp", id)
        height = None if entry.get("lidar_height_m") is None else get_number(self.path, entry, "lidar_height_m", id)
        # Microseconds since 1970 are exact in float64, hundreds of nanoseconds are not.
        return SideFrame(
            id,
            "0" if batch in (None, "") else str(batch),
            round(stamp) * 1000,
            folder / str(entry["pointcloud_path"]),
            folder / str(label),
            tuple(folder / str(m) for m in motions),
            height,
        )

    def before(self, frame: SideFrame, count: int) -> SideFrame | None:
        """Return the sweep that came so many sweeps of the same drive before; None where there is none."""
        if frame.batch not in self._batches:
            same = [self.frame(i) for i, e in self.entries.items() if self._is_of(e, frame.batch)]
            self._batches[frame.batch] = sorted(same, key=lambda f: (f.timestamp_ns, f.id))
        line = self._batches[frame.batch]
        at = line.index(frame) - count
        return line[at] if at >= 0 else None

    @staticmethod
    def _is_of(entry: Mapping[str, Any], batch: str) -> bool:
        found = entry.get("batch_id", entry.get("sequence_id"))
        return batch == ("0" if found in (None, "") else str(found))


class Sides:
    """Both sides of a root: which sweep came before another."""

    def __init__(self, root: Path) -> None:
        expected = [f"{name}/data_info.json" for name in (*SIDES, "cooperative")]
        missing = [name for name in expected if not (root / name).is_file()]
        if missing:
            raise RecordingError(
                f"{root}: expected DAIR-V2X's vehicle-side, infrastructure-side and cooperative folders with a "
                f"data_info.json each; missing: {', '.join(missing)}. Download what is missing."
            )
        self.vehicle, self.infrastructure = (_Side.read(root, name) for name in SIDES)


def read_index(root: Path, sides: Sides, ids: frozenset[str] | None, options: DairOptions) -> DairIndex:
    """Return the pairs whose files are all there; ids: of the vehicle's frames that count, None for all."""
    path = root / "cooperative" / "data_info.json"
    there = _Listing()
    missing_counts = _MissingCounts()
    drives: dict[str, list[DairPair]] = {}
    missing: list[FileProblem] = []
    entries = load_list(path)
    named = set()
    for row, entry in enumerate(entries):
        vehicle, infrastructure = (_frame_id(path, entry, side, row) for side in ("vehicle", "infrastructure"))
        named.add(vehicle)
        if ids is not None and vehicle not in ids:
            continue
        missing_counts.total += 1
        absent = next(
            (f"{s.path} has no frame {i}" for s, i in _both(sides, vehicle, infrastructure) if i not in s.entries), None
        )
        if absent is not None:
            missing_counts.note("an entry in the index of its side", absent)
            missing += _absent_entries(sides, vehicle, infrastructure)
            continue
        second: SideFrame | None = sides.infrastructure.frame(infrastructure)
        if options.delay_frames:
            second = sides.infrastructure.before(second, options.delay_frames)
            if second is None:
                missing_counts.note(
                    f"an infrastructure sweep {options.delay_frames} earlier", f"the first is frame {vehicle}"
                )
                continue
        pair = _pair(root, path, entry, row, sides.vehicle.frame(vehicle), second, options.label_folder)
        missing += _absent_files(pair, there)
        gone = next((f for f in _needed(pair, there) if not there.has(f)), None)
        if gone is not None:
            missing_counts.note(f"their {gone.parent.relative_to(root)} file", f"the first is {gone}")
            continue
        if pair.label is not None and not there.has(pair.label):
            missing_counts.note(
                "their cooperative label and have no truth", f"the first is {pair.label}", left_out=False
            )
            pair = DairPair(pair.vehicle, pair.infrastructure, None, pair.offset, pair.offset_in_world, pair.i2v)
        drives.setdefault(pair.vehicle.batch, []).append(pair)
    problems = missing_counts.lines(path)
    if ids is not None and ids - named:
        gone = sorted(ids - named)
        problems.append(
            f"{path}: {len(gone)} of the split's {len(ids)} frames are not in it, the first is {gone[0]}; left out"
        )
        clouds = (root / "vehicle-side" / "velodyne" / f"{id}.pcd" for id in gone)
        missing += (FileProblem(p, "missing", "", f"the split names this frame, {path.name} does not") for p in clouds)
    order = sorted(drives, key=lambda name: (not name.isdecimal(), int(name) if name.isdecimal() else 0, name))
    kept = {n: tuple(sorted(drives[n], key=lambda p: (p.vehicle.timestamp_ns, p.vehicle.id))) for n in order}
    return DairIndex(kept, tuple(problems), tuple(missing))


def _both(sides: Sides, vehicle: str, infrastructure: str) -> tuple[tuple[_Side, str], ...]:
    return (sides.vehicle, vehicle), (sides.infrastructure, infrastructure)


def _absent_entries(sides: Sides, vehicle: str, infrastructure: str) -> list[FileProblem]:
    """Return the frames of a pair that the index of their side does not have."""
    batch = sides.vehicle.frame(vehicle).batch if vehicle in sides.vehicle.entries else ""
    return [
        FileProblem(
            side.path.parent / "velodyne" / f"{id}.pcd", "missing", batch, f"{side.path.name} has no such frame"
        )
        for side, id in _both(sides, vehicle, infrastructure)
        if id not in side.entries
    ]


def _frame_id(path: Path, entry: Mapping[str, Any], side: str, row: int) -> str:
    """Return the frame's id: stated by V2X-Seq, the stem of the cloud in DAIR-V2X."""
    if f"{side}_frame" in entry:
        return get_text(path, entry, f"{side}_frame", f"[{row}]")
    return Path(get_text(path, entry, f"{side}_pointcloud_path", f"[{row}]")).stem


def _pair(
    root: Path, path: Path, entry: Mapping[str, Any], row: int, vehicle: SideFrame, second: SideFrame, folder: str
) -> DairPair:
    sequence = "vehicle_frame" in entry
    if sequence:
        label = root / "cooperative" / "label" / f"{vehicle.id}.json"
    else:
        label = root / get_text(path, entry, "cooperative_label_path", f"[{row}]")
        label = label.parent.with_name(folder) / label.name
    offset = get_offset(path, entry.get("system_error_offset"), f"[{row}].system_error_offset")
    i2v = root / "cooperative" / "calib" / "lidar_i2v" / f"{vehicle.id}.json"
    return DairPair(vehicle, second, label, offset, not sequence, i2v)


def _needed(pair: DairPair, there: _Listing) -> Iterable[Path]:
    """Yield files without which there is no snapshot; lidar_i2v stands in for the infrastructure's own calibration."""
    yield pair.vehicle.cloud
    yield pair.infrastructure.cloud
    yield from pair.vehicle.motions
    if not there.has(pair.i2v):
        yield from pair.infrastructure.motions


def _absent_files(pair: DairPair, there: _Listing) -> list[FileProblem]:
    """Return the files of a pair that are not there.

    Labels and calibrations of the infrastructure are absent only where their folder has others: some releases have none.
    """
    needed = list(_needed(pair, there))
    beside = [pair.vehicle.label, pair.infrastructure.label, *pair.infrastructure.motions]
    beside += [pair.label] if pair.label is not None else []
    absent = [p for p in needed if not there.has(p)]
    absent += [p for p in beside if p not in needed and not there.has(p) and there.any_in(p.parent)]
    return [FileProblem(p, "missing", pair.vehicle.batch, "the index names it") for p in absent]


class _Listing:
    """Which files are there; every folder is listed once."""

    def __init__(self) -> None:
        self._names: dict[Path, frozenset[str]] = {}

    def has(self, path: Path) -> bool:
        return path.name in self._in(path.parent)

    def any_in(self, folder: Path) -> bool:
        return bool(self._in(folder))

    def _in(self, folder: Path) -> frozenset[str]:
        if folder not in self._names:
            try:
                self._names[folder] = frozenset(os.listdir(folder))  # noqa: PTH208 - names are all that is wanted
            except OSError:
                self._names[folder] = frozenset()
        return self._names[folder]


class _MissingCounts:
    """How many pairs lack what, and the first that does."""

    def __init__(self) -> None:
        self.total = 0
        self._found: dict[str, tuple[int, str, bool]] = {}

    def note(self, what: str, first: str, left_out: bool = True) -> None:
        count, kept, _ = self._found.get(what, (0, first, left_out))
        self._found[what] = (count + 1, kept, left_out)

    def lines(self, path: Path) -> list[str]:
        return [
            f"{path}: {count} of {self.total} pairs lack {what}, {first}{'; left out' if out else ''}"
            for what, (count, first, out) in self._found.items()
        ]


def read_split_ids(root: Path, split: str, split_file: Path | str | None) -> frozenset[str]:
    """Return ids of the vehicle's frames of a split: under ``cooperative_split`` of the official file, or a bare list of ids."""
    places = (
        (Path(split_file),)
        if split_file is not None
        else tuple(root / name for name in (SPLIT_FILE, _SEQUENCE_SPLIT_FILE, f"{split}.json"))
    )
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        official = ", ".join(f"{name} {count}" for name, count in OFFICIAL_PAIRS.items())
        raise RecordingError(
            f"{root}: the split '{split}' needs a list of its frames, found none of {', '.join(map(str, places))}; "
            f"put the official {SPLIT_FILE} there (pairs: {official}), or name no split."
        )
    content = load_json(path)
    if isinstance(content, Mapping):
        content = content.get("cooperative_split")
        if not isinstance(content, Mapping) or split not in content:
            known = ", ".join(content) if isinstance(content, Mapping) else "no 'cooperative_split'"
            raise RecordingError(f"{path}: no split '{split}'; it has {known}: choose one of them.")
        content = content[split]
    if not isinstance(content, list) or not all(isinstance(id, str) for id in content):
        raise RecordingError(f"{path}: expected a list of frames' ids for the split '{split}'; {REMEDY}.")
    return frozenset(content)
