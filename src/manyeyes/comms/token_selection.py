# SPDX-License-Identifier: Apache-2.0
"""Which cells to send when bytes are few: the best by score, in exactly the bytes that the wire will count."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.comms.entropy import CodeTables
from manyeyes.comms.payloads import TokenCodec, TokenEncoding, count_cells_per_packet
from manyeyes.comms.wire import DEFAULT_MTU, HEADER_BYTES
from manyeyes.datatypes import SparseBev


@dataclass(frozen=True, eq=False)
class SelectedTokens:
    """tokens: the cells to send; score: (N,) of them; counts: how many of them each packet takes, in the order of their score."""

    tokens: SparseBev
    score: Tensor
    counts: tuple[int, ...]


def select_for_packets(
    bev: SparseBev,
    score: Tensor,
    budget_bytes: int | None,
    token_encoding: TokenEncoding = "float16",
    mtu: int = DEFAULT_MTU,
    tables: CodeTables | None = None,
    envelope_bytes: int = 0,
    own_bytes: int = 0,
) -> SelectedTokens:
    """Return the cells of highest score (N,), ties by key, whose packets together have at most budget_bytes; None is no limit.

    Header, cell indices, scales and checksums are counted, so that the packets that ``wire.encode_tokens`` makes of the result
    never exceed the budget. A smaller budget keeps a subset. A budget that holds no cell keeps none: then the section is left
    out of the message (an empty section would still cost its header). envelope_bytes: added to each packet by its signature; the
    budget includes them, mtu does not. Clusters (``cluster_payload``) are taken one after another, by the highest score of their
    tokens; own_bytes: last bytes of a row of clusters, which are the token's own. Source: CoSTr Eq. 13 with real bytes.
    """
    token_codec = TokenCodec(token_encoding, tables, own_bytes)
    order = token_codec.order(bev, score)
    counts = count_cells_per_packet(
        bev, order, token_codec, mtu - HEADER_BYTES, HEADER_BYTES + envelope_bytes, budget_bytes
    )
    kept = sum(counts)
    if kept == len(order):
        return SelectedTokens(bev, score, tuple(counts))
    mask = torch.zeros(len(order), dtype=torch.bool)
    mask[torch.from_numpy(order[:kept])] = True
    mask = mask.to(score.device)
    return SelectedTokens(bev.keep(mask), score[mask], tuple(counts))


def select_within_budget(
    bev: SparseBev,
    score: Tensor,
    budget_bytes: int | None,
    token_encoding: TokenEncoding = "float16",
    mtu: int = DEFAULT_MTU,
    tables: CodeTables | None = None,
) -> tuple[SparseBev, Tensor]:
    """Return the tokens and scores of :func:`select_for_packets`."""
    selected = select_for_packets(bev, score, budget_bytes, token_encoding, mtu, tables)
    return selected.tokens, selected.score
