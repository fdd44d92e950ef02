# SPDX-License-Identifier: Apache-2.0
"""Numbers to bytes: hand-made cases and round trips."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.comms import primitives
from manyeyes.datatypes import WireError

keys = st.sets(st.integers(0, 4000), min_size=1, max_size=400).map(lambda s: np.array(sorted(s), np.int64))


def test_varints_by_hand():
    values = np.array([0, 127, 128, 300, 16383, 16384, 2**35 - 1])
    data = primitives.pack_varints(values)
    assert data.hex() == "007f8001ac02ff7f808001ffffffff7f"
    back, used = primitives.unpack_varints(data + b"rest", 7)
    assert (back.tolist(), used) == (values.tolist(), len(data))


@pytest.mark.parametrize("data", [b"", b"\x80", b"\x80\x00", b"\xff\xff\xff\xff\xff\x01"])
def test_improper_varints_are_refused(data):
    with pytest.raises(primitives.PacketError) as caught:
        primitives.unpack_varints(data, 1)
    assert caught.value.reason == "garbage"


@pytest.mark.parametrize("value", [-1, 2**35])
def test_a_varint_has_a_range(value):
    with pytest.raises(WireError, match="2\\^35"):
        primitives.pack_varints(np.array([value]))


@given(keys)
def test_cells_round_trip_in_the_predicted_size(key):
    layout, data = primitives.pack_cells(key)
    assert len(data) == primitives.cells_size(key)
    back, used = primitives.unpack_cells(layout, data + b"more", len(key))
    assert (back.tolist(), used) == (key.tolist(), len(data))


@given(keys, st.integers(0, 4000))
def test_one_more_cell_lowers_the_size_by_one_byte_at_most(key, extra):
    more = np.union1d(key, [extra])
    assert primitives.cells_size(more) >= primitives.cells_size(key) - 1


def test_the_shorter_form_is_taken():
    sparse, dense = np.arange(0, 2000, 50), np.arange(700, 900)
    assert primitives.pack_cells(sparse)[0] == primitives.DELTA
    layout, data = primitives.pack_cells(dense)
    assert (layout, len(data)) == (primitives.BITMAP, 2 + 1 + 25)
    assert primitives.pack_cells(dense[:0]) == (primitives.DELTA, b"")


def test_bitmaps_that_lie_are_refused():
    layout, data = primitives.pack_cells(np.arange(700, 900))
    for wrong, count in ((data[:-1], 200), (data, 199), (data[:1], 200)):
        with pytest.raises(primitives.PacketError):
            primitives.unpack_cells(layout, wrong, count)


@given(st.integers(0, 10**6), st.integers(1, 50), st.floats(-14, 12))
def test_int8_is_within_half_a_step_that_is_at_most_nine_percent_coarse(seed, rows, octave):
    values = np.random.default_rng(seed).normal(size=(rows, 6)).astype(np.float32) * np.float32(2.0**octave)
    values[:, 3] = 0
    code, steps = primitives.quantise_int8(values)
    back = primitives.dequantise_int8(code, steps)
    assert (back[:, 3] == 0).all()
    peak = np.maximum(np.abs(values).max(0), 2.0**-16)
    assert (np.abs(back - values) <= peak * 2**0.125 / 127 / 2 * 1.0001).all()


def test_int8_reports_values_out_of_range():
    with pytest.raises(WireError, match="int8 features reach"):
        primitives.quantise_int8(np.array([[1e6]], np.float32))


def test_log_codes_by_hand():
    codes = primitives.log_codes(np.array([0.0, 1e-9, 0.01, 20.0, 1e9]), 0.01, 20.0)
    assert codes.tolist() == [0, 1, 1, 255, 255]
    assert primitives.log_values(codes, 0.01, 20.0) == pytest.approx([0, 0.01, 0.01, 20, 20])


def test_runs_are_packed_independently():
    dense, sparse, none = np.arange(700, 900), np.array([3, 5000, 2**24 - 1]), np.zeros(0, np.int64)
    runs = [sparse, dense, none, dense + 1]
    packed = primitives.pack_cell_runs(np.concatenate(runs), [len(run) for run in runs])
    assert packed == [primitives.pack_cells(run) for run in runs]
    assert [layout for layout, _ in packed] == [
        primitives.DELTA,
        primitives.BITMAP,
        primitives.DELTA,
        primitives.BITMAP,
    ]
    with pytest.raises(WireError, match="smaller grid"):
        primitives.pack_cell_runs(np.array([1, 2**35]), [1, 1])


def test_runs_are_quantised_independently():
    values = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32) * np.array([[0, 1, 1000]], np.float32)
    codes, steps = primitives.quantise_int8_runs(values, [4, 5])
    for run, rows in enumerate((slice(0, 4), slice(4, 9))):
        code, step = primitives.quantise_int8(values[rows])
        assert np.array_equal(codes[run], code)
        assert np.array_equal(steps[rows], step)


@pytest.mark.parametrize("dtype", ["<f2", "<f4"])
def test_floats_that_are_not_finite_are_found_at_any_place(dtype):
    for at in (0, 3):
        for bad in (np.inf, -np.inf, np.nan, np.finfo(dtype).max, -0.0):
            values = np.linspace(-2, 2, 7).astype(dtype)
            for place in range(7):
                changed = values.copy()
                changed[place] = bad
                data = b"\xff\x7f\xff"[:at] + changed.tobytes()
                assert primitives.are_finite(data, at, values.itemsize) == np.isfinite(bad)


def test_values_on_their_bound_are_within_and_nan_is_not() -> None:
    values, bounds = np.array([[1.0, -2.0], [-1.0, 0.0]], np.float32), np.array([1.0, 2.0])
    assert primitives.are_within(values, bounds) and primitives.are_within(values[:0], bounds)
    for wrong in (np.nan, 2.1, -2.1, np.inf):
        assert not primitives.are_within(np.concatenate((values, [[0.0, wrong]]), dtype=np.float32), bounds)
