# SPDX-License-Identifier: Apache-2.0
"""Coded tokens in fewer bytes: cells and rows of one packet as one stream, each symbol at its information content.

The stream is rANS (Duda, "Asymmetric numeral systems", 2013, section 3): a state of 24 bits at most, renormalised by
bytes, frequencies that sum to 4,096. The decoder ends in the state that the encoder began with and has read every byte, or
the stream is refused.

Cells come first: for every cell of the grid in order of key, up to the last that is named, one bit, with a frequency that
adapts within the packet to which of six neighbours known by then are named (context modelling as in JBIG, ITU-T T.82; all
whole numbers, so both sides agree on any machine). Then, row by row, the bytes of each token by the tables of the codebook.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import I32x2, I64x1, I64x2, Int64, U8x1, U8x2, njit
from manyeyes.comms.primitives import PacketError
from manyeyes.datatypes import ConfigError
from manyeyes.ops._sort_kernels import argsort, sort

TOTAL_BITS = 12
TOTAL = 1 << TOTAL_BITS
_MIN_STATE = 1 << 16
_SHIFT, _BYTE, _ONE, _SLOTS, _INVERSE_BITS = (np.uint64(n) for n in (TOTAL_BITS, 8, 1, TOTAL, 36))
STATE_BYTES = 3
MAX_CODED_CELLS = 1 << 18
"""Of a grid whose cells are coded: a forged packet costs its reader milliseconds, not more."""

_CONTEXTS = 16
_BIT = 1 << 16
_BITS: NDArray[np.int64] = np.rint((TOTAL_BITS - np.log2(np.maximum(np.arange(TOTAL + 1), 1))) * _BIT).astype(np.int64)
"""(TOTAL + 1,) information content of a symbol of each frequency, in 2^-16 bits."""
_CELL_BITS = 5
"""Information content of a named cell from which the search for a body's number of cells starts."""
_SLACK_BITS = 32
"""A stream is longer or shorter than its information content by less than this."""


@dataclass(frozen=True, eq=False)
class CodeTables:
    """frequencies: (W, 256), of each value of each byte of a row, none 0, summing to 4,096; they belong to the weights that
    the fingerprint names.
    """

    fingerprint: bytes
    frequencies: NDArray[np.integer]
    starts: NDArray[np.int32] = field(init=False, repr=False)
    values: NDArray[np.uint8] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        table = np.ascontiguousarray(self.frequencies, np.int32)
        if table.ndim != 2 or table.shape[1] != 256 or (table < 1).any() or (table.sum(1) != TOTAL).any():
            raise ConfigError(f"CodeTables needs (W, 256) frequencies from 1, a row summing to {TOTAL}.")
        object.__setattr__(self, "frequencies", table)
        object.__setattr__(self, "starts", (np.cumsum(table, 1) - table).astype(np.int32))
        object.__setattr__(self, "values", np.stack([np.repeat(np.arange(256, dtype=np.uint8), row) for row in table]))

    @property
    def width(self) -> int:
        """Bytes of a row."""
        return self.frequencies.shape[0]


class _ByteTables(NamedTuple):
    """:class:`CodeTables` for the loops: starts and frequencies (W, 256) int32, values (W, 4,096) uint8."""

    starts: I32x2
    frequencies: I32x2
    values: U8x2

    @classmethod
    def of(cls, tables: CodeTables) -> _ByteTables:
        """Return the arrays of the tables, not copied."""
        return cls(tables.starts, np.asarray(tables.frequencies, np.int32), tables.values)


class _BodyLimits(NamedTuple):
    """Bytes of a message body: what it always holds, its maximum, its packet's header, and what is left of the budget.

    remaining_bytes: for all bodies with their headers; negative without a budget.
    """

    fixed_bytes: int
    capacity_bytes: int
    header_bytes: int
    remaining_bytes: int


def pack_coded(key: NDArray[np.int64], rows: NDArray[np.uint8], shape: tuple[int, int], tables: CodeTables) -> bytes:
    """Return ascending keys (n,) on a grid of shape (rows, columns), and their rows (n, W), as one stream."""
    symbols = np.empty((_room(key, rows), 3), np.int32)
    count = _symbols(key, rows, shape[0], shape[1], _ByteTables.of(tables), symbols)
    out = np.empty(2 * len(symbols) + STATE_BYTES, np.uint8)
    used = _write(symbols[:count], out)
    return out[len(out) - used :].tobytes()


def _room(key: NDArray[np.int64], rows: NDArray[np.uint8]) -> int:
    """Return the number of symbols."""
    return (int(key[-1]) + 1 if key.size else 0) + rows.size


