# SPDX-License-Identifier: Apache-2.0
"""AttFuse by hand: equal features, absent agents as keys of zeros, and a cell that the ego does not see."""

import math

import torch
from tests.models.fusion_cases import CHANNELS, agent, at, built, rows_of

from manyeyes.models.fusion.attfuse import AttFuse

X = torch.randn(2, CHANNELS, generator=torch.Generator().manual_seed(0))


def test_equal_features_of_several_agents_give_the_same_feature() -> None:
    rows = rows_of(agent(X, at(0, 1), False), agent(X, at(0, 1), True), agent(X, at(0, 1), True))
    assert torch.allclose(built(AttFuse)(rows), X, atol=1e-6)


def test_absent_agents_take_their_part_of_the_softmax() -> None:
    """N - 1 agents have no feature on the ego's cell: x e^(|x|^2 / sqrt(C)) / (e^(|x|^2 / sqrt(C)) + N - 1)."""
    x = 0.5 * X[:1]
    rows = rows_of(agent(x, at(0), False), agent(X[1:], at(1), True), agent(X[1:], at(2), True))
    own = math.exp(float(x.square().sum()) / math.sqrt(CHANNELS))
    assert torch.allclose(built(AttFuse, "zero")(rows)[0], x[0] * own / (own + 2), atol=1e-6)
    assert torch.allclose(built(AttFuse)(rows)[0], x[0], atol=1e-6)


def test_the_ego_asks_with_its_own_feature() -> None:
    rows = rows_of(agent(X[:1], at(0), False), agent(X[1:], at(0), True))
    share = (X[0] @ X.T / math.sqrt(CHANNELS)).softmax(0)
    assert torch.allclose(built(AttFuse)(rows)[0], share @ X, atol=1e-6)


def test_a_cell_without_the_ego_is_the_mean() -> None:
    rows = rows_of(agent(X[:1], at(1), False), agent(X[:1], at(0), True), agent(X[1:], at(0), True))
    assert torch.allclose(built(AttFuse)(rows)[0], X.mean(0), atol=1e-6)
    assert torch.allclose(built(AttFuse, "zero")(rows)[0], X.sum(0) / 3, atol=1e-6)
