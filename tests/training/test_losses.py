# SPDX-License-Identifier: Apache-2.0
"""Losses against loops and closed forms, and finite where there is nothing to learn from."""

import dataclasses
import math

import pytest
import torch

from manyeyes.datatypes import LABELS, BevGrid, Boxes, Sites
from manyeyes.models.detector.box_head import SPEED_UNIT, WIDTHS, RawBoxes
from manyeyes.models.detector.pruning import PruneOutput
from manyeyes.training.detector.losses import (
    LossConfig,
    LossTerms,
    _gaussian_nll,
    centre_focal,
    head_terms,
    heads_terms,
    prune_focal,
)
from manyeyes.training.detector.targets import TargetConfig, Targets, add_class_heat, assign_targets

GRID = BevGrid(-12.8, -12.8, -3.0, 12.8, 12.8, 5.0).at(4)
SITES = Sites(torch.arange(GRID.shape[0] * GRID.shape[1]), GRID)


def raw(seed: int = 0) -> RawBoxes:
    random = torch.Generator().manual_seed(seed)
    values = [torch.randn(len(SITES), w, generator=random).squeeze(1).requires_grad_() for w in WIDTHS]
    return RawBoxes(SITES, *values)


def one_box(yaw: float = 0.4) -> Boxes:
    place, size, velocity = (
        torch.tensor([[1.3, -2.2, 0.8]]),
        torch.tensor([[4.5, 1.9, 1.6]]),
        torch.tensor([[6.0, -8.0]]),
    )
    return Boxes.of(place, size, torch.tensor([yaw]), velocity=velocity)


def terms_of(
    some: RawBoxes, targets: Targets, prune: float = 0.0, kept: float = 0.0, information: float = 0.0
) -> LossTerms:
    """All terms, without pruning and selection losses by default."""
    return head_terms(some, targets, *map(torch.tensor, (prune, kept, information)))


def test_centre_focal_by_a_loop():
    random = torch.Generator().manual_seed(0)
    logit, heat = torch.randn(30, generator=random) * 3, torch.rand(30, generator=random) * 0.98
    positive = torch.zeros(30, dtype=torch.bool)
    positive[[3, 17]] = True
    heat[positive] = 1.0
    total = 0.0
    for s, y, is_centre in zip(logit.tolist(), heat.tolist(), positive.tolist()):
        p = min(max(1 / (1 + math.exp(-s)), 1e-4), 1 - 1e-4)
        total -= (1 - p) ** 2 * math.log(p) if is_centre else (1 - y) ** 4 * p**2 * math.log(1 - p)
    assert float(centre_focal(logit, heat, positive)) == pytest.approx(total / 2, rel=1e-5)


def test_prune_focal_by_a_loop():
    logit = torch.tensor([-2.0, 0.3, 1.5, -0.4, 0.9])
    near = [-1, 0, -1, 2, 2]
    cell_weight = {0: 3 / (2 * 1), 2: 3 / (2 * 2)}  # three cells, two objects: one of one cell, one of two
    total = 0.0
    for s, box in zip(logit.tolist(), near):
        p = 1 / (1 + math.exp(-s))
        pt, weight = (p, 0.25 * cell_weight[box]) if box >= 0 else (1 - p, 0.75)
        total -= weight * (1 - pt) ** 2 * math.log(pt)
    got = prune_focal(PruneOutput(Sites(torch.arange(5), GRID), logit), torch.tensor(near), max(near) + 1)
    assert float(got) == pytest.approx(total / 3, rel=1e-5)


def test_prune_focal_limits_the_weight_of_a_cell_to_eight():
    near = torch.tensor([0] + [1] * 99)
    logit = torch.zeros(100, requires_grad=True)
    prune_focal(PruneOutput(Sites(torch.arange(100), GRID), logit), near, int(near.max()) + 1).backward()
    assert logit.grad is not None
    assert float(logit.grad[0] / logit.grad[1]) == pytest.approx(8 / (100 / (2 * 99)), rel=1e-5)


