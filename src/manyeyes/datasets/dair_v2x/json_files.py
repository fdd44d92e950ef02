# SPDX-License-Identifier: Apache-2.0
"""Readers of DAIR-V2X's JSON files: numbers that may be strings, calibrations, labels of one side and of both.

Lengths are metres and angles radians on disk. Vehicles are ``Car``, ``Van``, ``Truck`` and ``Bus``, in any case of letters; behind
them come ``Pedestrian``, ``Cyclist``, ``Tricyclist`` (a cyclist here, as in the benchmark) and ``Motorcyclist``. Everything else is
left out, and so is a box without size, as in the official reader.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.datasets.formats.json_file import (
    REMEDY,
    get_array,
    get_field,
    get_number,
    get_text,
    join_path,
    load_json,
    load_list,
)
from manyeyes.datasets.object_types import find_label
from manyeyes.datatypes import VEHICLE_LABELS, Boxes, RecordingError, Transform
from manyeyes.datatypes.errors import shorten

# Published calibrations are rounded; a mirrored or sheared one is farther off than this.
_NOT_A_ROTATION = 0.02
# Ids of people, where a file does not track all that it lists.
_FIRST_UNTRACKED_ID = 1_000_000_000


def read_calibration(path: Path) -> Transform:
    """Read target_from_source of ``{rotation, translation}``, or of such a thing under ``transform``; float64.

    The rotation is replaced by the nearest true one, because published matrices are rounded.
    """
    return _motion(path, load_json(path))


def _motion(path: Path, content: Any) -> Transform:
    inner = content.get("transform", content) if isinstance(content, Mapping) else content
    json_path = "transform" if inner is not content else ""
    rotation = get_array(path, get_field(path, inner, "rotation", json_path), (3, 3), join_path(json_path, "rotation"))
    translation = get_array(
        path, get_field(path, inner, "translation", json_path), (3,), join_path(json_path, "translation")
    )
    left, scale, right = np.linalg.svd(rotation)
    if np.abs(scale - 1).max() > _NOT_A_ROTATION or np.linalg.det(rotation) < 0:
        raise RecordingError(
            f"{path}: '{join_path(json_path, 'rotation')}' is no rotation (singular values {np.round(scale, 3).tolist()}, "
            f"determinant {np.linalg.det(rotation):.3f}), expected an orthonormal, right-handed matrix; {REMEDY}."
        )
    return Transform(torch.from_numpy(left @ right), torch.from_numpy(translation))


def read_infrastructure_calibration(path: Path) -> tuple[Transform, tuple[float, float]]:
    """Read world_from_virtuallidar, and its ``relative_error``: metres along the world's x and y, 0 where it is blank."""
    content = load_json(path)
    error = content.get("relative_error") if isinstance(content, Mapping) else None
    return _motion(path, content), get_offset(path, error or None, "relative_error") or (0.0, 0.0)


def get_offset(path: Path, found: Any, json_path: str) -> tuple[float, float] | None:
    """Return ``{delta_x, delta_y}`` in metres; None where there is none, or where an empty string stands for it."""
    if found is None or found == "":
        return None
    return get_number(path, found, "delta_x", json_path, 0.0), get_number(path, found, "delta_y", json_path, 0.0)


def read_side_labels(path: Path) -> Boxes:
    """Return vehicles that one side lists, in its LiDAR's frame, float64: ``3d_location`` is the middle, ``rotation`` the yaw."""
    places: list[list[float]] = []
    kept: list[tuple[int, int]] = []
    for row, entry, label in _objects(path):
        size = _size(path, entry, row)
        if min(size) <= 0:
            continue
        location = get_field(path, entry, "3d_location", f"[{row}]")
        middle = [get_number(path, location, axis, f"[{row}].3d_location") for axis in "xyz"]
        places.append([*middle, *size, get_number(path, entry, "rotation", f"[{row}]")])
        kept.append((label, _track(path, entry, row)))
    table = torch.tensor(places, dtype=torch.float64).reshape(-1, 7)
    return _boxes(table[:, :3], table[:, 3:6], table[:, 6], kept)


