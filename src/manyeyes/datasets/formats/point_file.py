# SPDX-License-Identifier: Apache-2.0
"""Clouds without a header: ``.bin`` files of float32 x, y, z, intensity, as KITTI and V2X-Real have them; and numpy's
``.npz`` archives and ``.npy`` arrays.

An intensity that exceeds 1 anywhere in a file counts to 255. Points are in the file's own frame.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from manyeyes._io import MAX_FILE_BYTES, read_file, unpack_zip_member
from manyeyes.datasets.formats.pcd import PcdCloud, read_pcd
from manyeyes.datatypes import RecordingError

SUFFIXES = (".bin", ".pcd", ".npz", ".npy")
_REMEDY = "copy or download the file again"


def read_cloud(path: Path, drop_nan: bool = False) -> PcdCloud:
    """Read a cloud by the suffix of its file, one of SUFFIXES.

    Raises:
        RecordingError: the file is missing, damaged or of another type, or a point is NaN and drop_nan is False.
    """
    readers = {".bin": read_bin, ".pcd": read_pcd, ".npz": read_npz, ".npy": read_npy}
    if path.suffix not in readers:
        raise RecordingError(
            f"{path}: expected a cloud that ends with {', '.join(SUFFIXES)}; convert it to one of them."
        )
    return readers[path.suffix](path, drop_nan)


def read_bin(path: Path, drop_nan: bool = False, columns: int = 4) -> PcdCloud:
    """Read rows of float32 (little endian): x, y, z, metres, then intensity, then others that are not used."""
    data = _read(path, f"float32 rows of {columns}")
    if len(data) % (4 * columns):
        raise RecordingError(
            f"{path}: {len(data)} bytes, expected a multiple of {4 * columns} (float32 x, y, z, intensity); {_REMEDY}, or name "
            "another number of columns."
        )
    table = np.frombuffer(data, "<f4").reshape(-1, columns)
    return make_cloud(path, table[:, :3], table[:, 3] if columns > 3 else None, drop_nan)


def read_npz(path: Path, drop_nan: bool = False) -> PcdCloud:
    """Read arrays ``points`` (N, 3), metres, and ``intensity`` (N,) where it is there; or ``points`` (N, 4) with both."""
    try:
        with zipfile.ZipFile(io.BytesIO(_read(path, "an archive of numpy arrays"))) as archive:
            names = set(archive.namelist())
            if "points.npy" not in names:
                raise RecordingError(
                    f"{path}: expected an array 'points', found {', '.join(sorted(names)[:8])}; save one."
                )
            points = _load(archive, "points.npy", path)
            intensity = _load(archive, "intensity.npy", path) if "intensity.npy" in names else None
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise RecordingError(
            f"{path}: expected an archive of numpy arrays, found something else ({error}); {_REMEDY}."
        ) from None
    return _make_array_cloud(path, points, intensity, drop_nan)


def read_npy(path: Path, drop_nan: bool = False) -> PcdCloud:
    """Read one array of points: (N, 3), metres, or (N, 4) with their intensities."""
    try:
        points = _parse_array(_read(path, "an array of numpy"))
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path}: expected an array of numpy, found something else ({error}); {_REMEDY}."
        ) from None
    if not isinstance(points, np.ndarray):
        raise RecordingError(f"{path}: expected an array of numpy, found an archive; name it .npz.")
    return _make_array_cloud(path, points, None, drop_nan)


def _make_array_cloud(path: Path, points: np.ndarray, intensity: np.ndarray | None, drop_nan: bool) -> PcdCloud:
    """Check points (N, 3) or (N, 4) and intensities (N,), and make a cloud of them."""
    if points.ndim != 2 or points.shape[1] not in (3, 4) or points.dtype.kind not in "fiu":
        raise RecordingError(
            f"{path}: expected 'points' (N, 3) or (N, 4) of numbers, found {points.dtype} {points.shape}; save such an array."
        )
    if intensity is None and points.shape[1] == 4:
        intensity = points[:, 3]
    if intensity is not None and (intensity.shape != points.shape[:1] or intensity.dtype.kind not in "fiu"):
        raise RecordingError(
            f"{path}: expected 'intensity' ({len(points)},) of numbers, found {intensity.dtype} {intensity.shape}."
        )
    return make_cloud(path, points[:, :3], intensity, drop_nan)


def make_cloud(path: Path, xyz: np.ndarray, intensity: np.ndarray | None, drop_nan: bool) -> PcdCloud:
    """Return a cloud of points (N, 3) and intensities (N,) of any scale, without those that are NaN; path: for error texts."""
    points = np.ascontiguousarray(xyz, np.float32)
    whole = np.asarray(np.isfinite(points).all(axis=1))
    if not whole.all() and not drop_nan:
        raise RecordingError(
            f"{path}: {int((~whole).sum())} of {len(whole)} points are NaN or infinite, expected none; "
            "read with drop_nan=True to leave them out."
        )
    bright = np.zeros(len(points), np.float32) if intensity is None else scale_intensity(intensity)
    return PcdCloud(points[whole], bright[whole]) if not whole.all() else PcdCloud(points, bright)


def scale_intensity(stated: np.ndarray) -> np.ndarray:
    """Return (N,) float32 in [0, 1]: integers over their type's largest value; floats as they are, or over 255 if any exceeds 1."""
    if stated.dtype.kind in "ui":
        return np.clip(stated.astype(np.float32) / np.float32(np.iinfo(stated.dtype).max), 0, 1)
    bright = np.nan_to_num(np.asarray(stated, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return np.clip(bright / np.float32(255) if bright.size and bright.max() > 1 else bright, 0, 1)


def _read(path: Path, expected: str) -> bytes:
    try:
        return read_file(path)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, expected {expected}; {_REMEDY}.") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}), expected {expected}; {_REMEDY}.") from None


def _load(archive: zipfile.ZipFile, name: str, path: Path) -> np.ndarray:
    return _parse_array(unpack_zip_member(archive, name, MAX_FILE_BYTES, path))


def _parse_array(data: bytes) -> np.ndarray:
    """Parse an array of numpy; ValueError where it is none, or its header states more than the memory holds."""
    try:
        return np.load(io.BytesIO(data), allow_pickle=False)
    except (EOFError, OverflowError, MemoryError) as error:
        raise ValueError(str(error)) from None
