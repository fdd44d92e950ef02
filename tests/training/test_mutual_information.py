# SPDX-License-Identifier: Apache-2.0
"""Losses of the selector: its own task keeps relevant tokens, the receiver target drops what only the sender sees,
Eq. 10 drops all.

The toy: 30 windows of three object tokens and three background tokens; the receiver observes half of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import BevGrid, SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.training.detector.mutual_information import (
    AgentPairTokens,
    mutual_information_loss,
    paper_mutual_information,
    receiver_mutual_information,
    window_mutual_information,
)

WINDOWS, SEEN, CHANNELS = 30, 15, 32
OBJECT = (torch.arange(6) < 3).repeat(WINDOWS)
ROW = torch.arange(WINDOWS).repeat_interleave(6)
SHARED = ROW < SEEN


def sender_receiver_features() -> tuple[Tensor, Tensor]:
    """Unit features (180, 32) of the sender and of the receiver: an object of its own a window, one ground everywhere."""
    random = torch.Generator().manual_seed(0)
    unit = [functional.normalize(torch.randn(n, 1, CHANNELS, generator=random), dim=2) for n in (WINDOWS, 1)]
    clean = torch.where(OBJECT.view(WINDOWS, 6, 1), *unit)
    noise = 0.6 / math.sqrt(CHANNELS) * torch.randn(2, WINDOWS, 6, CHANNELS, generator=random)
    sent, had = functional.normalize(clean + noise, dim=3).flatten(1, 2)
    return sent, had


def met(mask: Tensor) -> AgentPairTokens:
    sent, had = sender_receiver_features()
    return AgentPairTokens(sent, mask, ROW, had[SHARED], ROW[SHARED])


def learned(loss: Callable[[Tensor], Tensor], price: float, steps: int = 150) -> list[float]:
    """Mean mask of objects and background in shared windows, then in those that the sender alone sees."""
    logit = torch.zeros(len(ROW), requires_grad=True)
    optimiser = torch.optim.Adam([logit], 0.2)
    for _ in range(steps):
        mask = torch.sigmoid(logit)
        total = loss(mask) + price * mask.mean()
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
    mask = torch.sigmoid(logit.detach())
    return [float(mask[where & what].mean()) for where in (SHARED, ~SHARED) for what in (OBJECT, ~OBJECT)]


def test_toy_own_task_keeps_relevant_tokens_for_any_receiver():
    """M4."""
    sent, _ = sender_receiver_features()
    shared, shared_ground, own, own_ground = learned(
        lambda m: window_mutual_information(sent, m, OBJECT.float(), ROW), 1.0
    )
    assert 0.5 < shared < 0.95 and 0.5 < own < 0.95
    assert shared_ground < 0.1 and own_ground < 0.1


def test_toy_receiver_target_drops_what_only_the_sender_observes():
    shared, shared_ground, own, own_ground = learned(lambda m: receiver_mutual_information(met(m)), 1.0)
    assert shared > 0.5 and own < 0.1 and own_ground < 0.1
    assert shared_ground < shared


def test_toy_paper_target_drops_everything():
    assert max(learned(lambda m: paper_mutual_information(met(m)), 1.0)) < 0.1


@pytest.mark.parametrize("related", (True, False))
def test_paper_information_cannot_separate_related_from_unrelated(related):
    """M1: Eq. 11 of unit z at tau = 0.1 lies within 0.05 of zero, whatever the two sides have to do with each other."""
    random = torch.Generator().manual_seed(1)
    one = functional.normalize(torch.randn(WINDOWS, 64, generator=random), dim=1)
    other = one if related else functional.normalize(torch.randn(WINDOWS, 64, generator=random), dim=1)
    row = torch.arange(WINDOWS)
    assert abs(float(paper_mutual_information(AgentPairTokens(one, torch.ones(WINDOWS), row, other, row)))) < 0.05


def test_repaired_information_falls_when_windows_are_permuted_and_never_exceeds_log_m():
    """M2."""
    sent, had = sender_receiver_features()
    right = receiver_mutual_information(AgentPairTokens(sent, torch.ones(len(ROW)), ROW, had, ROW))
    wrong = receiver_mutual_information(AgentPairTokens(sent, torch.ones(len(ROW)), ROW, had, (ROW + 7) % WINDOWS))
    assert 0 <= float(right) < float(wrong) - 1
    own = window_mutual_information(sent, OBJECT.float(), OBJECT.float(), ROW)
    assert 0 <= float(own) < 0.1


def test_half_mask_lowers_the_product_but_not_the_cosine():
    """M3: what is normalised does not notice a mask that shrinks, and L1 shrinks it to nothing."""
    sent, _ = sender_receiver_features()
    mask = 0.1 + 0.2 * OBJECT.float()
    whole, half = (window_mutual_information(sent, m, OBJECT.float(), ROW) for m in (mask, mask / 2))
    assert float(half) > float(whole) + 0.1
    losses = [
        functional.normalize(torch.zeros(WINDOWS, CHANNELS).index_add(0, ROW, m[:, None] * sent), dim=1)
        for m in (mask, mask / 2)
    ]
    assert torch.allclose(*losses, atol=1e-6)


def test_two_windows_by_hand():
    # Unit axes; window 0 sends half of its object, window 1 the whole. Sums over sqrt(count) with one token each: x = m f.
    features, mask = torch.eye(2), torch.tensor([0.5, 1.0])
    got = window_mutual_information(features, mask, torch.ones(2), torch.arange(2))
    a, b = math.exp(5.0), math.exp(10.0)
    rows = (math.log(1 + 1 / a) + math.log(1 + 1 / b)) / 2
    assert float(got) == pytest.approx(rows, abs=1e-5)


def test_without_two_windows_to_compare_only_the_price_is_left():
    """M7: no NaN, and a gradient of zero."""
    sent, had = sender_receiver_features()
    mask = torch.full((len(ROW),), 0.5, requires_grad=True)
    alone = AgentPairTokens(sent, mask, ROW, had, ROW + WINDOWS)
    one = AgentPairTokens(sent, mask, ROW, had[:6], ROW[:6])
    nothing = AgentPairTokens(sent[:0], mask[:0], ROW[:0], had[:0], ROW[:0])
    for loss in (
        receiver_mutual_information(alone),
        receiver_mutual_information(one),
        receiver_mutual_information(nothing),
        paper_mutual_information(nothing),
        window_mutual_information(sent, mask, torch.zeros(len(ROW)), ROW),
        window_mutual_information(sent, mask, (ROW == 3).float(), ROW),
    ):
        assert float(loss.detach()) == 0
        (grad,) = torch.autograd.grad(loss, mask)
        assert not grad.any()


def test_windows_follow_token_positions_and_only_the_mask_has_gradients():
    grid = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
    yx = torch.tensor([[0, 0], [7, 7], [8, 8], [31, 31]])
    rows = torch.randn(4, 8 + PROPOSAL_DIM, generator=torch.Generator().manual_seed(0)).requires_grad_()
    tokens = SparseBev.from_cells(rows, yx, grid)
    mask, matters = torch.tensor([0.9, 0.2, 0.5, 0.7]).requires_grad_(), torch.tensor([1.0, 0.0, 1.0, 1.0])
    price, information = mutual_information_loss(tokens, mask, matters)
    assert float(price.detach()) == pytest.approx(0.575)
    features = functional.normalize(rows[:, :8].detach(), dim=1)
    wanted = window_mutual_information(features, mask, matters, torch.tensor([0, 0, 1, 2]))
    assert float(information.detach()) == pytest.approx(float(wanted.detach()), abs=1e-6) and float(wanted.detach()) > 0
    (price + information).backward()
    assert rows.grad is None and mask.grad is not None and bool(mask.grad.all())


def test_no_tokens_at_all():
    grid = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
    tokens = SparseBev.from_cells(torch.zeros(0, 8 + PROPOSAL_DIM), torch.zeros(0, 2, dtype=torch.int64), grid)
    assert [float(v) for v in mutual_information_loss(tokens, torch.zeros(0), torch.zeros(0))] == [0, 0]