@pytest.mark.parametrize("scale", (1.0, 1e4))
def test_without_a_box_every_term_is_finite_and_gradients_flow(scale):
    some = raw()
    some = dataclasses.replace(some, heatmap_logit=(some.heatmap_logit * scale).detach().requires_grad_())
    targets = assign_targets(SITES, [Boxes.empty()], TargetConfig())
    prune = prune_focal(PruneOutput(SITES, some.heatmap_logit), torch.full((len(SITES),), -1), 0)
    terms = head_terms(some, targets, prune, torch.zeros(()), torch.zeros(()))
    total = terms.total(LossConfig())
    total.backward()
    assert (
        bool(torch.isfinite(total))
        and some.heatmap_logit.grad is not None
        and bool(torch.isfinite(some.heatmap_logit.grad).all())
    )
    assert not any(
        float(getattr(terms, n).detach())
        for n in ("shape", "direction", "classification", "sigma", "iou_score", "iou", "velocity")
    )
    assert float(terms.heat.detach()) > 0


def test_no_sites_at_all():
    none = Sites(torch.zeros(0, dtype=torch.int64), GRID)
    empty = RawBoxes(none, *(torch.zeros(0, w).squeeze(1).requires_grad_() for w in WIDTHS))
    terms = terms_of(empty, assign_targets(none, [one_box()], TargetConfig()))
    assert float(terms.total(LossConfig()).detach()) == 0.0


def test_predicted_sigma_is_optimal_at_the_true_value():
    random = torch.Generator().manual_seed(0)
    errors = torch.randn(20000, 2, generator=random) * 0.37
    log_sigma = torch.linspace(-3, 1, 401)
    nll = torch.stack([_gaussian_nll(errors, s.expand(20000)).mean() for s in log_sigma])
    assert float(log_sigma[nll.argmin()].exp()) == pytest.approx(0.37, rel=0.03)
    wild = _gaussian_nll(torch.full((1, 2), 1e3), torch.tensor([-1e3]))
    assert bool(torch.isfinite(wild).all())


def perfect(truth: Boxes) -> RawBoxes:
    """Every site predicts exactly the one box."""
    n = len(SITES)
    values = [torch.zeros(n, w) for w in WIDTHS]
    values[1] = (truth.center[:, :2] - SITES.xy) / GRID.cell_size_m
    values[2] = truth.center[:, 2:].expand(n, 1)
    values[4] = torch.stack(((2 * truth.yaw).cos(), (2 * truth.yaw).sin()), 1).expand(n, 2)
    values[5] = (30.0 * torch.stack((truth.yaw.cos(), truth.yaw.sin()), 1)).expand(n, 2)
    values[6][:, 0] = 30.0
    values[7] = values[8] = torch.full((n, 1), -5.0)
    values[9] = torch.full((n, 1), 30.0)
    values[10] = (truth.velocity / SPEED_UNIT).expand(n, 2)
    return RawBoxes(SITES, *(v.squeeze(1) for v in values))


@pytest.mark.parametrize("yaw", (0.4, -1.5, 2.8, -2.9, math.pi / 2 - 1e-3))
def test_perfect_prediction_has_zero_loss_and_opposite_heading_only_direction_loss(yaw):
    truth = one_box(yaw)
    targets = assign_targets(SITES, [truth], TargetConfig())
    terms = terms_of(perfect(truth), targets)
    for name in ("shape", "direction", "classification", "iou_score", "iou", "velocity"):
        assert float(getattr(terms, name)) == pytest.approx(0.0, abs=2e-3), name
    assert float(terms.sigma) == pytest.approx(-10.0, abs=0.1)
    backward = dataclasses.replace(perfect(truth), direction=-perfect(truth).direction)
    worse = terms_of(backward, targets)
    assert float(worse.direction) > 20 and float(worse.shape) == float(terms.shape)


def test_the_term_for_sigma_never_moves_the_box():
    some = raw()
    terms = terms_of(some, assign_targets(SITES, [one_box()], TargetConfig()))
    terms.sigma.backward()
    assert not any(g is not None and bool(g.any()) for g in (some.offset.grad, some.axis.grad))
    assert some.log_sigma_xy.grad is not None and bool(some.log_sigma_xy.grad.any())


def test_the_iou_itself_pulls_a_box_that_nearly_fits_to_its_place():
    truth = one_box()
    aside = perfect(truth)
    offset = (aside.offset + torch.tensor([0.1, -0.1])).requires_grad_()
    targets = assign_targets(SITES, [truth], TargetConfig())
    before = terms_of(dataclasses.replace(aside, offset=offset), targets).iou
    before.backward()
    assert offset.grad is not None and float(before.detach()) > 0.05
    step = 0.5 * offset.grad / offset.grad.norm()
    after = dataclasses.replace(aside, offset=(offset - step).detach())
    assert float(terms_of(after, targets).iou) < float(before.detach())


