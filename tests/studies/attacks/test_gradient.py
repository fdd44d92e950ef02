# SPDX-License-Identifier: Apache-2.0
"""White-box attacks on features: the gradient lowers the score of what honest agents find, within its bounds."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from tests.studies.attacks.scene import make_detector, make_snapshot

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import gather_tokens
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.studies.attacks.families.gradient import FusedView, GradientAttack, make_loss, perturb

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def view() -> FusedView:
    """The ego's fusion of its own tokens and those of one malicious agent.

    Weights that were never trained refine nothing: theirs are drawn, and low scores count as objects.
    """
    detector, generator = make_detector(), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in (*detector.fusion.parameters(), *detector.refine.parameters()):
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator)
    snapshot, strategy = make_snapshot("a", 0), get_strategy("intermediate")
    caches = [PerceptionCache(detector) for _ in range(2)]
    frames = [cache.level(frame).levelled for cache, frame in zip(caches, snapshot.frames)]
    message = strategy.compose_message(caches[1], frames[1])
    assert message is not None and message.tokens is not None and len(message.tokens.sites) > 10
    return FusedView(detector, partial(gather_tokens, caches[0], frames[0]), (), message)


def loss_of(view: FusedView, attack: GradientAttack, rows: torch.Tensor) -> float:
    with torch.no_grad():
        return float(make_loss(view, attack)(view.fuse(rows[:, :-PROPOSAL_DIM])))


@pytest.mark.parametrize("goal", ["lower", "raise"])
def test_gradients_lower_the_loss_and_stay_within_epsilon(view, goal, monkeypatch) -> None:
    monkeypatch.setattr("manyeyes.studies.attacks.families.gradient.TARGET_SCORE", 0.05)
    attack = GradientAttack(4, 0.5, goal, random_start=False)
    honest = view.message.tokens.features
    start = torch.zeros_like(honest[:, :-PROPOSAL_DIM])
    rows = perturb(view, attack, start)
    assert torch.equal(rows[:, -PROPOSAL_DIM:], honest[:, -PROPOSAL_DIM:]), "proposals stay honest"
    spread = honest[:, :-PROPOSAL_DIM].std(0, unbiased=False)
    assert bool(((rows - honest)[:, :-PROPOSAL_DIM].abs() <= 0.5 * spread + 1e-5).all())
    assert loss_of(view, attack, rows) < loss_of(view, attack, honest) - 1e-4


def test_the_loss_decreases_along_the_gradient_and_not_against_it(view, monkeypatch) -> None:
    monkeypatch.setattr("manyeyes.studies.attacks.families.gradient.TARGET_SCORE", 0.05)
    attack = GradientAttack(1, 0.1, "lower", random_start=False)
    loss, honest = make_loss(view, attack), view.message.tokens.features[:, :-PROPOSAL_DIM]
    features = honest.clone().requires_grad_()
    with torch.enable_grad():
        (gradient,) = torch.autograd.grad(loss(view.fuse(features)), features)
    assert float(gradient.abs().max()) > 0
    step = 0.05 * honest.std(0, unbiased=False) * gradient.sign()
    with torch.no_grad():
        down, up = (float(loss(view.fuse(honest + sign * step))) for sign in (-1, 1))
    assert down < up


def test_no_step_that_raises_the_loss_is_sent(view, monkeypatch) -> None:
    """With one huge random start the honest features are the best."""
    monkeypatch.setattr(
        "manyeyes.studies.attacks.families.gradient.make_loss",
        lambda view, attack: lambda raw: raw.heatmap_logit.sum() * 0,
    )
    honest = view.message.tokens.features
    rows = perturb(view, GradientAttack(2, 1.0), torch.ones_like(honest[:, :-PROPOSAL_DIM]))
    assert torch.equal(rows, honest)


def test_the_weight_of_the_defence_lowers_what_the_attacker_reaches(view, monkeypatch) -> None:
    """At the lowest weight its tokens decide nothing where others have tokens too: the loss differs less from the honest one."""
    monkeypatch.setattr("manyeyes.studies.attacks.families.gradient.TARGET_SCORE", 0.05)
    honest = view.message.tokens.features[:, :-PROPOSAL_DIM]
    changed = honest + 0.5 * honest.std(0, unbiased=False)
    with torch.no_grad():
        full, low = (
            (
                replace(view, log_weight=w).fuse(changed).heatmap_logit,
                replace(view, log_weight=w).fuse(honest).heatmap_logit,
            )
            for w in (0.0, -4.0)
        )
    assert float((low[0] - low[1]).abs().sum()) < float((full[0] - full[1]).abs().sum())
