# SPDX-License-Identifier: Apache-2.0
"""PCD files of every encoding, whole and damaged."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from manyeyes.datasets.formats.cache import ArrayCache
from manyeyes.datasets.formats.lzf import lzf_decompress
from manyeyes.datasets.formats.pcd import read_pcd, read_table, write_float_pcd, write_pcd
from manyeyes.datatypes import RecordingError

OPV2V_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA {data}
"""


def cloud(n: int = 256, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points in tens of metres, and every 8-bit intensity in turn."""
    xyz = np.random.default_rng(seed).normal(0, 30, (n, 3)).astype(np.float32)
    return xyz, (np.arange(n) % 256).astype(np.uint32)


def write_ascii(path: Path, xyz: np.ndarray, red: np.ndarray, n: int | None = None) -> None:
    """As OPV2V's ascii release: intensity in the red byte of a float that is printed as a denormal."""
    # By integers alone: 0x00RR0000 as float32 is the multiple 0xRR0000 of 2**-149, for these bits are below 2**-125.
    packed = (red.astype(np.float64) * 65536) * 2.0**-149
    lines = [f"{float(x)!r} {float(y)!r} {float(z)!r} {float(c):.17g}\n" for (x, y, z), c in zip(xyz, packed)]
    path.write_text(OPV2V_HEADER.format(n=len(xyz) if n is None else n, data="ascii") + "".join(lines))


def lzf_compress(data: bytes) -> bytes:
    """Greedy LZF of the test's own: three-byte matches by a table, runs of literals between them."""
    out, literals, last = bytearray(), bytearray(), {}
    at = 0
    while at < len(data):
        key = data[at : at + 3]
        start = last.get(key, -1) if len(key) == 3 else -1
        last[key] = at
        distance = at - start - 1
        if start < 0 or distance >= 8192:
            literals.append(data[at])
            at += 1
            if len(literals) == 32:
                out += bytes([31]) + literals
                literals = bytearray()
            continue
        if literals:
            out += bytes([len(literals) - 1]) + literals
            literals = bytearray()
        length = 3
        while length < 264 and at + length < len(data) and data[start + length] == data[at + length]:
            length += 1
        code = length - 2
        out += bytes([(min(code, 7) << 5) | (distance >> 8)])
        out += bytes([code - 7]) if code >= 7 else b""
        out += bytes([distance & 255])
        at += length
    return bytes(out + (bytes([len(literals) - 1]) + literals if literals else b""))


def write_dair(path: Path, columns: list[np.ndarray], packed: bytes | None = None) -> None:
    """DAIR-V2X's vehicle layout: binary_compressed, one field after the other, uint8 intensity, float64 time."""
    plain = b"".join(c.tobytes() for c in columns)
    packed = lzf_compress(plain) if packed is None else packed
    n = len(columns[0])
    header = (
        "VERSION 0.7\nFIELDS x y z intensity timestamp\nSIZE 4 4 4 1 8\nTYPE F F F U F\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary_compressed\n"
    )
    path.write_bytes(header.encode() + np.array([len(packed), len(plain)], "<u4").tobytes() + packed)


def dair_columns(n: int = 3000) -> list[np.ndarray]:
    # Whole metres repeat, so that the compressor finds matches, long ones and overlapping ones too.
    axes = [np.rint(np.random.default_rng(i).normal(0, 3, n)).astype("<f4") for i in range(3)]
    axes[2][1000:2000] = -1.5
    return [*axes, (1 + np.arange(n) % 254).astype(np.uint8), np.linspace(0, 0.1, n).astype("<f8")]


@pytest.mark.parametrize("flush", [False, True])
def test_every_ascii_intensity_survives_though_it_is_a_denormal(tmp_path: Path, flush: bool) -> None:
    xyz, red = cloud()
    write_ascii(tmp_path / "a.pcd", xyz, red)
    assert "1.7" in (tmp_path / "a.pcd").read_text() and "e-38" in (tmp_path / "a.pcd").read_text()
    torch.set_flush_denormal(flush)
    try:
        found = read_pcd(tmp_path / "a.pcd")
    finally:
        torch.set_flush_denormal(False)
    assert np.array_equal(found.xyz, xyz)
    assert np.array_equal(np.rint(found.intensity * 255), red)
    assert found.intensity.max() == 1 and found.time_s is None


def test_files_round_trip_and_are_deterministic(tmp_path: Path) -> None:
    xyz, red = cloud(1000)
    for name in ("a.pcd", "b.pcd"):
        write_pcd(tmp_path / name, xyz, red / 255)
    assert (tmp_path / "a.pcd").read_bytes() == (tmp_path / "b.pcd").read_bytes()
    assert (tmp_path / "a.pcd").read_bytes().startswith(OPV2V_HEADER.format(n=1000, data="binary").encode())
    found = read_pcd(tmp_path / "a.pcd")
    assert np.array_equal(found.xyz, xyz) and np.array_equal(np.rint(found.intensity * 255), red)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pcd", "b.pcd"]


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_an_empty_cloud_is_a_cloud(tmp_path: Path, data: str) -> None:
    (tmp_path / "a.pcd").write_text(OPV2V_HEADER.format(n=0, data=data))
    assert read_pcd(tmp_path / "a.pcd").xyz.shape == (0, 3)


def test_binary_fields_of_any_type_count_and_order(tmp_path: Path) -> None:
    layout = np.dtype([("i", "u1"), ("pad", "u1", (3,)), ("z", "<f8"), ("y", "<f4"), ("x", "<f4"), ("ring", "<u2")])
    record = np.zeros(5, layout)
    record["i"], record["x"], record["y"], record["z"], record["ring"] = [0, 51, 102, 204, 255], 1, 2, np.arange(5), 7
    header = (
        "VERSION .7\nFIELDS intensity _ z y x ring\nSIZE 1 1 8 4 4 2\nTYPE U U F F F U\nCOUNT 1 3 1 1 1 1\n"
        "WIDTH 5\nHEIGHT 1\nPOINTS 5\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + record.tobytes())
    found = read_pcd(tmp_path / "a.pcd")
    assert found.xyz.tolist() == [[1, 2, z] for z in range(5)]
    assert found.intensity.tolist() == pytest.approx([0, 0.2, 0.4, 0.8, 1.0])
    assert read_table(tmp_path / "a.pcd").column("ring").tolist() == [7] * 5


def test_float_intensity_is_kept_unless_it_reaches_255(tmp_path: Path) -> None:
    for top, wanted in ((1.0, [0, 0.5, 1]), (255.0, [0, 0.5, 1])):
        text = OPV2V_HEADER.format(n=3, data="ascii").replace("rgb", "intensity")
        (tmp_path / "a.pcd").write_text(text + "".join(f"0 0 0 {v * top}\n" for v in (0, 0.5, 1)))
        assert read_pcd(tmp_path / "a.pcd").intensity.tolist() == pytest.approx(wanted)


def test_written_float_intensity_is_exact(tmp_path: Path) -> None:
    xyz, intensity = np.arange(12, dtype=np.float32).reshape(4, 3), np.float32([0, 0.1234567, 1, 1.5])
    write_float_pcd(tmp_path / "a.pcd", xyz, intensity)
    cloud = read_pcd(tmp_path / "a.pcd")
    assert np.array_equal(cloud.xyz, xyz)
    assert np.array_equal(cloud.intensity, intensity.clip(0, 1))


def test_compressed_clouds_of_dair(tmp_path: Path) -> None:
    columns = dair_columns()
    write_dair(tmp_path / "a.pcd", columns)
    assert (tmp_path / "a.pcd").stat().st_size < 0.7 * sum(c.nbytes for c in columns)  # else no match is tested
    found = read_pcd(tmp_path / "a.pcd")
    assert np.array_equal(found.xyz, np.stack(columns[:3], -1))
    assert np.array_equal(np.rint(found.intensity * 255), columns[3])
    assert found.time_s is not None and np.array_equal(found.time_s, columns[4])


def test_lzf_by_hand() -> None:
    assert lzf_decompress(bytes([2]) + b"abc", 3) == b"abc"
    # Two literals, then 3 + 2 bytes from two back: the copy runs into its own output.
    assert lzf_decompress(bytes([1]) + b"ab" + bytes([3 << 5, 1]), 7) == b"abababa"
    # The long form: 7 + 4 + 2 bytes from one back.
    assert lzf_decompress(bytes([0]) + b"x" + bytes([7 << 5, 4, 0]), 14) == b"x" * 14


@pytest.mark.parametrize(
    "packed", [b"\x05ab", b"\x00a\x20\x01", b"\x00a\x20", b"\x00a\xe0", b"\x00a\x20\x00", b"\x1f" + bytes(32)]
)
def test_damaged_lzf_is_refused(packed: bytes) -> None:
    assert lzf_decompress(packed, 3) is None


def test_random_lzf_bytes_are_refused_or_give_the_size_asked_for() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        size = int(rng.integers(1, 200))
        out = lzf_decompress(rng.integers(0, 256, int(rng.integers(0, 60)), np.uint8).tobytes(), size)
        assert out is None or len(out) == size


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_truncated_file_is_an_error_with_name_and_sizes(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "000069.pcd"
    xyz, red = cloud(100)
    if encoding == "ascii":
        write_ascii(path, xyz[:90], red, n=100)
        expected, found = 100, 90
    elif encoding == "binary":
        write_pcd(path, xyz, red / 255)
        path.write_bytes(path.read_bytes()[:-160])
        expected, found = 1600, 1440
    else:
        write_dair(path, dair_columns(100))
        whole = path.read_bytes()
        expected = int(np.frombuffer(whole[whole.index(b"compressed\n") + 11 :][:4], "<u4")[0])
        found = expected - 7
        path.write_bytes(whole[:-7])
    with pytest.raises(RecordingError) as caught:
        read_pcd(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and "download" in text
    assert re.search(rf"truncated.*\b{expected}\b.*\b{found}\b", text)


def test_more_points_than_the_header_declares_are_refused(tmp_path: Path) -> None:
    xyz, red = cloud(10)
    write_pcd(tmp_path / "a.pcd", xyz, red / 255)
    whole = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(whole + b"\n")
    assert len(read_pcd(tmp_path / "a.pcd").xyz) == 10
    (tmp_path / "a.pcd").write_bytes(whole + b"0123456789abcdef")
    with pytest.raises(RecordingError, match=r"expected 160 bytes.*found 176"):
        read_pcd(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("content", "message_match"),
    [
        (b"", "DATA line"),
        (b"VERSION 0.7\nFIELDS x y", "DATA line"),
        (b"\x00" * 200_000, "DATA line"),
        (b"VERSION 0.7\nDATA ascii\n1 2 3\n", "FIELDS"),
        (OPV2V_HEADER.format(n=1, data="zip").encode(), "DATA zip"),
        (OPV2V_HEADER.format(n="many", data="ascii").encode(), "many"),
        (OPV2V_HEADER.format(n=1, data="ascii").replace("TYPE F F F F", "TYPE F F F").encode(), "3 TYPE"),
        (OPV2V_HEADER.format(n=1, data="ascii").replace("x y z", "a b c").encode() + b"1 2 3 4\n", "x, y and z"),
        (OPV2V_HEADER.format(n=2, data="ascii").encode() + b"1 2 3 4\n1 2 3\n", "4 numbers on each of 2 lines"),
        (OPV2V_HEADER.format(n=1, data="ascii").encode() + b"1 2 3 x\n", "4 numbers on each of 1 lines"),
        (
            OPV2V_HEADER.format(n=1, data="ascii").encode() + b"1 2 3\n",
            "expected 4 numbers a line by its header, found 3",
        ),
    ],
)
def test_damaged_headers_and_lines_are_reported(tmp_path: Path, content: bytes, message_match: str) -> None:
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_pcd(tmp_path / "a.pcd")
    assert message_match in str(caught.value)
    assert str(tmp_path / "a.pcd") in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"000069\.pcd: no such file.*download"):
        read_pcd(tmp_path / "000069.pcd")


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_nan_points_are_counted_and_can_be_dropped(tmp_path: Path, encoding: str) -> None:
    xyz, red = cloud(50)
    xyz[3, 0] = xyz[4, 1] = np.nan
    xyz[9] = np.inf
    path, cache = tmp_path / "a.pcd", ArrayCache(tmp_path / "cache")
    write_ascii(path, xyz, red) if encoding == "ascii" else write_pcd(path, xyz, red / 255)
    for _ in range(2):  # from the file, then from the cache
        with pytest.raises(RecordingError, match=r"a\.pcd: 3 of 50 points are NaN.*drop_nan=True"):
            read_pcd(path, cache=cache)
    found = read_pcd(path, drop_nan=True, cache=cache)
    kept = np.isfinite(xyz).all(1)
    assert np.array_equal(found.xyz, xyz[kept]) and np.array_equal(np.rint(found.intensity * 255), red[kept])


def test_ascii_clouds_are_kept_until_the_file_changes(tmp_path: Path) -> None:
    path, cache = tmp_path / "a.pcd", ArrayCache(tmp_path / "cache")
    xyz, red = cloud(20)
    write_ascii(path, xyz, red)
    first = read_pcd(path, cache=cache)
    (entry,) = (tmp_path / "cache").rglob("*.npy")
    np.save(entry, np.zeros((1, 4), np.float32))  # a reader of this entry has not parsed the file again
    assert len(read_pcd(path, cache=cache).xyz) == 1
    write_ascii(path, 2 * xyz, red)
    changed = read_pcd(path, cache=cache)
    assert np.array_equal(changed.xyz, 2 * first.xyz)
    assert len(list((tmp_path / "cache").rglob("*.npy"))) == 1  # the entry of the old state is gone
    entry = next((tmp_path / "cache").rglob("*.npy"))
    entry.write_bytes(entry.read_bytes()[:40])  # a damaged entry counts for nothing
    assert np.array_equal(read_pcd(path, cache=cache).xyz, 2 * first.xyz)


def test_binary_clouds_are_read_without_the_cache(tmp_path: Path) -> None:
    xyz, red = cloud(20)
    write_pcd(tmp_path / "a.pcd", xyz, red / 255)
    for _ in range(2):
        assert np.array_equal(read_pcd(tmp_path / "a.pcd", cache=ArrayCache(tmp_path / "cache")).xyz, xyz)
    assert not list((tmp_path / "cache").rglob("*.npy"))
