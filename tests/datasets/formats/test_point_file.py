# SPDX-License-Identifier: Apache-2.0
"""Clouds without a header: bytes written by hand, scales of intensity, damaged files."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datasets.formats.pcd import write_pcd
from manyeyes.datasets.formats.point_file import read_bin, read_cloud, read_npz
from manyeyes.datatypes import RecordingError

XYZ = np.array([[1.5, -2.0, 0.25], [30.0, 4.0, -1.0], [0.0, 0.5, 2.0]], np.float32)


def test_rows_of_a_bin_file_are_x_y_z_intensity(tmp_path: Path) -> None:
    path = tmp_path / "0.bin"
    path.write_bytes(np.array([[1.5, -2.0, 0.25, 0.5], [30.0, 4.0, -1.0, 1.0]], "<f4").tobytes())
    cloud = read_bin(path)
    assert cloud.xyz.tolist() == [[1.5, -2.0, 0.25], [30.0, 4.0, -1.0]] and cloud.intensity.tolist() == [0.5, 1.0]
    assert read_cloud(path).xyz.tolist() == cloud.xyz.tolist()


def test_an_intensity_above_one_counts_to_255(tmp_path: Path) -> None:
    path = tmp_path / "0.bin"
    path.write_bytes(np.array([[0, 0, 0, 51], [1, 1, 1, 255]], "<f4").tobytes())
    assert read_bin(path).intensity.tolist() == pytest.approx([0.2, 1.0])


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"points": XYZ}, [0, 0, 0]),
        ({"points": XYZ, "intensity": np.array([0, 51, 255], np.uint8)}, [0, 0.2, 1]),
        ({"points": XYZ.astype(np.float64), "intensity": np.array([0.0, 0.25, 1.0])}, [0, 0.25, 1]),
        ({"points": np.concatenate((XYZ, [[0.1], [0.2], [0.3]]), 1)}, [0.1, 0.2, 0.3]),
    ],
)
def test_arrays_of_an_npz_archive(tmp_path: Path, arrays: dict[str, np.ndarray], expected: list[float]) -> None:
    np.savez_compressed(tmp_path / "0.npz", **arrays)
    cloud = read_cloud(tmp_path / "0.npz")
    assert cloud.xyz.tolist() == XYZ.tolist() and cloud.intensity.tolist() == pytest.approx(expected)


def test_an_array_of_numpy_has_three_or_four_columns(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.concatenate((XYZ, [[0.1], [0.2], [0.3]]), 1))
    np.save(tmp_path / "1.npy", XYZ)
    np.save(tmp_path / "2.npy", XYZ[:, :2])
    bright, plain = read_cloud(tmp_path / "0.npy"), read_cloud(tmp_path / "1.npy")
    assert bright.xyz.tolist() == plain.xyz.tolist() == XYZ.tolist()
    assert bright.intensity.tolist() == pytest.approx([0.1, 0.2, 0.3]) and plain.intensity.tolist() == [0, 0, 0]
    with pytest.raises(RecordingError, match=r"found float32 \(3, 2\)"):
        read_cloud(tmp_path / "2.npy")


@pytest.mark.parametrize("rows", [10**4, 10**15, 10**30])
def test_an_array_whose_header_states_more_points_than_the_file_has_is_named(tmp_path: Path, rows: int) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (rows, 4)})
    (tmp_path / "0.npy").write_bytes(header.getvalue() + bytes(64))
    with zipfile.ZipFile(tmp_path / "0.npz", "w") as archive:
        archive.writestr("points.npy", header.getvalue() + bytes(64))
    for name in ("0.npy", "0.npz"):
        with pytest.raises(RecordingError, match=rf"{name}: expected an a\w+ of numpy"):
            read_cloud(tmp_path / name)


def test_a_pcd_file_is_read_by_its_suffix(tmp_path: Path) -> None:
    write_pcd(tmp_path / "0.pcd", XYZ, np.array([0, 0.2, 1]))
    assert read_cloud(tmp_path / "0.pcd").xyz.tolist() == XYZ.tolist()


def test_points_that_are_nan_are_an_error_or_dropped(tmp_path: Path) -> None:
    (tmp_path / "0.bin").write_bytes(np.array([[0, 0, 0, 0], [np.nan, 1, 1, 1]], "<f4").tobytes())
    with pytest.raises(RecordingError, match="1 of 2 points"):
        read_bin(tmp_path / "0.bin")
    assert read_bin(tmp_path / "0.bin", drop_nan=True).xyz.tolist() == [[0, 0, 0]]


@pytest.mark.parametrize(
    ("name", "data", "text"),
    [
        ("0.bin", b"12345", "multiple of 16"),
        ("0.npz", b"no archive", "archive of numpy arrays"),
        ("0.las", b"", "ends with .bin, .pcd, .npz, .npy"),
        ("0.npy", b"no array", "expected an array of numpy"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, data: bytes, text: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(RecordingError, match=text) as caught:
        read_cloud(tmp_path / name)
    assert name in str(caught.value)


def test_a_missing_file_and_arrays_of_wrong_shape_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"1\.bin: no such file"):
        read_cloud(tmp_path / "1.bin")
    for arrays, text in (
        ({"cloud": XYZ}, "array 'points'"),
        ({"points": XYZ[:, :2]}, r"\(N, 3\)"),
        ({"points": XYZ, "intensity": np.zeros(2)}, "intensity"),
        ({"points": np.array([{}], object)}, "archive of numpy"),
    ):
        np.savez(tmp_path / "0.npz", **arrays)
        with pytest.raises(RecordingError, match=text):
            read_npz(tmp_path / "0.npz")
