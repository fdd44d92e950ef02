# SPDX-License-Identifier: Apache-2.0
"""Files of dataclasses: what was written comes back, to the bit and the type; a damaged file is no file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from manyeyes._records import load_record, pack_record, save_record, unpack_record


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


class Corner(NamedTuple):
    x: float
    points: NDArray[np.float32]


@dataclass(frozen=True)
class Part:
    name: str
    score: torch.Tensor
    size: tuple[float, float]


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]
    colour: Colour
    corner: Corner
    limit: float
    count: int | None
    table: np.ndarray
    empty: np.ndarray


def make_whole() -> Whole:
    frozen = np.arange(6, dtype=np.int16).reshape(2, 3)
    frozen.flags.writeable = False
    parts = tuple(Part(f"é{n}", torch.linspace(0, 1, n).double(), (0.1, math.inf)) for n in range(3))
    corner = Corner(1 / 3, np.asfortranarray(np.ones((2, 3), np.float32)))
    return Whole(parts, Colour.BLUE, corner, math.nan, None, frozen, np.zeros((0, 2)))


def test_a_value_round_trips(tmp_path) -> None:
    want = make_whole()
    save_record(tmp_path / "x.record", want)
    got = load_record(tmp_path / "x.record", Whole)
    assert got is not None and [path.name for path in tmp_path.iterdir()] == ["x.record"]
    for a, b in zip(got.parts, want.parts, strict=True):
        assert (
            a.name == b.name and a.size == b.size and torch.equal(a.score, b.score) and a.score.dtype == b.score.dtype
        )
    assert got.colour is Colour.BLUE and got.corner.x == 1 / 3 and math.isnan(got.limit) and got.count is None
    for a, b in ((got.table, want.table), (got.corner.points, want.corner.points), (got.empty, want.empty)):
        np.testing.assert_array_equal(a, b)
        assert (a.dtype, a.shape, a.strides, a.flags.writeable) == (b.dtype, b.shape, b.strides, b.flags.writeable)


def test_bytes_in_memory_equal_the_file_and_read_only_arrays_are_views_of_them(tmp_path) -> None:
    want = make_whole()
    save_record(tmp_path / "x.record", want)
    data = pack_record(want)
    assert data == (tmp_path / "x.record").read_bytes()
    got = unpack_record(data, Whole)
    assert got is not None
    for a, b in ((got.table, want.table), (got.corner.points, want.corner.points), (got.empty, want.empty)):
        np.testing.assert_array_equal(a, b)
        assert (a.dtype, a.shape, a.strides, a.flags.writeable) == (b.dtype, b.shape, b.strides, b.flags.writeable)
        assert a.flags.aligned
    stored = np.frombuffer(data, np.uint8)
    assert np.shares_memory(got.table, stored) and not np.shares_memory(got.corner.points, stored)
    for at in range(0, len(data), 7):
        assert unpack_record(data[:at], Whole) is None, f"cut at {at}"
        assert unpack_record(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :], Whole) is None, f"changed at {at}"


def test_a_tuple_of_values_round_trips(tmp_path) -> None:
    save_record(tmp_path / "x.record", (Part("a", torch.ones(2), (1.0, 2.0)),))
    got = load_record(tmp_path / "x.record", tuple[Part, ...])
    assert got is not None and got[0].name == "a" and got[0].score.tolist() == [1, 1]


def test_a_file_damaged_anywhere_is_none(tmp_path) -> None:
    path = tmp_path / "x.record"
    assert load_record(path, Whole) is None
    save_record(path, make_whole())
    whole = path.read_bytes()
    for at in range(0, len(whole), 7):
        path.write_bytes(whole[:at])
        assert load_record(path, Whole) is None, f"cut at {at}"
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert load_record(path, Whole) is None, f"changed at {at}"


@pytest.mark.parametrize("value", [Part("a", torch.ones(2), (1.0, 2.0)), (1.0, 2.0)])
def test_a_file_of_another_type_is_none(tmp_path, value) -> None:
    save_record(tmp_path / "x.record", value)
    assert load_record(tmp_path / "x.record", Whole) is None