def unpack_coded(
    data: bytes, count: int, shape: tuple[int, int], tables: CodeTables
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the inverse of :func:`pack_coded` for count cells: keys (count,) and rows (count, W)."""
    key, rows = np.empty(count, np.int64), np.empty((count, tables.width), np.uint8)
    # A copy: numba takes far longer to find the type of an array that is read-only.
    raw = np.frombuffer(bytearray(data), np.uint8)
    if not _read(raw, shape[0], shape[1], _ByteTables.of(tables), key, rows):
        raise PacketError("garbage", f"{len(data)} bytes are not the stream of {count} cells and their rows.")
    return key, rows


def count_fitting_coded_cells(
    key: NDArray[np.int64],
    rows: NDArray[np.uint8],
    shape: tuple[int, int],
    tables: CodeTables,
    fixed_bytes: int,
    capacity: int,
    header_bytes: int,
    bytes_left: int,
) -> NDArray[np.int64]:
    """As ``primitives.count_fitting_cells`` for coded tokens: how many of keys (N,) and rows (N, W), in the order given, each body
    takes.
    """
    limits = _BodyLimits(fixed_bytes, capacity, header_bytes, bytes_left)
    key, rows = np.ascontiguousarray(key, np.int64), np.ascontiguousarray(rows)
    return _counts(key, rows, shape[0], shape[1], _ByteTables.of(tables), limits)


@njit(cache=True)
def _counts(
    key: I64x1, rows: U8x2, height: int, width: int, tables: _ByteTables, limits: _BodyLimits
) -> I64x1:  # pragma: no cover
    fixed, capacity, header, left = limits
    counts, bodies, at, top = np.empty(key.shape[0], np.int64), 0, 0, 0
    for k in key:
        top = max(top, k)
    symbols, ends = np.empty((top + 1 + rows.size, 3), np.int32), _row_ends(rows, tables)
    order = _Order(key, rows, ends, height, width)
    while at < key.shape[0]:
        room = max(0, (capacity if left < 0 else min(capacity, left - header)) - fixed)
        count = _search(order, at, room, _guess(ends, at, capacity - fixed))
        # The nearest count whose stream fits: with more room, no step ends lower, so that budgets are nested.
        taken = _stream_size(order, at, count, room, tables, symbols)
        while count and taken < 0:
            count -= 1
            taken = _stream_size(order, at, count, room, tables, symbols)
        while True:
            longer = _stream_size(order, at, count + 1, room, tables, symbols)
            if longer < 0:
                break
            count, taken = count + 1, longer
        if count == 0:
            break
        if left >= 0:
            left -= header + fixed + taken
        counts[bodies] = count
        bodies += 1
        at += count
    return counts[:bodies]


class _Order(NamedTuple):
    """Cells in the order in which they are sent: key (N,), rows (N, W), ends (N + 1,) of :func:`_row_ends`, and the grid."""

    key: I64x1
    rows: U8x2
    ends: I64x1
    height: int
    width: int


@njit(cache=True)
def _row_ends(rows: U8x2, tables: _ByteTables) -> I64x1:  # pragma: no cover
    """Return (N + 1,) the information content of the first rows, in 2^-16 bits."""
    ends = np.zeros(rows.shape[0] + 1, np.int64)
    for i in range(rows.shape[0]):
        bits = np.int64(0)
        for j in range(rows.shape[1]):
            bits += _BITS[tables.frequencies[j, rows[i, j]]]
        ends[i + 1] = ends[i] + bits
    return ends


@njit(cache=True)
def _guess(ends: I64x1, at: int, room: int) -> int:  # pragma: no cover
    """Return about how many rows from at on fill so many bytes, at least 1."""
    limit, count = 8 * (room - STATE_BYTES) * _BIT, 1
    while at + count + 1 < ends.shape[0] and ends[at + count + 1] - ends[at] + (count + 1) * _CELL_BITS * _BIT <= limit:
        count += 1
    return count


@njit(cache=True)
def _search(order: _Order, at: int, room: int, start: int) -> int:  # pragma: no cover
    """Return a number of cells from at on whose information content fits the room, while that of one more does not.

    The counts are tried from start on, by steps that double and then halve. They do not depend on the room: with more of it the
    search never ends lower.
    """
    limit, step, low = 8 * (room - STATE_BYTES) * _BIT, 1, 0
    if _bits(order, at, start) <= limit:
        low, high = start, start + 1
        while _bits(order, at, high) <= limit:
            low, step = high, 2 * step
            high += step
    else:
        high, low = start, max(start - 1, 0)
        while low and _bits(order, at, low) > limit:
            high, step = low, 2 * step
            low = max(low - step, 0)
    while high - low > 1:
        middle = (low + high) // 2
        if _bits(order, at, middle) <= limit:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True)
def _bits(order: _Order, at: int, count: int) -> int:  # pragma: no cover
    """Return the information content of so many cells from at on, in 2^-16 bits; more than any room where there are fewer."""
    if count > min(order.key.shape[0] - at, 65535):
        return 1 << 62
    key = sort(order.key[at : at + count])
    contexts, counts = _contexts(key, order.height, order.width), _prior(count, order.height * order.width)
    bits, k = order.ends[at + count] - order.ends[at], 0
    for named in key:
        while k < named:
            context, first = contexts[k], k
            k += 1
            while k < named and contexts[k] == context:
                k += 1
            bits += _run_bits(counts[context], k - first)
        context = contexts[k]
        bits += _BITS[_alike(counts[context])[0]]
        counts[context, 1] += 2
        k += 1
    return bits


@njit(cache=True)
def _run_bits(counts: I64x1, length: int) -> int:  # pragma: no cover
    """Return the information content of a run of cells of one context that are not named, and count them."""
    bits = 0
    while length > 0:
        chance, alike = _alike(counts)
        alike = min(alike, length)
        bits += alike * _BITS[TOTAL - chance]
        counts[0] += 2 * alike
        length -= alike
    return bits


@njit(cache=True)
def _stream_size(
    order: _Order, at: int, count: int, room: int, tables: _ByteTables, symbols: I32x2
) -> int:  # pragma: no cover
    """Return bytes of the stream of so many cells from at on; -1 where it does not fit the room."""
    if count == 0:
        return 0
    if _bits(order, at, count) > (8 * (room - STATE_BYTES) + _SLACK_BITS) * _BIT:
        return -1
    chosen = argsort(order.key[at : at + count]) + at
    used = _symbols(order.key[chosen], order.rows[chosen], order.height, order.width, tables, symbols)
    size = _size(symbols[:used])
    return size if size <= room else -1


@njit(cache=True)
def _contexts(key: I64x1, height: int, width: int) -> U8x1:  # pragma: no cover
    """Return (key[-1] + 1,) contexts of the cells up to the last of ascending keys: see :func:`_mark`."""
    end = key[-1] + 1
    contexts = np.zeros(end, np.uint8)
    for k in key:
        _mark(contexts, k, k % width, width)
    return contexts


@njit(cache=True)
def _mark(contexts: U8x1, k: Int64, column: Int64, width: int) -> None:  # pragma: no cover
    """Write to the contexts of later cells that cell k is named: 1 left, 2 above, 4 above aside, 8 two away."""
    end = contexts.shape[0]
    if column + 1 < width and k + 1 < end:
        contexts[k + 1] |= np.uint8(1)
    if column + 2 < width and k + 2 < end:
        contexts[k + 2] |= np.uint8(8)
    if column > 0 and k + width - 1 < end:
        contexts[k + width - 1] |= np.uint8(4)
    if k + width < end:
        contexts[k + width] |= np.uint8(2)
    if column + 1 < width and k + width + 1 < end:
        contexts[k + width + 1] |= np.uint8(4)
    if k + 2 * width < end:
        contexts[k + 2 * width] |= np.uint8(8)


@njit(cache=True)
def _prior(count: int, cells: int) -> I64x2:  # pragma: no cover
    """Return counts (contexts, 2) to begin with of cells that are not and that are named."""
    counts = np.ones((_CONTEXTS, 2), np.int64)
    counts[0, 0] = 2 * max(1, cells // max(1, count))
    counts[1:, 0] = 2
    return counts


@njit(cache=True)
def _alike(counts: I64x1) -> tuple[int, int]:  # pragma: no cover
    """Return the frequency, 1 to 4,095, that a cell of a context with these counts (2,) is named, and how long it stays.

    It is that of so many cells, if none of them is named: frequencies change slowly.
    """
    total = counts[0] + counts[1]
    chance = TOTAL * counts[1] // total
    if chance <= 1:
        return 1, MAX_CODED_CELLS
    return min(chance, TOTAL - 1), (TOTAL * counts[1] // chance - total) // 2 + 1


@njit(cache=True)
def _symbols(
    key: I64x1, rows: U8x2, height: int, width: int, tables: _ByteTables, out: I32x2
) -> int:  # pragma: no cover
    """Fills out with runs (start, frequency, length) of equal symbols, in the order in which they are read; how many there are."""
    n, at = key.shape[0], 0
    if n == 0:
        return 0
    contexts, counts = _contexts(key, height, width), _prior(n, height * width)
    k = 0
    for named in key:
        while k < named:
            context, first = contexts[k], k
            chance, alike = _alike(counts[context])
            end = min(named, k + alike)
            while k < end and contexts[k] == context:
                k += 1
            out[at, 0], out[at, 1], out[at, 2] = chance, TOTAL - chance, k - first
            counts[context, 0] += 2 * (k - first)
            at += 1
        context = contexts[k]
        out[at, 0], out[at, 1], out[at, 2] = 0, _alike(counts[context])[0], 1
        counts[context, 1] += 2
        at, k = at + 1, k + 1
    for i in range(n):
        for j in range(rows.shape[1]):
            value = rows[i, j]
            out[at, 0], out[at, 1], out[at, 2] = tables.starts[j, value], tables.frequencies[j, value], 1
            at += 1
    return at


@njit(cache=True)
def _size(symbols: I32x2) -> int:  # pragma: no cover
    """Return bytes that _write makes."""
    state, size = np.uint64(_MIN_STATE), STATE_BYTES
    for i in range(symbols.shape[0] - 1, -1, -1):
        start, frequency = np.uint64(symbols[i, 0]), np.uint64(symbols[i, 1])
        limit, inverse = frequency << _SHIFT, _inverse(frequency)
        for _ in range(symbols[i, 2]):
            while state >= limit:
                size += 1
                state >>= _BYTE
            state += ((state * inverse) >> _INVERSE_BITS) * (_SLOTS - frequency) + start
    return size


@njit(cache=True)
def _write(symbols: I32x2, out: U8x1) -> int:  # pragma: no cover
    """Fills the end of out, from back to front; how many bytes."""
    state, at = np.uint64(_MIN_STATE), out.shape[0]
    for i in range(symbols.shape[0] - 1, -1, -1):
        start, frequency = np.uint64(symbols[i, 0]), np.uint64(symbols[i, 1])
        limit, inverse = frequency << _SHIFT, _inverse(frequency)
        for _ in range(symbols[i, 2]):
            while state >= limit:
                at -= 1
                out[at] = state & np.uint64(255)
                state >>= _BYTE
            state += ((state * inverse) >> _INVERSE_BITS) * (_SLOTS - frequency) + start
    for _ in range(STATE_BYTES):
        at -= 1
        out[at] = state & np.uint64(255)
        state >>= _BYTE
    return out.shape[0] - at


@njit(cache=True)
def _inverse(frequency: np.uint64) -> np.uint64:  # pragma: no cover
    """Return m such that state * m >> 36 is state // frequency of every state, which has at most 24 bits.

    Granlund and Montgomery, "Division by invariant integers using multiplication", 1994, theorem 4.2.
    """
    return np.uint64(((_ONE << _INVERSE_BITS) + frequency - _ONE) // frequency)


@njit(cache=True)
def _take(state: Int64, frequency: Int64, offset: Int64, raw: U8x1, at: int) -> tuple[Int64, int]:  # pragma: no cover
    """State and place after a symbol; offset: how far the state lies above the symbol's start. Bytes beyond the end are 0."""
    state = frequency * (state >> TOTAL_BITS) + offset
    while state < _MIN_STATE and at <= raw.shape[0]:
        state = state << 8 | (np.int64(raw[at]) if at < raw.shape[0] else 0)
        at += 1
    return state, at


@njit(cache=True)
def _read(raw: U8x1, height: int, width: int, tables: _ByteTables, key: I64x1, rows: U8x2) -> bool:  # pragma: no cover
    """Fills key and rows; whether raw is the stream of just these."""
    starts, frequencies, values = tables
    if raw.shape[0] < STATE_BYTES:
        return False
    state = np.int64(raw[0]) << 16 | np.int64(raw[1]) << 8 | np.int64(raw[2])
    if state < _MIN_STATE:
        return False
    n, at = key.shape[0], STATE_BYTES
    cells = height * width
    contexts, counts = np.zeros(cells, np.uint8), _prior(n, cells)
    found, k = 0, 0
    while found < n:
        if k == cells or at > raw.shape[0]:
            return False
        context, first = contexts[k], k
        chance, alike = _alike(counts[context])
        end = min(cells, k + alike)
        # Cells of one context and frequency that are not named.
        while k < end and contexts[k] == context and state & TOTAL - 1 >= chance and at <= raw.shape[0]:
            state, at = _take(state, TOTAL - chance, (state & TOTAL - 1) - chance, raw, at)
            k += 1
        counts[context, 0] += 2 * (k - first)
        if k < end and contexts[k] == context and at <= raw.shape[0]:
            state, at = _take(state, chance, state & TOTAL - 1, raw, at)
            key[found] = k
            found += 1
            counts[context, 1] += 2
            _mark(contexts, k, k % width, width)
            k += 1
    for i in range(n):
        for j in range(rows.shape[1]):
            if at > raw.shape[0]:
                return False
            slot = state & TOTAL - 1
            value = values[j, slot]
            rows[i, j] = value
            state, at = _take(state, np.int64(frequencies[j, value]), slot - starts[j, value], raw, at)
    return state == _MIN_STATE and at == raw.shape[0]
