# SPDX-License-Identifier: Apache-2.0
"""Coded tokens: round trips, sizes against the entropy, and streams that are not what they say."""

import zlib
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import wire
from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.entropy import TOTAL, CodeTables, count_fitting_coded_cells, pack_coded, unpack_coded
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.primitives import PacketError, pack_cells
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.datatypes import BevGrid, ConfigError, Message, Sites, SparseBev, Transform, WireError

torch.set_num_threads(1)
GRID = BevGrid(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0, 0.4, 4)
SHAPE = GRID.shape
MODEL = b"model-01"


def skewed(width: int, seed: int = 0) -> CodeTables:
    """Tables of values that differ much in how often they occur."""
    weight = np.random.default_rng(seed).exponential(size=(width, 256)) ** 4
    frequencies = 1 + np.floor(weight / weight.sum(1, keepdims=True) * (TOTAL - 256)).astype(np.int32)
    frequencies[:, 7] += TOTAL - frequencies.sum(1)
    return CodeTables(MODEL, frequencies)


def drawn(tables: CodeTables, count: int, seed: int) -> np.ndarray:
    """Rows whose bytes occur as the tables say."""
    slots = np.random.default_rng(seed).integers(0, TOTAL, (count, tables.width))
    return np.stack([tables.values[j, slots[:, j]] for j in range(tables.width)], 1)


def surprise(tables: CodeTables, rows: np.ndarray) -> float:
    """Bytes of the rows at -log2 of each value's share: no code of these tables is shorter."""
    each = tables.frequencies[np.arange(tables.width), rows] / TOTAL
    return float(-np.log2(each).sum() / 8)


cells = st.sets(st.integers(0, SHAPE[0] * SHAPE[1] - 1), max_size=200).map(lambda s: np.array(sorted(s), np.int64))


@given(cells, st.integers(1, 6), st.integers(0, 10**6))
def test_round_trip_of_any_cells_and_any_bytes(key, width, seed):
    tables = skewed(width)
    rows = np.random.default_rng(seed).integers(0, 256, (len(key), width)).astype(np.uint8)
    data = pack_coded(key, rows, SHAPE, tables)
    got_key, got_rows = unpack_coded(data, len(key), SHAPE, tables)
    assert np.array_equal(got_key, key) and np.array_equal(got_rows, rows)


def test_a_certain_symbol_costs_nothing_and_the_rest_its_surprise():
    """One cell at key 0 of a grid of one: a bit of chance 1/3 (prior 1 of 3); then bytes of chance 1/2 each, one bit each."""
    half = np.ones((16, 256), np.int32)
    half[:, 0] = half[:, 1] = (TOTAL - 254) // 2
    tables = CodeTables(MODEL, half)
    rows = np.random.default_rng(0).integers(0, 2, (1, 16)).astype(np.uint8)
    data = pack_coded(np.array([0]), rows, (1, 1), tables)
    assert len(data) in (3 + 2, 3 + 3)


def test_rows_are_as_short_as_their_tables_allow():
    tables = skewed(20)
    rows = drawn(tables, 400, 1)
    key = np.arange(400)
    data = pack_coded(key, rows, (20, 20), tables)
    # A full grid costs next to nothing for its cells.
    assert surprise(tables, rows) < len(data) < 1.01 * surprise(tables, rows) + 20
    assert len(data) < 0.9 * rows.size


def test_cells_in_clusters_cost_less_than_as_gaps():
    rng = np.random.default_rng(3)
    yx = np.concatenate(
        [rng.integers(4, 120, (1, 2)) + [(r, c) for r in range(3) for c in range(2)] for _ in range(12)]
    )
    key = np.unique(yx[:, 0] * 128 + yx[:, 1])
    sure = np.ones((1, 256), np.int32)
    sure[0, 0] = TOTAL - 255
    data = pack_coded(key, np.zeros((len(key), 1), np.uint8), (128, 128), CodeTables(MODEL, sure))
    assert len(data) < 0.85 * len(pack_cells(key)[1])


