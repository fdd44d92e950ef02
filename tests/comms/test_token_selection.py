# SPDX-License-Identifier: Apache-2.0
"""The byte budget: never exceeded, monotone, the best first."""

import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms.token_selection import select_within_budget
from manyeyes.comms.wire import encode
from manyeyes.datatypes import BevGrid, ConfigError, Message, Sites, SparseBev, Transform

torch.set_num_threads(1)
GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 4)


def scene(seed: int, count: int, channels: int, levels: int = 10) -> tuple[SparseBev, torch.Tensor]:
    """Random cells with scores that are often equal."""
    g = torch.Generator().manual_seed(seed)
    rows, columns = GRID.shape
    key = torch.randperm(rows * columns, generator=g)[:count].sort().values
    score = torch.randint(0, levels, (count,), generator=g) / levels
    return SparseBev(torch.randn(count, channels, generator=g), Sites(key, GRID)), score


def cost(bev: SparseBev, score: torch.Tensor, precision, mtu) -> int:
    message = Message(1, 2, Transform.identity(), torch.zeros(3, 3), tokens=bev, token_score=score)
    return len(b"".join(encode(message, token_encoding=precision, mtu=mtu)))


cases = (
    st.integers(0, 10**6),
    st.integers(0, 400),
    st.sampled_from([1, 2, 8, 33]),
    st.sampled_from(["float32", "float16", "int8"]),
    st.integers(300, 1500),
)


@given(*cases, st.integers(0, 30000))
def test_the_packets_never_exceed_the_budget(seed, count, channels, precision, mtu, budget):
    bev, score = scene(seed, count, channels)
    kept, kept_score = select_within_budget(bev, score, budget, precision, mtu)
    assert len(kept_score) == len(kept.sites)
    if len(kept.sites):
        assert cost(kept, kept_score, precision, mtu) <= budget
    if len(kept.sites) < count:
        # Tight: one more cell would not have fitted.
        order = score.argsort(descending=True, stable=True)
        mask = torch.zeros(count, dtype=torch.bool)
        mask[order[: len(kept.sites) + 1]] = True
        assert cost(bev.keep(mask), score[mask], precision, mtu) > budget


@given(*cases, st.integers(0, 20000), st.integers(0, 5000))
def test_a_larger_budget_keeps_all_that_a_smaller_one_keeps(seed, count, channels, precision, mtu, budget, more):
    bev, score = scene(seed, count, channels)
    small, _ = select_within_budget(bev, score, budget, precision, mtu)
    large, _ = select_within_budget(bev, score, budget + more, precision, mtu)
    assert set(small.sites.key.tolist()) <= set(large.sites.key.tolist())


def test_the_best_are_kept_and_ties_go_to_the_smaller_key():
    key = torch.tensor([3, 10, 20, 30, 40])
    bev = SparseBev(torch.arange(5.0)[:, None].expand(5, 64).contiguous(), Sites(key, GRID))
    score = torch.tensor([0.5, 0.5, 0.9, 0.5, 0.1])
    three = cost(bev.keep(torch.tensor([True, True, True, False, False])), score[:3], "float32", 1398)
    kept, kept_score = select_within_budget(bev, score, three, "float32")
    assert kept.sites.key.tolist() == [3, 10, 20]
    assert kept_score.tolist() == pytest.approx([0.5, 0.5, 0.9])
    assert torch.equal(kept.features, bev.features[:3])
    assert len(select_within_budget(bev, score, three - 1, "float32")[0].sites) == 2


def test_no_limit_keeps_all_and_no_bytes_keep_none():
    bev, score = scene(1, 100, 8)
    assert select_within_budget(bev, score, None)[0] is bev
    for budget in (-5, 0, 100):
        kept, kept_score = select_within_budget(bev, score, budget)
        assert len(kept.sites) == len(kept_score) == 0


def test_an_unknown_precision_is_refused():
    with pytest.raises(ConfigError, match="float16"):
        select_within_budget(*scene(1, 5, 8), 100, "float64")
