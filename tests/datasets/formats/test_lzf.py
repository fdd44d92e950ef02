# SPDX-License-Identifier: Apache-2.0
"""LZF there and back, and compressed clouds that are written."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.datasets.formats.lzf import lzf_compress, lzf_decompress
from manyeyes.datasets.formats.pcd import PcdTable, read_pcd, read_table, write_table
from manyeyes.datatypes import RecordingError


@given(st.lists(st.tuples(st.binary(max_size=5), st.integers(1, 400)), max_size=12))
def test_compression_round_trips(parts: list[tuple[bytes, int]]) -> None:
    plain = b"".join(part * count for part, count in parts)
    packed = lzf_compress(plain)
    assert lzf_decompress(packed, len(plain)) == plain
    assert len(packed) <= len(plain) + len(plain) // 32 + 1


def test_copies_reach_far_and_not_too_far() -> None:
    noise = np.random.default_rng(0).integers(0, 256, 8192, dtype=np.uint8).tobytes()
    for gap in (8190, 8192, 8193):
        plain = b"the same eight words" + noise[: gap - 20] + b"the same eight words"
        assert lzf_decompress(lzf_compress(plain), len(plain)) == plain


def test_streams_by_hand() -> None:
    assert lzf_compress(b"abc") == bytes([2]) + b"abc"
    # One literal, 264 copies of what is one byte back, then 35 bytes from 264 back.
    assert lzf_compress(b"a" * 300) == bytes([0]) + b"a" + bytes([7 << 5, 264 - 9, 0]) + bytes([7 << 5 | 1, 35 - 9, 7])


def test_a_table_of_any_types_reads_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    columns = (
        *rng.normal(0, 30, (3, 500)).astype(np.float32),
        rng.integers(0, 256, 500).astype(np.uint8),
        1.6e9 + np.linspace(0, 0.1, 500),
        rng.integers(-9, 9, 500).astype(">i2"),
    )
    names = ("x", "y", "z", "intensity", "timestamp", "ring")
    for name in ("a.pcd", "b.pcd"):
        write_table(tmp_path / name, PcdTable(names, columns))
    assert (tmp_path / "a.pcd").read_bytes() == (tmp_path / "b.pcd").read_bytes()
    header = (tmp_path / "a.pcd").read_bytes().split(b"DATA binary_compressed\n")[0].decode()
    assert "SIZE 4 4 4 1 8 2\nTYPE F F F U F I\nCOUNT 1 1 1 1 1 1\nWIDTH 500\n" in header
    found = read_table(tmp_path / "a.pcd")
    assert found.names == names
    assert all(np.array_equal(one, other) for one, other in zip(found.columns, columns))
    write_table(tmp_path / "none.pcd", PcdTable(names, tuple(c[:0] for c in columns)))
    assert read_pcd(tmp_path / "none.pcd").xyz.shape == (0, 3)


def test_columns_of_two_lengths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"a.pcd: expected one column \(N,\) for each of x y; got shapes \(2,\), \(3,\)"
    ):
        write_table(tmp_path / "a.pcd", PcdTable(("x", "y"), (np.zeros(2), np.zeros(3))))
    assert list(tmp_path.iterdir()) == []
