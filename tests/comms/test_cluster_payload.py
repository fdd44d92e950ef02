# SPDX-License-Identifier: Apache-2.0
"""Clustered tokens in packets: decoded equals encoded, bytes by the formula, each packet alone, budgets, and hostile bytes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from manyeyes.comms import assemble, decode_packet, encode, primitives
from manyeyes.comms.cluster_payload import find_clusters, pack_clustered, read_clustered
from manyeyes.comms.payloads import TOKENS_BYTES
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.token_selection import select_for_packets
from manyeyes.comms.wire import HEADER_BYTES, encode_tokens
from manyeyes.datatypes import BevGrid, Message, Sites, SparseBev, Transform, WireError

GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 4)
CHANNELS, OWN = 8, 3
MODEL = b"model-01"


def message(n: int, clusters: int, own_bytes: int = OWN, seed: int = 0) -> Message:
    g = torch.Generator().manual_seed(seed)
    table = torch.randn(clusters, CHANNELS, generator=g).half()
    which = torch.cat((torch.arange(clusters), torch.randint(max(clusters, 1), (n,), generator=g)))[:n]
    shared = table[which].view(torch.uint8).view(n, 2 * CHANNELS)
    own = torch.randint(256, (n, own_bytes), generator=g).to(torch.uint8)
    key = torch.randperm(4000, generator=g)[:n].sort().values
    tokens = SparseBev(torch.cat((shared, own), 1), Sites(key, GRID))
    score = torch.rand(n, generator=g)
    pose = Transform.identity(dtype=torch.float64)
    return Message(1, 0, pose, torch.zeros(3, 3, dtype=torch.float64), MODEL, tokens=tokens, token_score=score)


@pytest.mark.parametrize("own_bytes", [0, OWN])
@pytest.mark.parametrize("mtu", [300, 1398, 60_000])
@pytest.mark.parametrize(("n", "clusters"), [(0, 0), (1, 1), (200, 40), (300, 300)])
def test_decoded_equals_encoded(n: int, clusters: int, mtu: int, own_bytes: int) -> None:
    sent = message(n, clusters, own_bytes)
    packets = encode(sent, token_encoding="clusters", mtu=mtu, own_bytes=own_bytes)
    assert all(len(packet) <= mtu for packet in packets)
    received = assemble(map(decode_packet, packets[::-1])).tokens
    assert received is not None and sent.tokens is not None
    assert torch.equal(received.sites.key, sent.tokens.sites.key)
    assert torch.equal(received.features, sent.tokens.features)


def test_bytes_are_those_of_the_formula() -> None:
    """Head, two counts, cells, 2 C bytes a cluster, and one byte and its own of each token."""
    sent = message(200, 40)
    (packet,) = encode(sent, token_encoding="clusters", mtu=60_000, own_bytes=OWN)
    cells = primitives.cells_size(sent.tokens.sites.key.numpy())
    assert len(packet) == HEADER_BYTES + TOKENS_BYTES + 2 + cells + 40 * 2 * CHANNELS + 200 * (1 + OWN)


def test_a_lost_packet_loses_its_own_tokens_alone() -> None:
    sent = message(200, 10)
    packets = encode(sent, token_encoding="clusters", mtu=400, own_bytes=OWN)
    assert len(packets) > 2
    whole = assemble(map(decode_packet, packets)).tokens
    for lost in range(len(packets)):
        rest = [p for i, p in enumerate(packets) if i != lost]
        part = assemble(map(decode_packet, rest)).tokens
        missing = decode_packet(packets[lost]).body.key
        keep = ~torch.isin(whole.sites.key, torch.from_numpy(missing))
        assert torch.equal(part.sites.key, whole.sites.key[keep]) and torch.equal(part.features, whole.features[keep])


def test_a_budget_keeps_whole_clusters_of_the_best_tokens_within_its_bytes() -> None:
    sent = message(200, 40)
    cluster = find_clusters(sent.tokens.features.numpy(), OWN)
    before = set[int]()
    for budget in (0, 150, 400, 1000, 2500, 10_000):
        kept = select_for_packets(sent.tokens, sent.token_score, budget, "clusters", own_bytes=OWN)
        part = Message(**{**vars(sent), "tokens": kept.tokens, "token_score": kept.score})
        bodies = encode_tokens(part, token_encoding="clusters", counts=kept.counts, own_bytes=OWN)
        used = sum(HEADER_BYTES + len(body.content) for body in bodies) if kept.counts else 0
        keys = set(kept.tokens.sites.key.tolist())
        assert used <= budget and before <= keys
        before = keys
        touched = np.unique(cluster[np.isin(sent.tokens.sites.key.numpy(), list(keys))])
        partial = [c for c in touched if not set(sent.tokens.sites.key.numpy()[cluster == c].tolist()) <= keys]
        assert len(partial) <= 1
        if keys:
            best = sent.tokens.sites.key[sent.token_score.argmax()]
            assert int(best) in keys
    assert len(before) == 200


def test_rows_of_another_form_and_floats_are_refused() -> None:
    sent = message(5, 2)
    with pytest.raises(WireError, match="own bytes"):
        encode(sent, token_encoding="clusters", own_bytes=2)
    with pytest.raises(WireError, match="clusters"):
        encode(
            Message(**{**vars(sent), "tokens": SparseBev(torch.zeros(5, 4), sent.tokens.sites)}),
            token_encoding="clusters",
        )


def test_a_receiver_takes_the_form_of_its_weights_alone() -> None:
    rows = decode_packet(encode(message(20, 4), token_encoding="clusters", own_bytes=OWN)[0]).body
    takes = TokenFormat(MODEL, GRID, CHANNELS + 17, cluster_form=(CHANNELS, OWN))
    assert takes.check_packet(MODEL, rows) is None
    assert TokenFormat(MODEL, GRID, CHANNELS + 17).check_packet(MODEL, rows) == "width"
    assert TokenFormat(MODEL, GRID, CHANNELS + 17, cluster_form=(CHANNELS, 0)).check_packet(MODEL, rows) == "width"
    big = message(20, 4)
    table = torch.full((4, CHANNELS), 40.0).half().view(torch.uint8).view(4, -1)
    features = torch.cat((table[torch.arange(20) % 4], big.tokens.features[:, 2 * CHANNELS :]), 1)
    wild = Message(**{**vars(big), "tokens": big.tokens.with_features(features)})
    packet = decode_packet(encode(wild, token_encoding="clusters", own_bytes=OWN)[0]).body
    assert takes.check_packet(MODEL, packet) == "value"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda d: d[:1], "garbage"),
        (lambda d: d + b"\0", "garbage"),
        (lambda d: d[:-4] + bytes((9, *d[-3:])), "implausible"),
        (lambda d: bytes((d[0] + 1,)) + d[1:], "garbage"),
    ],
)
def test_hostile_bodies_are_refused(change, reason: str) -> None:
    sent = message(20, 4)
    key, rows = sent.tokens.sites.key.numpy(), sent.tokens.features.numpy()
    layout, data = pack_clustered(key, rows, OWN)
    read_clustered(layout, data, 20, CHANNELS)
    with pytest.raises(PacketError) as caught:
        read_clustered(layout, change(data), 20, CHANNELS)
    assert caught.value.reason == reason


def test_values_that_are_not_finite_are_refused() -> None:
    sent = message(20, 4)
    rows = sent.tokens.features.numpy().copy()
    rows[:, 0:2] = np.array([0, 0x7C], np.uint8)
    layout, data = pack_clustered(sent.tokens.sites.key.numpy(), rows, OWN)
    with pytest.raises(PacketError, match="NaN"):
        read_clustered(layout, data, 20, CHANNELS)
