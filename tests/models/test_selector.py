# SPDX-License-Identifier: Apache-2.0
"""Which tokens are worth their bytes: at the start the sure ones, each object once; the kept set grows with the budget."""

import math

import pytest
import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.selector import Selector, rank_in_group

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 8


def make_tokens(*cells: tuple[int, int, float, int], seed: int = 0) -> SparseBev:
    """Tokens at (row, column) that say with a heat that the object's centre lies so many columns ahead."""
    rows = torch.randn(len(cells), CHANNELS + PROPOSAL_DIM, generator=torch.Generator().manual_seed(seed))
    box = rows[:, CHANNELS:]
    for i, (_, _, heat, ahead) in enumerate(cells):
        box[i, BOX_LAYOUT.heatmap_logit] = heat
        box[i, BOX_LAYOUT.offset] = torch.tensor([float(ahead), 0.0])
    return SparseBev.from_cells(rows, torch.tensor([s[:2] for s in cells], dtype=torch.int64).view(-1, 2), GRID)


def test_rank_in_group_by_hand():
    key = torch.tensor([4, 9, 4, 4, 9, 1])
    value = torch.tensor([0.5, 2.0, 0.7, 0.5, 3.0, -1.0])
    # Group 4: 0.7, then the two of 0.5 by row; group 9: 3, 2; group 1 alone.
    assert rank_in_group(key, value).tolist() == [1, 1, 0, 2, 0, 0]
    assert rank_in_group(key, value).dtype == value.dtype
    assert rank_in_group(key[:0], value[:0]).tolist() == []


def test_rank_in_group_against_a_loop():
    random = torch.Generator().manual_seed(0)
    key, value = torch.randint(0, 7, (60,), generator=random), torch.randint(0, 5, (60,), generator=random).float()
    wanted = [
        sum(key[j] == key[i] and (value[j] > value[i] or (value[j] == value[i] and j < i)) for j in range(60))
        for i in range(60)
    ]
    assert rank_in_group(key, value).tolist() == [float(w) for w in wanted]


def test_untrained_selector_is_confidence_minus_redundancy():
    # Two tokens propose the cell (5, 5), the better from beside it; the third proposes its own cell, the fourth has a
    # low score.
    some = make_tokens((5, 4, 2.0, 1), (5, 5, 1.0, 0), (20, 20, 0.5, 0), (9, 9, -8.0, 0))
    score = Selector(CHANNELS)(some).detach()
    wanted = torch.tensor([2.0, 1.0 - 2.0 * math.log(2.0), -8.0, 0.5])
    order = some.sites.yx[:, 0].tolist()
    assert order == [5, 5, 9, 20]
    assert torch.allclose(score, wanted, atol=1e-6)
    # So the second word on one object comes after the first word on another that is less sure.
    assert score.argsort(descending=True).tolist() == [0, 3, 1, 2]


def test_learned_score_is_added_and_senders_of_a_batch_are_independent():
    some = make_tokens((5, 4, 2.0, 1), (5, 5, 1.0, 0))
    selector = Selector(CHANNELS)
    fresh = selector(some).detach()
    torch.nn.init.normal_(selector.outer.weight)
    assert not torch.allclose(selector(some), fresh, atol=1e-3)
    rows, columns = GRID.shape
    both = Sites(torch.cat((some.sites.key, some.sites.key + rows * columns)), GRID, 2)
    batch = SparseBev(some.features.repeat(2, 1), both)
    assert torch.allclose(selector(batch), selector(some).repeat(2), atol=1e-6)


def test_no_gradient_reaches_the_tokens_and_every_selector_weight_learns():
    """M6."""
    some = make_tokens((5, 4, 2.0, 1), (5, 5, 1.0, 0), (20, 20, 0.5, 0))
    features = some.features.requires_grad_()
    selector = Selector(CHANNELS)
    torch.nn.init.normal_(selector.outer.weight)
    torch.sigmoid(selector(some)).sum().backward()
    assert features.grad is None
    assert all(p.grad is not None and bool(p.grad.any()) for p in selector.parameters())


def kept(score: Tensor, n: int) -> set[int]:
    return set(score.sort(descending=True, stable=True).indices[:n].tolist())


@pytest.mark.parametrize("seed", range(3))
def test_the_same_tokens_get_the_same_scores_and_a_larger_budget_keeps_the_smaller_ones(seed):
    random = torch.Generator().manual_seed(seed)
    cells = torch.randperm(1024, generator=random)[:40].tolist()
    some = make_tokens(*((c // 32, c % 32, float(h), 0) for c, h in zip(cells, torch.randn(40, generator=random))))
    selector = Selector(CHANNELS).eval()
    torch.nn.init.normal_(selector.outer.weight)
    score = selector(some).detach()
    assert torch.equal(score, selector(some).detach())
    assert all(kept(score, n) < kept(score, n + 1) for n in range(39))


def test_selection_of_no_tokens():
    assert Selector(CHANNELS)(make_tokens()).shape == (0,)