def read_world_labels(path: Path) -> Boxes:
    """Return vehicles of a cooperative label in the world frame, float64, by ``world_8_points`` alone.

    The corners run front left, front right, rear right, rear left at the bottom, then the same at the top. ``rotation`` is
    not the yaw in the world, and the format's own description calls all but type and corners unusable.
    """
    corners: list[np.ndarray] = []
    kept: list[tuple[int, int]] = []
    for row, entry, label in _objects(path):
        where = f"[{row}].world_8_points"
        found = get_array(path, get_field(path, entry, "world_8_points", f"[{row}]"), (8, 3), where)
        if not np.ptp(found, axis=0).any():
            continue
        corners.append(found)
        kept.append((label, _track(path, entry, row)))
        _check_corners(path, found, where)
    table = torch.from_numpy(np.stack(corners)) if corners else torch.zeros(0, 8, 3, dtype=torch.float64)
    ahead, aside, up = _axes(table)
    size = torch.stack((ahead.norm(dim=-1), aside.norm(dim=-1), up.norm(dim=-1)), -1)
    return _boxes(table.mean(1), size, torch.atan2(ahead[:, 1], ahead[:, 0]), kept)


def _axes(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return edges (N, 3) of boxes' corners (N, 8, 3): from rear to front, from right to left, from bottom to top."""

    def edge(to: list[int], start: list[int]) -> torch.Tensor:
        return corners[:, to].mean(1) - corners[:, start].mean(1)

    return edge([0, 1, 4, 5], [2, 3, 6, 7]), edge([0, 3, 4, 7], [1, 2, 5, 6]), edge([4, 5, 6, 7], [0, 1, 2, 3])


def _check_corners(path: Path, corners: np.ndarray, where: str) -> None:
    """Refuse corners in another order: they would give a mirrored, tilted or upturned box without an error."""
    ahead, aside, up = (axis[0].numpy() for axis in _axes(torch.from_numpy(corners[None])))
    volume = float(np.linalg.det(np.stack((ahead, aside, up))))
    full = float(np.linalg.norm(ahead) * np.linalg.norm(aside) * np.linalg.norm(up))
    if up[2] <= 0 or volume < 0.9 * full:
        raise RecordingError(
            f"{path}: expected at '{where}' the corners front left, front right, rear right, rear left at the bottom, "
            f"then at the top; found edges ahead {np.round(ahead, 2).tolist()}, to the left {np.round(aside, 2).tolist()}, "
            f"up {np.round(up, 2).tolist()}; {REMEDY}."
        )


def _objects(path: Path) -> list[tuple[int, Mapping[str, Any], int]]:
    """Return row, entry and index into LABELS of every vehicle and person in a label file, vehicles first."""
    rows = [(r, e, find_label(get_text(path, e, "type", f"[{r}]"))) for r, e in enumerate(load_list(path))]
    found = [(row, entry, label) for row, entry, label in rows if label is not None]
    return sorted(found, key=lambda one: one[2] >= len(VEHICLE_LABELS))


def _size(path: Path, entry: Mapping[str, Any], row: int) -> list[float]:
    sizes = get_field(path, entry, "3d_dimensions", f"[{row}]")
    return [get_number(path, sizes, axis, f"[{row}].3d_dimensions") for axis in "lwh"]


def _track(path: Path, entry: Mapping[str, Any], row: int) -> int:
    """Return ``track_id`` (V2X-Seq), or -1 where there is none."""
    if entry.get("track_id") in (None, ""):
        return -1
    value = get_number(path, entry, "track_id", f"[{row}]")
    if value < 0 or value != int(value):
        raise RecordingError(
            f"{path}: expected a whole number >= 0 at '[{row}].track_id', found {shorten(entry['track_id'])}; {REMEDY}."
        )
    return int(value)


def _boxes(center: torch.Tensor, size: torch.Tensor, yaw: torch.Tensor, kept: list[tuple[int, int]]) -> Boxes:
    """Return ids: track_id + 1 where all have one and none has it twice, else rows from 1: id 0 is the ego's own body.

    People, who stand behind the vehicles, change no vehicle's id.
    """
    vehicles = [track for label, track in kept if label < len(VEHICLE_LABELS)]
    everyone = [track for _, track in kept]
    others = everyone[len(vehicles) :]
    ids = [t + 1 for t in vehicles] if _are_tracks(vehicles) else list(range(1, len(vehicles) + 1))
    ids += [t + 1 for t in others] if _are_tracks(everyone) else [_FIRST_UNTRACKED_ID + n for n in range(len(others))]
    label = torch.tensor([label for label, _ in kept], dtype=torch.int64)
    return Boxes.of(center, size, yaw, label=label, id=torch.tensor(ids, dtype=torch.int64))


def _are_tracks(tracks: list[int]) -> bool:
    return min(tracks, default=0) >= 0 and len(set(tracks)) == len(tracks)