@given(cells.filter(len), st.integers(0, 10**6), st.data())
def test_a_changed_stream_is_refused_or_decodes_to_other_rows(key, seed, data):
    """Nothing crashes, nothing is read twice as the same: the stream is a bijection, so a change cannot be silent."""
    tables = skewed(3)
    rows = drawn(tables, len(key), seed)
    packed = pack_coded(key, rows, SHAPE, tables)
    damaged = bytearray(packed)
    bit = data.draw(st.integers(0, len(packed) * 8 - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    for bad in (bytes(damaged), packed[:-1], packed + b"\0", packed[1:], b""):
        try:
            got = unpack_coded(bad, len(key), SHAPE, tables)
        except PacketError as error:
            assert error.reason == "garbage"
            continue
        assert not (np.array_equal(got[0], key) and np.array_equal(got[1], rows))
        assert pack_coded(*got, SHAPE, tables) == bad


@given(st.binary(max_size=200), st.integers(0, 65535))
def test_garbage_never_crashes(data, count):
    try:
        key, rows = unpack_coded(data, count, SHAPE, skewed(3))
    except PacketError:
        return
    assert len(key) == count and (np.diff(key) > 0).all() and rows.shape == (count, 3)


@pytest.mark.parametrize("change", [lambda f: f[:, :255], lambda f: f * 2, lambda f: f - 16, lambda f: f[0]])
def test_tables_that_are_none_are_refused(change):
    with pytest.raises(ConfigError, match="4096"):
        CodeTables(MODEL, change(np.full((2, 256), 16)))


def coded_message(count: int, seed: int, tables: CodeTables) -> Message:
    g = torch.Generator().manual_seed(seed)
    key = torch.randperm(SHAPE[0] * SHAPE[1], generator=g)[:count].sort().values
    rows = torch.from_numpy(drawn(tables, count, seed))
    pose = Transform.from_xyz_yaw(1.0, 2.0)
    bev = SparseBev(rows, Sites(key, GRID))
    score = torch.randint(0, 9, (count,), generator=g) / 9
    return Message(1, 2, pose, torch.zeros(3, 3), MODEL, tokens=bev, token_score=score)


def test_packets_of_coded_tokens_decode_independently_and_are_smaller():
    tables = skewed(20)
    message = coded_message(300, 1, tables)
    packets = wire.encode(message, token_encoding="codebook", tables=tables)
    assert len(packets) >= 2 and all(len(p) <= wire.DEFAULT_MTU for p in packets)
    plain = wire.encode(message, token_encoding="codebook")
    assert len(b"".join(packets)) < 0.9 * len(b"".join(plain))
    inbox = Inbox(MODEL, tables=tables)
    for packet in packets[::-1]:
        inbox.push(packet)
    (back,) = inbox.messages()
    assert torch.equal(back.tokens.features, message.tokens.features)
    assert torch.equal(back.tokens.sites.key, message.tokens.sites.key)
    alone = wire.decode_packet(packets[1], tables).body
    row = dict(zip(message.tokens.sites.key.tolist(), message.tokens.features.tolist()))
    got = np.frombuffer(alone.values, np.uint8).reshape(-1, 20).tolist()
    assert [row[k] for k in alone.key.tolist()] == got


@given(st.integers(0, 10**6), st.integers(0, 250), st.integers(0, 5000), st.integers(0, 2000), st.integers(300, 1500))
def test_budgets_are_never_exceeded_and_nested(seed, count, budget, more, mtu):
    tables = skewed(9)
    message = coded_message(count, seed, tables)
    kept = []
    for limit in (budget, budget + more):
        bev, score = select_within_budget(message.tokens, message.token_score, limit, "codebook", mtu, tables)
        kept.append(set(bev.sites.key.tolist()))
        if len(score):
            selected = replace(message, tokens=bev, token_score=score)
            assert len(b"".join(wire.encode(selected, token_encoding="codebook", mtu=mtu, tables=tables))) <= limit
    assert kept[0] <= kept[1]


def test_a_budget_is_used_up_but_for_a_row():
    tables = skewed(20)
    message = coded_message(400, 2, tables)
    for budget in (1398, 2000, 3000):
        bev, score = select_within_budget(message.tokens, message.token_score, budget, "codebook", tables=tables)
        selected = replace(message, tokens=bev, token_score=score)
        sizes = [len(p) for p in wire.encode(selected, token_encoding="codebook", tables=tables)]
        assert budget - 24 <= sum(sizes) <= budget


def test_counts_fill_each_body_before_the_next():
    tables = skewed(20)
    message = coded_message(400, 3, tables)
    key, rows = message.tokens.sites.key.numpy(), message.tokens.features.numpy()
    counts = count_fitting_coded_cells(key, rows, SHAPE, tables, 20, 800, 0, -1).tolist()
    assert sum(counts) == 400
    ends = np.cumsum([0, *counts])
    for a, b in pairwise(ends):
        assert len(pack_coded(key[a:b], rows[a:b], SHAPE, tables)) <= 780
        if b < 400:
            assert len(pack_coded(key[a : b + 1], rows[a : b + 1], SHAPE, tables)) > 780


def test_coded_tokens_of_other_weights_are_distinguished_from_garbage():
    tables, other = skewed(20), CodeTables(b"model-02", skewed(20, 5).frequencies)
    message = coded_message(50, 4, tables)
    (packet,) = wire.encode(message, token_encoding="codebook", tables=tables)
    for reader in (None, other):
        inbox = Inbox(tables=reader)
        inbox.push(packet)
        assert inbox.dropped == DropCounts(wrong_model=1)
    with pytest.raises(WireError, match="do not code"):
        wire.encode(message, token_encoding="codebook", tables=other)
    narrow = CodeTables(MODEL, skewed(19).frequencies)
    with pytest.raises(WireError, match="19 bytes"):
        wire.encode(message, token_encoding="codebook", tables=narrow)
    with pytest.raises(PacketError) as caught:
        wire.decode_packet(packet, narrow)
    assert caught.value.reason == "implausible"


@given(st.integers(0, 1000), st.data())
def test_a_faulty_sender_of_codes_never_crashes_the_reader(seed, data):
    tables = skewed(4)
    (packet,) = wire.encode(coded_message(30, seed, tables), token_encoding="codebook", tables=tables)
    at = data.draw(st.integers(64, len(packet) - 5))
    new = data.draw(st.binary(min_size=1, max_size=min(8, len(packet) - 4 - at)))
    changed = packet[:at] + new + packet[at + len(new) : -4]
    try:
        message = wire.assemble([wire.decode_packet(changed + zlib.crc32(changed).to_bytes(4, "little"), tables)])
    except PacketError:
        return
    assert message.tokens.features.dtype == torch.uint8
    assert message.tokens.features.shape == (len(message.tokens.sites), message.tokens.features.shape[1])
