# SPDX-License-Identifier: Apache-2.0
"""Bodies of clustered tokens (ERMVP, CVPR 2024): one row a cluster, and of each token its cluster and its own bytes.

Tokens of one cluster have equal rows up to their own bytes. A packet has the clusters of its own tokens, and decodes alone;
a cluster that spans two packets is written in both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.comms import primitives
from manyeyes.comms.primitives import PacketError

MAX_CLUSTERS = 255
"""Largest number of clusters of one packet; their number is one byte."""
HEAD_BYTES = 2
"""Bytes of the number of clusters, and of the number of a token's own bytes."""
VALUE_BYTES = 2
"""Bytes of a float16 channel."""


def find_clusters(rows: NDArray[np.uint8], own_bytes: int) -> NDArray[np.int64]:
    """Return the cluster (N,) of rows (N, 2 C + own_bytes), in the order of their first tokens: equal rows are one cluster."""
    shared = np.ascontiguousarray(rows[:, : rows.shape[1] - own_bytes])
    if not len(rows):
        return np.zeros(0, np.int64)
    as_one = shared.view(np.dtype((np.void, shared.shape[1])))[:, 0]
    _, first, inverse = np.unique(as_one, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[inverse.ravel()]


def order_by_cluster(rows: NDArray[np.uint8], own_bytes: int, order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return rows (N,) in the order of sending: clusters in the order of their first tokens, and each cluster in one piece."""
    cluster = find_clusters(rows[order], own_bytes)
    return order[np.argsort(cluster, kind="stable")]


def count_fitting_clustered_cells(
    key: NDArray[np.int64],
    rows: NDArray[np.uint8],
    own_bytes: int,
    fixed_bytes: int,
    capacity: int,
    header_bytes: int,
    bytes_left: int,
) -> NDArray[np.int64]:
    """Return how many tokens, in the order given, each body takes; arguments as of ``primitives.count_fitting_cells``."""
    cluster = find_clusters(rows, own_bytes).tolist()
    shared_bytes, fixed_bytes = rows.shape[1] - own_bytes, fixed_bytes + HEAD_BYTES
    counts, at = list[int](), 0
    while at < len(cluster):
        room = capacity if bytes_left < 0 else min(capacity, bytes_left - header_bytes)
        best, size, seen = 0, 0, set[int]()
        # A further key lowers the bytes of the cells by at most one, which its index takes: no body gets shorter by a token.
        for end in range(at + 1, min(len(cluster), at + 65535) + 1):
            seen.add(cluster[end - 1])
            min_bytes = fixed_bytes + len(seen) * shared_bytes + (end - at) * (1 + own_bytes)
            if min_bytes > room or len(seen) > MAX_CLUSTERS:
                break
            whole = min_bytes + primitives.cells_size(np.sort(key[at:end]))
            if whole > room:
                break
            best, size = end - at, whole
        if not best:
            break
        if bytes_left >= 0:
            bytes_left -= header_bytes + size
        counts.append(best)
        at += best
    return np.array(counts, np.int64)


def pack_clustered(key: NDArray[np.int64], rows: NDArray[np.uint8], own_bytes: int) -> tuple[int, bytes]:
    """Return the layout of the cells, and what follows the head of a body: counts, cells, rows of clusters, and tokens.

    key (n,) ascending; rows (n, 2 C + own_bytes).
    """
    layout, cells = primitives.pack_cells(key)
    cluster = find_clusters(rows, own_bytes)
    first = np.unique(cluster, return_index=True)[1]
    table = rows[first, : rows.shape[1] - own_bytes]
    tokens = np.concatenate((cluster[:, None].astype(np.uint8), rows[:, rows.shape[1] - own_bytes :]), 1)
    return layout, bytes((len(table), own_bytes)) + cells + table.tobytes() + tokens.tobytes()


def read_clustered(layout: int, data: bytes, count: int, channels: int) -> tuple[NDArray[np.int64], bytes, bytes, int]:
    """Return the inverse of pack_clustered: keys (count,), the rows of clusters, the tokens, and the number of their own bytes.

    Raises:
        PacketError: the bytes are not those of so many tokens, a cluster is missing or unused, or a value is NaN or infinite.
    """
    if len(data) < HEAD_BYTES:
        raise PacketError("garbage", "A body of clusters begins with two counts.")
    clusters, own_bytes = data[0], data[1]
    key, used = primitives.unpack_cells(layout, data[HEAD_BYTES:], count)
    at = HEAD_BYTES + used
    end = at + clusters * channels * VALUE_BYTES
    if len(data) != end + count * (1 + own_bytes):
        raise PacketError("garbage", f"{count} tokens of {clusters} clusters do not fill a body of {len(data)} bytes.")
    table, tokens = data[at:end], data[end:]
    index = np.frombuffer(tokens, np.uint8)[:: 1 + own_bytes]
    if not np.array_equal(np.unique(index), np.arange(clusters)):
        raise PacketError("implausible", f"Tokens name other clusters than the {clusters} of their packet.")
    if not primitives.are_finite(table, 0, VALUE_BYTES):
        raise PacketError("implausible", "Features are NaN or infinite.")
    return key, table, tokens, own_bytes


def join_clustered(table: bytes, tokens: bytes, channels: int, own_bytes: int) -> NDArray[Any]:
    """Return the rows (n, 2 C + own_bytes) uint8 of the tokens of a packet."""
    shared = np.frombuffer(table, np.uint8).reshape(-1, channels * VALUE_BYTES)
    of_tokens = np.frombuffer(tokens, np.uint8).reshape(-1, 1 + own_bytes)
    return np.concatenate((shared[of_tokens[:, 0]], of_tokens[:, 1:]), 1)