def test_the_total_is_the_weighted_sum():
    terms = terms_of(raw(), assign_targets(SITES, [one_box()], TargetConfig()), 2.0, 3.0, 4.0)
    weights = LossConfig(
        heat=2.0, shape=0.0, direction=0.0, classification=0.0, sigma=0.0, iou_score=0.0, iou=0.0, velocity=0.25, prune=0.5,
        mask_l1=0.1,
        information=0.01,
    )  # fmt: skip
    wanted = 2 * float(terms.heat.detach()) + 0.25 * float(terms.velocity.detach()) + 1.0 + 0.3 + 0.04
    assert float(terms.total(weights).detach()) == pytest.approx(wanted, rel=1e-6)


def test_heat_maps_of_classes_have_their_own_centres_and_people_no_kind_of_vehicle():
    classes, config = ("vehicle", "pedestrian"), TargetConfig()
    pedestrian = dataclasses.replace(
        one_box(), center=torch.tensor([[5.0, 4.0, 0.9]]), label=torch.tensor([LABELS.index("pedestrian")])
    )
    both = Boxes.cat([one_box(), pedestrian])
    plain = assign_targets(SITES, [both], config)
    targets = add_class_heat(plain, SITES, [both], classes, config)
    assert add_class_heat(plain, SITES, [both], ("vehicle",), config) is plain
    assert targets.class_heat is not None and targets.class_positive is not None
    for column, box in enumerate((one_box(), pedestrian)):
        alone = assign_targets(SITES, [box], config)
        assert torch.equal(targets.class_heat[:, column], alone.heat)
        assert torch.equal(targets.class_positive[:, column], alone.positive)
    heat = torch.randn(len(SITES), 2, generator=torch.Generator().manual_seed(7)).requires_grad_()
    some = dataclasses.replace(raw(), class_heat=heat, classes=classes)
    terms = terms_of(some, targets)
    expected = sum(
        float(centre_focal(heat[:, c].detach(), targets.class_heat[:, c], targets.class_positive[:, c]))
        for c in range(2)
    )
    assert float(terms.heat.detach()) == pytest.approx(expected, rel=1e-6)
    people = dataclasses.replace(targets, boxes=Boxes.cat([pedestrian, pedestrian]))
    assert float(terms_of(some, people).classification) == 0 and float(terms.classification) > 0
    terms.heat.backward()
    assert heat.grad is not None and bool((heat.grad.abs().sum(0) > 0).all())


def test_heads_together_have_the_terms_and_gradients_of_each_alone():
    truths = [one_box()], [Boxes.cat([one_box(2.0), one_box(-1.0)])], [Boxes.empty()]
    zeros = [torch.zeros(())] * 3
    for chosen in ((0, 1), (1, 2), (2, 2)):
        together, alone = (
            [(raw(i), assign_targets(SITES, truths[i], TargetConfig())) for i in chosen] for _ in range(2)
        )
        for mine, (its, targets) in zip(heads_terms(together, *zeros), alone, strict=True):
            wanted = head_terms(its, targets, *zeros)
            for name in ("heat", "shape", "direction", "classification", "sigma", "iou_score", "iou", "velocity"):
                assert float(getattr(mine, name).detach()) == pytest.approx(
                    float(getattr(wanted, name).detach()), rel=1e-5
                )
            (mine.total(LossConfig(iou=1.0)) + wanted.total(LossConfig(iou=1.0))).backward(retain_graph=True)
        for (mine, _), (its, _) in zip(together, alone, strict=True):
            for name in ("heatmap_logit", "offset", "log_size", "axis", "class_logits", "velocity", "iou_logit"):
                a, b = getattr(mine, name).grad, getattr(its, name).grad
                assert (a is None and b is None) or torch.allclose(
                    torch.zeros_like(getattr(mine, name)) if a is None else a,
                    torch.zeros_like(getattr(its, name)) if b is None else b,
                    rtol=1e-5,
                    atol=1e-8,
                )
