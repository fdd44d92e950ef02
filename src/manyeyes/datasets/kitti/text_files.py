# SPDX-License-Identifier: Apache-2.0
"""KITTI's text files: calibrations, poses, time stamps, labels of objects, tracklets.

Camera axes are x right, y down, z ahead; those of the LiDAR x ahead, y left, z up. A label is the middle of the bottom of a box in
the rectified camera frame, and ``rotation_y`` turns about the camera's y axis, 0 along x. A tracklet is the middle of the bottom in
the LiDAR's frame, ``rz`` its yaw.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from manyeyes._io import MAX_TEXT_BYTES, read_file
from manyeyes.datasets.object_types import find_label
from manyeyes.datatypes import Boxes, RecordingError, Transform
from manyeyes.datatypes.errors import shorten

REMEDY = "copy or download the file again"
_STAMP = re.compile(r"(\d{4}-\d{2}-\d{2} \d{2}:\d{2}:\d{2})(?:\.(\d{1,9}))?")
_MAX_TRACK_FRAMES = 1_000_000
# Box ids start here, so that none is the id of the agent, 0.
FIRST_BOX_ID = 100


def read_text(path: Path) -> str:
    """Return the content of a text file."""
    try:
        return read_file(path, MAX_TEXT_BYTES).decode()
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, expected a text file of KITTI; download it.") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise RecordingError(f"{path}: cannot be read ({reason}), expected a text file of KITTI; {REMEDY}.") from None


def read_matrix(path: Path, *keys: str, shape: tuple[int, int]) -> np.ndarray:
    """Return the numbers of a line ``KEY: numbers``, of the first key that the file has."""
    lines = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
    key = next((key for key in keys if key in lines), None)
    if key is None:
        raise RecordingError(f"{path}: expected a line {' or '.join(keys)}, found {', '.join(lines)[:80]}; {REMEDY}.")
    return parse_numbers(path, lines[key], shape[0] * shape[1], key).reshape(shape)


def parse_numbers(path: Path, text: str, count: int, where: str) -> np.ndarray:
    """Return so many finite numbers, float64; where: what is named in an error."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise RecordingError(f"{path}: expected {count} finite numbers at {where}, found {shorten(text)}; {REMEDY}.")
    return values


def to_motion(path: Path, matrix: np.ndarray, where: str) -> Transform:
    """Return the motion, float64, of rows (3, 4); published rotations are rounded, and replaced by the nearest true one."""
    left, scale, right = np.linalg.svd(matrix[:, :3])
    if np.abs(scale - 1).max() > 0.02 or np.linalg.det(matrix[:, :3]) < 0:
        raise RecordingError(
            f"{path}: {where} is no rigid motion (singular values {np.round(scale, 3).tolist()}); {REMEDY}."
        )
    return Transform(torch.from_numpy(left @ right), torch.from_numpy(matrix[:, 3].copy()))


def read_poses(path: Path) -> list[Transform]:
    """Return the motions of a file with one row of 3 x 4 numbers a line."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    rows = [parse_numbers(path, line, 12, f"line {n}").reshape(3, 4) for n, line in enumerate(lines, 1)]
    return [to_motion(path, row, f"line {n}") for n, row in enumerate(rows, 1)]


def read_stamps(path: Path) -> list[int]:
    """Return nanoseconds since 1970 of lines ``2011-09-26 13:02:25.951199337``."""
    found = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        match = _STAMP.fullmatch(line.strip())
        if match is None and line.strip():
            raise RecordingError(f"{path}: expected a date and time at line {number}, found {shorten(line)}; {REMEDY}.")
        if match is not None:
            try:
                seconds = int(datetime.fromisoformat(match[1]).replace(tzinfo=UTC).timestamp())
            except ValueError:
                raise RecordingError(f"{path}: no date at line {number}: {shorten(line)}; {REMEDY}.") from None
            found.append(seconds * 10**9 + int((match[2] or "0").ljust(9, "0")))
    return found


def read_labels(path: Path, lidar_from_camera: Transform) -> Boxes:
    """Return the labelled objects of one frame, in the LiDAR's frame, float64; ids are rows from FIRST_BOX_ID."""
    rows, labels = [], []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        label = find_label(words[0]) if words else None
        if label is None:
            continue
        values = parse_numbers(path, " ".join(words[1:15]), 14, f"line {number}")
        rows.append(values[7:])
        labels.append(label)
    table = torch.from_numpy(np.array(rows).reshape(-1, 7))
    height, width, length = table[:, :3].unbind(1)
    middle = lidar_from_camera.apply(table[:, 3:6])
    middle[:, 2] += height / 2
    ry = table[:, 6]
    ahead = torch.stack((ry.cos(), torch.zeros_like(ry), -ry.sin()), 1) @ lidar_from_camera.rotation.mT
    id = torch.arange(len(labels)) + FIRST_BOX_ID
    yaw = torch.atan2(ahead[:, 1], ahead[:, 0])
    return Boxes.of(middle, torch.stack((length, width, height), 1), yaw, label=_labels(labels), id=id)


def read_tracklets(path: Path, num_frames: int) -> list[Boxes]:
    """Return the tracked objects of each frame of a drive, in the LiDAR's frame, float64."""
    try:
        items = ElementTree.fromstring(read_text(path)).findall("tracklets/item")
        tracks = [row for track, item in enumerate(items) for row in _track_rows(item, track, num_frames)]
    except (ElementTree.ParseError, ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: expected KITTI's tracklets, found something else ({error}); {REMEDY}.") from None
    by_frame: list[list[tuple[int, int, list[float]]]] = [[] for _ in range(num_frames)]
    for frame, track, label, row in tracks:
        by_frame[frame].append((track, label, row))
    return [_tracked_boxes(rows) for rows in by_frame]


def _track_rows(item: ElementTree.Element, track: int, num_frames: int) -> Iterator[tuple[int, int, int, list[float]]]:
    """Yield (frame, track, label, [x, y, z, l, w, h, yaw]) of each frame of one object."""
    label = find_label(_field(item, "objectType"))
    if label is None:
        return
    height, width, length = (_number(item, key) for key in "hwl")
    first = int(_field(item, "first_frame"))
    for frame, pose in enumerate(item.findall("poses/item"), first):
        if not 0 <= frame < min(num_frames, _MAX_TRACK_FRAMES):
            continue
        x, y, z, yaw = (_number(pose, key) for key in ("tx", "ty", "tz", "rz"))
        yield frame, track, label, [x, y, z + height / 2, length, width, height, yaw]


def _tracked_boxes(rows: list[tuple[int, int, list[float]]]) -> Boxes:
    table = torch.tensor([row[2] for row in rows], dtype=torch.float64).reshape(-1, 7)
    id = torch.tensor([row[0] for row in rows], dtype=torch.int64) + FIRST_BOX_ID
    return Boxes.of(table[:, :3], table[:, 3:6], table[:, 6], label=_labels([row[1] for row in rows]), id=id)


def _labels(labels: list[int]) -> Tensor:
    return torch.tensor(labels, dtype=torch.int64)


def _field(item: ElementTree.Element, key: str) -> str:
    text = item.findtext(key)
    if text is None:
        raise ValueError(f"an item without {key}")
    return text.strip()


def _number(item: ElementTree.Element, key: str) -> float:
    value = float(_field(item, key))
    if not math.isfinite(value):
        raise ValueError(f"{key} is {value}")
    return value
